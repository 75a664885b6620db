"""What the page holds: the field in few bits and what that costs, cameras, small photos, sparse points, the mesh."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image

from nerf.effects import ColourEffect
from nerf.effects.exposure import ExposureModel
from nerf.effects.vignetting import VignettingModel
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.scene import Camera, Scene, View
from nerf.training.psnr import mean_squared_error, psnr
from stages.contract import Inputs, Progress, StageError
from stages.effects.image_effects import new_view_effects, new_view_words, photo_effects
from stages.hardware.device import processors
from stages.io.files import SMALL_COPY, read_json, read_scene, read_tensors
from stages.io.photos import spread
from stages.render.path import median_camera
from stages.render.renderer import Renderer, load_renderer
from stages.scale import metres_per_unit
from stages.sfm.colmap.cameras import focal_lengths_and_centre, project
from stages.train.data import PhotoReader, view_rays
from stages.viewer.tables import FEATURES, Bits, Table, description, quantised, sections, with_table

if TYPE_CHECKING:
    from stages.viewer import Config

MAX_LOSS_DB = 0.05  # of held-out PSNR, by 8 bits
COMPARED_VIEWS, COMPARED_SIDE = 4, 160  # held-out photos by which that is measured, pixels of their longer side
MAX_PHOTO_BYTES, MAX_PHOTO_SIDE, MIN_PHOTO_SIDE = 600_000, 320, 96  # of all small photos; of one's longer side
PHOTO_BYTES_PER_PIXEL = 0.2  # of JPEG at this quality, about
PHOTO_QUALITY = 75
MAX_POINTS = 15_000
PALETTE_SIZE = 256


@dataclass(frozen=True)
class Contents:
    """``header`` in JSON and binary ``sections`` by name; ``loss_db`` is what the bits cost. A field that browsers
    cannot draw has neither sections nor a table, and the page says why."""

    header: dict[str, Any]
    sections: dict[str, bytes]
    loss_db: float | None


class Comparison(NamedTuple):
    """PSNR of held-out photos with the field as it was trained, and in the page's bits."""

    views: int
    trained_db: float
    packed_db: float

    @property
    def loss_db(self) -> float:
        """What the bits cost."""
        return self.trained_db - self.packed_db


def load(config: "Config", inputs: Inputs, progress: Progress) -> Contents:
    """Everything, read and packed."""
    field, scene = read_json(inputs["train"] / "field.json"), read_scene(inputs["normalise"])
    renderer = load_renderer(inputs["train"], progress=progress)
    if not isinstance(renderer.field, HashGridField):
        why = "it renders only hash-grid fields, because a vanilla NeRF is over 100 times as much work per sample"
        progress.note("viewer.not-rendered", f"viewer.html cannot show this field: {why}")
        return Contents({"field": None}, {}, None)
    if renderer.field.settings.features_per_level != FEATURES:
        raise StageError(
            "viewer.features",
            "cannot pack the field",
            f"its levels have {renderer.field.settings.features_per_level} features each, not {FEATURES}",
            "Train it again with this version: pipeline train WORKSPACE --force",
        )
    table, comparison = _table(config, inputs, renderer, field, scene, progress)
    parts = sections(renderer.field, table) | {"palette": palette()} | sparse_points(inputs)
    mesh, of_mesh = small_mesh(inputs)
    parts |= of_mesh
    header = {
        "field": description(renderer.field, table)
        | gains_of(new_view_effects(field))
        | {"background": field["background"]},
        "scene": scene_header(scene, inputs),
        "exposure": "exposure" in field["effects"],
        "appearance": new_view_words(field),
        "comparison": comparison._asdict(),
        "inverse_depth": _inverse_depths(renderer, scene),
        "mesh": mesh,
        "views": [view_header(scene, view, field) for view in scene.views],
    }
    if config.photos == "on":
        progress.update("shrinking the photos", 0.5)
        photos = _photos(scene, PhotoReader(inputs["ingest"], scene, field["downscale"]), field["background"])
        parts |= {f"photo{index}": photo for index, photo in enumerate(photos)}
    return Contents(header, parts, comparison.loss_db)


# --- the field


