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
MIN_SHOWN_PIXELS, MAX_SHOWN_PIXELS = 48 * 36, 400 * 300  # of each panel of their pictures
GAP = 4  # white pixels between panels
NEARER, FARTHER = (225, 29, 72), (59, 130, 246)  # colours where the field is so
UNKNOWN = (128, 128, 128)  # and where stereo sees nothing


class Known(NamedTuple):
    """Rays, how far along them stereo sees a surface (scene units; 0: it does not know, or the field could not show
    it), and by which fraction of that the field may differ."""

    rays: Rays
    distance: Float[Tensor, "*rays"]
    tolerance: Float[Tensor, "*rays"]


class Compared(NamedTuple):
    """Distances along rays by stereo (0: not known) and by the field, and by which fraction they may differ."""

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

    def sample(self, view: View, number: int) -> Known:
        """PIXELS random ones of those that stereo knows in the ``number``-th photo, or all of them, (1, n)."""
        known = self._known(view, self.downscale)
        pixels = known.distance.flatten().nonzero().squeeze(-1)
        some = pixels[torch.randperm(len(pixels), generator=generator("cpu", number))[:PIXELS]]
        distance, tolerance = (part.flatten()[some][None] for part in known[1:])
        return Known(known.rays.each(lambda part: part.flatten(0, 1)[some][None]), distance, tolerance)

    def picture(self, view: View, pixels: float) -> np.ndarray:
        """Photo, where depths differ, stereo's and the field's, each of about so many ``pixels``, at most those of the
        depth map."""
        camera = self.scene.cameras[view.camera]
        downscale = max(self.downscale, math.sqrt(camera.width * camera.height / pixels))
        compared = self.compare(self._known(view, downscale))
        background = self.renderer.background.tolist()
        photo = PhotoReader(self.ingest, self.scene, downscale).pixels(view, background).mul(255).byte().numpy()
        return _panels(photo, compared)

    def compare(self, known: Known) -> Compared:
        """What stereo knows beside what the field shows: the expected distance of what stops the rays, whatever they
        transmit; their far end where that is more than half.

        Each kind of field renders the expected distance; by the median one hardly other pixels differ
        (docs/stages/evaluate.md).
        """
        rays = known.rays
        if not rays.near.numel():
            return Compared(known.distance, rays.far, known.tolerance)
        _, depth, opacity = self.renderer.render(rays)
        stopped = (depth - (1 - opacity) * rays.far) / opacity.clamp(min=0.5)
        return Compared(known.distance, torch.where(opacity > 0.5, stopped, rays.far), known.tolerance)

    def _known(self, view: View, downscale: float) -> Known:
        """What stereo knows of a photo at this size."""
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
        return Known(rays, distance * shown, (SIGMAS * sigma).clamp(min=MIN_DIFFERENCE))


def check(
    scene: Scene, inputs: Inputs, renderer: Renderer, seconds: float, folder: Path, progress: Progress
) -> dict[str, Any]:
    """Compare the field with the depth maps, in about so many ``seconds``. Writes RECORD, whose content it returns, and
    PICTURES. Photos that there is no time for are left out, evenly; one is always compared."""
    one = StereoCheck(scene, inputs["ingest"], inputs["depth"], renderer)
    views, began, rendering = scene.of_split("train"), time.perf_counter(), 0.0
    found = dict[int, Compared]()
    for number in sorted(range(len(views)), key=lambda index: index * GOLDEN_RATIO % 1):
        progress.update(f"comparing depth with stereo, photo {len(found) + 1} of {len(views)}")
        known, clock = one.sample(views[number], number), time.perf_counter()
        found[number] = one.compare(known)
        rendering += time.perf_counter() - clock
        if time.perf_counter() - began > seconds / 2:
            break
    images = {number: found[number].figures() for number in sorted(found)}
    overall = Compared(*(torch.cat(parts, dim=1) for parts in zip(*found.values(), strict=True))).figures()
    for number, image in images.items():
        image["name"] = views[number].name
    differing = [number for number, image in images.items() if image["differ"]]
    worst = sorted(differing, key=lambda n: -images[n]["differ"] * images[n]["pixels"])[:SHOWN]
    affordable = overall["pixels"] / rendering * (seconds - (time.perf_counter() - began)) / SHOWN
    (folder / PICTURES).mkdir()
    for number in worst:
        file = Path(views[number].file.removeprefix("images/")).with_suffix(".png").as_posix()
        picture = one.picture(views[number], min(max(affordable, MIN_SHOWN_PIXELS), MAX_SHOWN_PIXELS))
        write_png(folder / PICTURES / file, picture)
        images[number]["picture"] = f"{PICTURES}/{file}"
    result = {"photos_compared": len(found), "photos_train": len(views), "min_difference": MIN_DIFFERENCE} | overall
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


def _panels(photo: np.ndarray, compared: Compared) -> np.ndarray:
    """Four panels (h, w, 3) uint8: the photo beside where depths differ, below them the depths of stereo and field.

    Depths are inverse ones, near red, far blue (turbo), on the scale of stereo's from its 1 % to its 99 % quantile.
    Where they differ is coloured, what is compared is bright.
    """
    known = (compared.stereo > 0).numpy()
    inverse = [1 / each.double().clamp(min=1e-6).numpy() for each in (compared.stereo, compared.field)]
    low, high = np.quantile(inverse[0][known] if known.any() else inverse[1], [0.01, 0.99])
    levels = [np.clip((each - low) / ((high - low) or 1), 0, 1) for each in inverse]
    stereo, field = (colormaps["turbo"](level, bytes=True)[..., :3] for level in levels)
    stereo[~known] = UNKNOWN
    grey = photo.mean(-1, keepdims=True).repeat(3, axis=-1)
    differs = np.where(known[..., None], 100 + 0.6 * grey, 0.3 * grey)
    differs[compared.nearer.numpy()], differs[compared.farther.numpy()] = NEARER, FARTHER
    beside = np.full((len(photo), GAP, 3), 255)
    above, below = (np.hstack([left, beside, right]) for left, right in ((photo, differs), (stereo, field)))
    return np.vstack([above, np.full((GAP, above.shape[1], 3), 255), below]).astype(np.uint8)
