"""The field's depth beside that of stereo, which knows nothing of the field: where they differ, one of them is wrong.

Depth maps are there only if somebody asked for them, and the scores must not depend on that. So all that is told here
is a record, and how many photos it is told of may depend on the clock.
"""

import math
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib import colormaps
from torch import Tensor

from nerf.fields.hash_grid import HashGridField
from nerf.geometry.rays import Rays, points_on
from nerf.geometry.scene import Scene, View
from nerf.runtime.randomness import generator
from stages.contract import Inputs, Progress
from stages.depth.files import depth_map_file, read_depth_map
from stages.evaluate.tiles import GOLDEN_RATIO
from stages.io.amounts import counted
from stages.io.files import read_json, write_json, write_png
from stages.render.renderer import Renderer
from stages.train.data import PhotoReader, view_rays

RECORD, PICTURES = "stereo_check.json", "stereo_check"
SIGMAS, MIN_DIFFERENCE = 3.0, 0.03  # a pixel differs by more than so many standard deviations, and by more than 3 %
PIXELS = 2048  # of a photo: they tell the share that differs to 1 %
SHOWN = 2  # photos in which most pixels differ
MIN_SHOWN_PIXELS, MAX_SHOWN_PIXELS = 160 * 120, 400 * 300  # of each panel of their pictures
GAP = 4  # white pixels between panels
NEARER, FARTHER, UNKNOWN = (225, 29, 72), (59, 130, 246), (128, 128, 128)  # colours: the field is so; stereo does not know


class Compared(NamedTuple):
    """Distances along rays by stereo (0: not known, or nothing that the field could show) and by the field, in scene
    units, and by which fraction they may differ."""

    stereo: Float[Tensor, "*rays"]
    field: Float[Tensor, "*rays"]
    tolerance: Float[Tensor, "*rays"]

    @property
    def difference(self) -> Float[Tensor, "*rays"]:
        """The field's distance over that of stereo, less 1; 0 where stereo does not know."""
        return torch.where(self.stereo > 0, self.field / self.stereo - 1, 0.0)

    @property
    def nearer(self) -> Bool[Tensor, "*rays"]:
        """Where the field shows something in front of what stereo sees, as a floater."""
        return self.difference < -self.tolerance

    @property
    def farther(self) -> Bool[Tensor, "*rays"]:
        """Where the field has a hole, or its surface lies behind."""
        return self.difference > self.tolerance

    def figures(self) -> dict[str, Any]:
        """Of the rays that stereo knows; null where it knows none."""
        known = self.stereo > 0
        if not known.any():
            return {"pixels": 0, "differ": None, "nearer": None, "median_difference": None}
        nearer, farther = (float(where[known].float().mean()) for where in (self.nearer, self.farther))
        median = float(self.difference[known].abs().median())
        return {"pixels": int(known.sum()), "differ": nearer + farther, "nearer": nearer, "median_difference": median}


@dataclass(frozen=True)
class StereoCheck:
    """Compares a field with the depth maps in the ``depth`` folder of a scene's training photos."""

    scene: Scene
    ingest: Path
    depth: Path
    renderer: Renderer

    @cached_property
    def downscale(self) -> float:
        """Photo width / width of its depth map."""
        return read_json(self.depth / "depth.json")["downscale"]

    def sample(self, view: View, number: int) -> Compared:
        """PIXELS random ones of those that stereo knows in the ``number``-th photo, or all of them, (1, n)."""
        rays, stereo, tolerance = self._stereo(view, self.downscale)
        known = stereo.flatten().nonzero().squeeze(-1)
        some = known[torch.randperm(len(known), generator=generator("cpu", number))[:PIXELS]]
        rays, stereo, tolerance = (
            rays.each(lambda part: part.flatten(0, 1)[some][None]),
            stereo.flatten()[some][None],
            tolerance.flatten()[some][None],
        )
        return Compared(stereo, rendered_distance(self.renderer, rays) if len(some) else stereo, tolerance)

    def picture(self, view: View, pixels: float) -> np.ndarray:
        """Photo, stereo's depth, the field's, and where they differ, side by side, each of about so many ``pixels``, at
        most those of the depth map."""
        camera = self.scene.cameras[view.camera]
        downscale = max(self.downscale, math.sqrt(camera.width * camera.height / pixels))
        rays, stereo, tolerance = self._stereo(view, downscale)
        compared = Compared(stereo, rendered_distance(self.renderer, rays), tolerance)
        background = self.renderer.background.tolist()
        photo = PhotoReader(self.ingest, self.scene, downscale).pixels(view, background).mul(255).byte().numpy()
        return _side_by_side(photo, compared)

    def _stereo(self, view: View, downscale: float) -> tuple[Rays, Tensor, Tensor]:
        """The rays of a photo at this size, what stereo knows of their distances, and how far the field's may be off."""
        rays = view_rays(self.scene, view, downscale)
        depth_map = read_depth_map(depth_map_file(self.depth, view.file))
        rows, columns = (  # of the depth map, at the middles of these pixels
            (2 * np.arange(pixels) + 1) * side // (2 * pixels)
            for pixels, side in zip(rays.near.shape, depth_map.distance.shape, strict=True)
        )
        distance, sigma = (torch.from_numpy(part[np.ix_(rows, columns)]) for part in depth_map[:2])
        shown = (rays.near < distance) & (distance < rays.far)
        field = self.renderer.field
        if isinstance(field, HashGridField) and not field.space.unbounded:  # nothing is rendered outside the box
            shown &= (points_on(rays, distance[..., None]).squeeze(-2).abs() <= field.space.half).all(-1)
        return rays, distance * shown, (SIGMAS * sigma).clamp(min=MIN_DIFFERENCE)