def _table(
    config: "Config", inputs: Inputs, renderer: Renderer, info: dict[str, Any], scene: Scene, progress: Progress
) -> tuple[Table, Comparison]:
    """The table in 8 bits a number, or in 16 where these lose more than MAX_LOSS_DB, or as asked for."""
    field = renderer.field
    assert isinstance(field, HashGridField)

    def packed(bits: Bits) -> tuple[Table, Comparison]:
        progress.update(f"comparing {bits} bits with the trained field", 0.1)
        table = quantised(field.layout, field.table, bits)
        return table, _compared(renderer, with_table(field, table), info, scene, inputs)

    if config.bits == "16":
        return packed(16)
    chosen = packed(8)
    return packed(16) if config.bits == "auto" and chosen[1].loss_db > MAX_LOSS_DB else chosen


def _compared(
    renderer: Renderer, packed: HashGridField, info: dict[str, Any], scene: Scene, inputs: Inputs
) -> Comparison:
    """Of a few test photos, reduced; of training photos where there are none."""
    views = scene.of_split("test") or scene.of_split("train")
    views = [views[index] for index in sorted(set(spread(len(views), COMPARED_VIEWS)))]
    scores = []
    for view in views:
        camera = scene.cameras[view.camera]
        downscale = max(1.0, max(camera.width, camera.height) / COMPARED_SIDE)
        truth = PhotoReader(inputs["ingest"], scene, downscale).pixels(view, info["background"])
        rays, effects = view_rays(scene, view, downscale), photo_effects(info, scene, view, renderer.device)
        shown = (replace(renderer, model=field).through(effects).render(rays) for field in (renderer.field, packed))
        scores.append([psnr(mean_squared_error(each.colour.clamp(0, 1), truth)) for each in shown])
    trained, of_packed = np.mean(scores, axis=0)
    return Comparison(len(views), float(trained), float(of_packed))


def gains_of(effects: tuple[ColourEffect, ...]) -> dict[str, list[float]]:
    """``log_gain`` on the optical axis, per channel, and ``falloff`` from there: vignetting's three coefficients and
    1 / (4 sin²(θ/2)) of the corner."""
    log_gain, falloff = np.zeros(3), [0.0] * 4
    for effect in effects:
        if isinstance(effect, ExposureModel):
            log_gain += effect.log_gain[0].cpu().double().numpy()
        elif isinstance(effect, VignettingModel):
            on_axis = effect.mean_log_gain[0] + effect.falloff[0] @ effect.mean_terms
            log_gain += float(on_axis)
            falloff = [*effect.falloff[0].tolist(), float(effect.per_corner[0])]
        else:
            what, why = "cannot pack the field", f"no shader knows the effect {effect.name}"
            raise StageError("viewer.effect", what, why, f"Run again with --effect {effect.name}=off.")
    return {"log_gain": log_gain.tolist(), "falloff": falloff}


# --- what was photographed


def scene_header(scene: Scene, inputs: Inputs) -> dict[str, Any]:
    usual, sfm_from_scene = median_camera(scene), scene.scene_from_sfm.inverse()
    metres = metres_per_unit(inputs["scale"]) if "scale" in inputs else None  # while it trains
    return {
        "bounded": scene.bounded,
        "has_alpha": scene.has_alpha,
        "up": _up(scene),
        "up_known": scene.up_known,
        "forward_facing": scene.capture_type == "forward-facing",
        "sfm_from_scene": sfm_from_scene.matrix().tolist(),
        "metres_per_unit": metres and metres * sfm_from_scene.scale,
        "lens": _lens(usual),
    }


def _up(scene: Scene) -> list[float]:
    """+z where an up is known, else the mean of the cameras' own."""
    mean = -np.mean([view.scene_from_camera[:, 1] for view in scene.views], axis=0)
    length = float(np.linalg.norm(mean))
    return [0.0, 0.0, 1.0] if scene.up_known or length < 0.1 else (mean / length).tolist()


def _lens(camera: Camera) -> list[float]:
    """Width, height, focal lengths and principal point of a camera without its distortion."""
    focal, centre = focal_lengths_and_centre(camera)
    width, height = camera.width, camera.height
    focal, centre = focal or [width / 2], centre or [width / 2, height / 2]  # a panorama has neither
    return [width, height, focal[0], focal[-1], *centre]


def view_header(scene: Scene, view: View, field: dict[str, Any]) -> dict[str, Any]:
    """A camera with its photo's own exposure and vignetting."""
    return {
        "name": view.name,
        "split": view.split,
        "pose": view.scene_from_camera.tolist(),
        "lens": _lens(scene.cameras[view.camera]),
        "near_far": [view.near, view.far],
    } | gains_of(photo_effects(field, scene, view))


def _inverse_depths(renderer: Renderer, scene: Scene) -> list[float]:
    """From which to which inverse depth colours go: the 1 % and 99 % quantiles of what a few photos show."""
    views = [scene.views[index] for index in sorted(set(spread(len(scene.views), COMPARED_VIEWS)))]
    inverse = []
    for view in views:
        camera = scene.cameras[view.camera]
        rendering = renderer.render(view_rays(scene, view, max(camera.width, camera.height) / (COMPARED_SIDE // 4)))
        inverse.append((1 / rendering.depth).flatten())
    low, high = np.quantile(torch.cat(inverse).numpy(), [0.01, 0.99])
    return [float(low), float(high) if high > low else float(low) + 1.0]


def palette() -> bytes:
    """The colours of depth, far to near (turbo), as RGBA."""
    bgr = cv2.applyColorMap(np.arange(PALETTE_SIZE, dtype=np.uint8)[None], cv2.COLORMAP_TURBO)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGBA).tobytes()


def sparse_points(inputs: Inputs) -> dict[str, bytes]:
    """Sparse points, MAX_POINTS of them at most, evenly among all."""
    points = read_tensors(inputs["normalise"] / "points.safetensors")
    chosen = spread(len(points["xyz"]), min(MAX_POINTS, len(points["xyz"])))
    xyz, rgb = points["xyz"][chosen].astype(np.float32), points["rgb"][chosen].astype(np.uint8)
    return {"points_xyz": xyz.tobytes(), "points_rgb": rgb.tobytes()}


def small_mesh(inputs: Inputs) -> tuple[dict[str, Any] | None, dict[str, bytes]]:
    """What stage mesh left for pages, and the sphere in which its positions are given; None without one."""
    file = inputs["mesh"] / SMALL_COPY if "mesh" in inputs else None
    if file is None or not file.exists():
        return None, {}
    small = read_tensors(file)
    header = {
        "middle": small["middle"].tolist(),
        "radius": float(small["radius"][0]),
        "faces": len(small["faces"]),
    }
    return header, {f"mesh_{name}": small[name].tobytes() for name in ("positions", "faces", "colours")}


def photo_side(count: int) -> int:
    """The longer side of so many small photos that take MAX_PHOTO_BYTES together."""
    side = math.sqrt(MAX_PHOTO_BYTES / max(1, count) / PHOTO_BYTES_PER_PIXEL / 0.75)
    return int(min(MAX_PHOTO_SIDE, max(MIN_PHOTO_SIDE, side)))


def _photos(scene: Scene, reader: PhotoReader, background: list[float]) -> list[bytes]:
    """Small JPEGs of all photos as their cameras would have taken them without distortion, which the page ignores."""
    side = photo_side(len(scene.views))

    def small(view: View) -> bytes:
        pixels = (reader.pixels(view, background) * 255).round().byte().numpy()
        stream = BytesIO()
        picture = _undistorted(pixels, scene.cameras[view.camera], side)
        Image.fromarray(picture).save(stream, format="JPEG", quality=PHOTO_QUALITY)
        return stream.getvalue()

    with ThreadPoolExecutor(processors()) as pool:
        return list(pool.map(small, scene.views))


def _undistorted(pixels: np.ndarray, camera: Camera, side: int) -> np.ndarray:
    """A photo at a longer side of ``side``, its pixels where a pinhole of the same focal lengths has them."""
    shrink = max(camera.width, camera.height) / side
    width, height = max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink))
    if (pixels.shape[1], pixels.shape[0]) != (width, height):
        pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return pixels
    *_, fx, fy, cx, cy = _lens(camera)
    x, y = np.meshgrid(
        (np.arange(width) + 0.5) * camera.width / width, (np.arange(height) + 0.5) * camera.height / height
    )
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1).reshape(-1, 3)
    at = project(camera, rays).reshape(height, width, 2) * [width / camera.width, height / camera.height] - 0.5
    at = np.where(np.isfinite(at), at, -1e4).astype(np.float32)
    return cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