def rendered_distance(renderer: Renderer, rays: Rays) -> Float[Tensor, "h w"]:
    """Expected distance of what stops rays (h, w), whatever they transmit; their far end where that is more than half.

    The expected distance is what each kind of field renders.
    """
    rendering = renderer.render(rays)
    stopped = rendering.depth - (1 - rendering.opacity) * rays.far
    return torch.where(rendering.opacity > 0.5, stopped / rendering.opacity.clamp(min=0.5), rays.far)


def check(
    scene: Scene, inputs: Inputs, renderer: Renderer, seconds: float, folder: Path, progress: Progress
) -> dict[str, Any]:
    """Compare the field with the depth maps, in about so many ``seconds``, and write the content of the answer, RECORD,
    and pictures below PICTURES. Photos that there is no time for are left out, evenly; one is always compared."""
    one = StereoCheck(scene, inputs["ingest"], inputs["depth"], renderer)
    views, began = scene.of_split("train"), time.perf_counter()
    found = dict[int, Compared]()
    for number in sorted(range(len(views)), key=lambda index: index * GOLDEN_RATIO % 1):
        progress.update(f"comparing depth with stereo in {views[number].name}", len(found) / len(views))
        found[number] = one.sample(views[number], number)
        if time.perf_counter() - began > seconds / 2:
            break
    images = {number: {"name": views[number].name} | found[number].figures() for number in sorted(found)}
    overall = Compared(*(torch.cat(parts, dim=1) for parts in zip(*found.values(), strict=True))).figures()
    spent = time.perf_counter() - began
    affordable = overall["pixels"] / spent * (seconds - spent) / SHOWN
    worst = sorted((n for n in images if images[n]["pixels"]), key=lambda n: -images[n]["differ"])[:SHOWN]
    (folder / PICTURES).mkdir()
    for number in worst:
        file = Path(views[number].file.removeprefix("images/")).with_suffix(".png").as_posix()
        picture = one.picture(views[number], min(max(affordable, MIN_SHOWN_PIXELS), MAX_SHOWN_PIXELS))
        write_png(folder / PICTURES / file, picture)
        images[number]["picture"] = f"{PICTURES}/{file}"
    result = {"photos_compared": len(found), "photos_train": len(views)} | overall
    result |= {"tolerance": {"sigmas": SIGMAS, "fraction": MIN_DIFFERENCE}}
    result |= {"images": list(images.values()), "worst": [views[number].name for number in worst]}
    write_json(folder / RECORD, result)
    return result


def line_of(result: dict[str, Any]) -> str:
    """depth differs from stereo at 6.1% of the pixels that it covers in 5 of 9 training photos."""
    compared, photos = result["photos_compared"], result["photos_train"]
    of_photos = "" if compared == photos else f" in {compared} of {counted(photos, 'training photo')}"
    if not result["pixels"]:
        return f"stereo covers nothing that the field could show{of_photos}"
    return f"depth differs from stereo at {result['differ']:.1%} of the pixels that it covers{of_photos}"


def _side_by_side(photo: np.ndarray, compared: Compared) -> np.ndarray:
    """Four panels (h, w, 3) uint8 in a row. Depths are inverse ones, near red, far blue (turbo), on the scale of stereo's
    from its 1 % to its 99 % quantile. In the last one covered pixels are bright, and those that differ are coloured."""
    known = (compared.stereo > 0).numpy()
    inverse = [1 / each.double().clamp(min=1e-6).numpy() for each in (compared.stereo, compared.field)]
    low, high = np.quantile(inverse[0][known] if known.any() else inverse[1], [0.01, 0.99])
    levels = [np.clip((each - low) / ((high - low) or 1), 0, 1) for each in inverse]
    stereo, field = (colormaps["turbo"](level, bytes=True)[..., :3] for level in levels)
    grey = photo.mean(-1, keepdims=True)
    differs = np.broadcast_to(np.where(known[..., None], 100 + 0.6 * grey, 0.3 * grey), photo.shape).copy()
    differs[compared.nearer.numpy()], differs[compared.farther.numpy()] = NEARER, FARTHER
    gap = np.full((len(photo), GAP, 3), 255)
    panels = [photo, gap, np.where(known[..., None], stereo, UNKNOWN), gap, field, gap, differs]
    return np.concatenate(panels, axis=1).astype(np.uint8)
