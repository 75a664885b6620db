"""Photos and cameras as training and comparison read them, at any reduction in size."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from nerf.geometry.rays import Rays, rays_of_view
from nerf.geometry.scene import BACKDROP_TOLERANCE
from nerf.training.ray_dataset import PosedViews, RayDataset, make_ray_dataset
from nerf.training.trainer import composite_over
from stages.contract import Inputs, Progress, StageError
from stages.depth.files import depth_map_file, read_depth_map
from stages.effects.track_colours import training_tracks
from stages.io.files import read_tensors
from stages.io.pixel_store import PixelStore, StoredPhoto, fill, pixel_store
from stages.io.pixels import load_mask, load_view, loaders
from stages.sfm.colmap.cameras import camera_rays
from stages.train.config import BLACK, WHITE, Config

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.geometry.scene import Camera, Scene, Split, View

# Along the longer side of a picture. At 1000 pixels the directions are then off by at most 0.002 of them for a phone's
# lens, 0.02 for an action camera's, 0.05 for a fisheye's, and a camera takes 1 MB; twice as many: a quarter, and 4 MB.
MAX_PATCHES = 192
# Of the longer side of a photo as it is scored: the convention of 3D Gaussian Splatting (Kerbl et al. 2023) and of
# nerfbaselines, by which figures of different methods can be compared.
MAX_SCORED_SIDE = 1600
MIN_LONG_SIDE = 150  # pixels of a photo: below this it shows too little to judge anything by
ALL_MASKED = "train.all-masked"  # the error where masks leave no pixel at a size


def scaled_size(camera: "Camera", downscale: float | None) -> tuple[int, int]:
    """(width, height) of a camera's photos made ``downscale`` times smaller, rounded half up, at least one pixel.

    None, here and wherever a ``downscale`` is asked for: the size at which photos are scored, their own one up to
    MAX_SCORED_SIDE pixels of the longer side.
    """
    if downscale is None:
        downscale = max(1.0, max(camera.width, camera.height) / MAX_SCORED_SIDE)
    return max(1, int(camera.width / downscale + 0.5)), max(1, int(camera.height / downscale + 0.5))


@lru_cache(maxsize=2)
def camera_directions(camera: "Camera", downscale: float | None) -> "Tensor":
    """The unit direction vectors (H, W, 3) of a camera's pixel centres at a reduced size; not to be written to.

    The last two answers are kept: photos of one camera mostly follow each other, some of them at two sizes.
    """
    return torch.from_numpy(camera_rays(camera, *scaled_size(camera, downscale)))


def patch_directions(camera: "Camera", downscale: float | None) -> "Tensor":
    """Unit ray directions (rows, columns, 3) of a camera in the middles of the patches that stand for its pixels in a
    ray dataset, MAX_PATCHES along the longer side or one per pixel."""
    width, height = scaled_size(camera, downscale)
    shrink = max(1.0, max(width, height) / MAX_PATCHES)
    return torch.from_numpy(camera_rays(camera, math.ceil(width / shrink), math.ceil(height / shrink)))


def training_dataset(
    ingest: Path, scene: "Scene", split: "Split", downscale: float | None, progress: Progress
) -> RayDataset:
    """All pixels and rays of one split, on the CPU; the pixels are mapped from the pixel store, which is made if need
    be. What masks ignore is never drawn. Raises StageError, ALL_MASKED, where they leave nothing."""
    views, store = scene.of_split(split), _store(ingest, scene, split, downscale)
    channels = 4 if any(view.alpha for view in views) else 0
    at_once = cache(lambda: loaders((ingest / view.file for view in views), channels=channels))  # opens every file
    fill(store, lambda index: _decoded_pixels(ingest, scene, views[index], downscale), at_once, progress)
    used = sorted({view.camera for view in views})

    def directions(index: int) -> "Tensor":
        progress.update(f"rays of camera {index + 1} of {len(used)}", index / len(used))
        return patch_directions(scene.cameras[used[index]], downscale)

    dataset = make_ray_dataset(
        pixels=store.table(progress),
        sizes=[(photo.height, photo.width) for photo in store.photos],
        camera_of=[used.index(view.camera) for view in views],
        camera_directions=[directions(index) for index in range(len(used))],
        posed_views=PosedViews(
            poses=torch.tensor(np.stack([view.scene_from_camera for view in views]), dtype=torch.float32),
            near=torch.tensor([view.near for view in views]),
            far=torch.tensor([view.far for view in views]),
        ),
    )
    if not any(view.mask for view in views):
        return dataset
    masks = _ignored(views, lambda view: view_mask(ingest, scene, view, downscale), at_once())
    return _masked(dataset, masks, split, progress)


def dataset_with_depths(
    inputs: Inputs, scene: "Scene", downscale: float, progress: Progress, depth: Path | None = None
) -> RayDataset:
    """:func:`training_dataset` of the training photos, with the distances of the sparse points that they show, and with
    their depth maps where the folder of stage ``depth`` is given.

    Only points of normalise that at least two training photos saw count, where these saw them."""
    dataset = training_dataset(inputs["ingest"], scene, "train", downscale, progress)
    points = read_tensors(inputs["normalise"] / "points.safetensors")
    tracks, xy = training_tracks(scene, points, most=len(points["view"]))
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    full = np.array([(camera.width, camera.height) for camera in cameras]).reshape(-1, 2)[tracks.view]
    size = np.array([scaled_size(camera, downscale) for camera in cameras]).reshape(-1, 2)[tracks.view]
    column, row = np.clip(np.floor(xy * size / full), 0, size - 1).astype(int).T
    within = torch.from_numpy(row * size[:, 0] + column)
    dataset = dataset.with_sparse_depths(
        dataset.first_pixel[torch.from_numpy(tracks.view)] + within, torch.from_numpy(tracks.distance)
    )
    if depth is None:
        return dataset
    files = [depth_map_file(depth, view.file) for view in scene.of_split("train")]
    return dataset.with_depth_maps([torch.from_numpy(read_depth_map(file).distance) for file in files])


def _ignored(
    views: "Sequence[View]", load: "Callable[[View], Tensor | None]", at_once: int
) -> "Iterator[Tensor | None]":
    """Per view, (H, W) True where its mask ignores the photo; None without a mask. In memory are those being loaded
    and the one before: all masks of many large photos would take more than training does."""
    with ThreadPoolExecutor(at_once) as pool:
        for first in range(0, len(views), at_once):
            for used in pool.map(load, views[first : first + at_once]):
                yield None if used is None else used.logical_not_()


def _masked(dataset: RayDataset, ignored: "Iterable[Tensor | None]", split: "Split", progress: Progress) -> RayDataset:
    kind = "training" if split == "train" else split
    try:
        dataset = dataset.with_masks(ignored)
    except ValueError as error:
        why = f"{error} of the {kind} photos at this size"
        raise StageError(ALL_MASKED, "nothing is left to train on", why, "Give a smaller --train.downscale.") from error
    progress.note(
        "train.masked",
        f"masks leave {dataset.unmasked_count / len(dataset.pixels):.0%} of the pixels of the {kind} photos",
    )
    return dataset


def view_mask(ingest: Path, scene: "Scene", view: "View", downscale: float | None) -> "Tensor | None":
    """Which pixels of a view are to be used, (H, W) bool; None: all of them."""
    if view.mask is None:
        return None
    return torch.from_numpy(load_mask(ingest / view.mask, *scaled_size(scene.cameras[view.camera], downscale)))


def view_rays(scene: "Scene", view: "View", downscale: float | None) -> Rays:
    """One ray per pixel of a view, (H, W), on the CPU."""
    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return rays_of_view(camera_directions(scene.cameras[view.camera], downscale), pose, view.near, view.far)


class PhotoReader:
    """The photos of a scene at 1/``downscale`` of their size, one by one. To be held while many are read: where those
    of a split are stored is told by a look at every one of them, once."""

    def __init__(self, ingest: Path, scene: "Scene", downscale: float | None) -> None:
        self.ingest, self.scene, self.downscale = ingest, scene, downscale
        self._stores: dict[Split, tuple[PixelStore, dict[str, int]]] = {}

    def pixels(self, view: "View", background: Sequence[float]) -> "Tensor":
        """The photo of a view as (H, W, 3) float32 in [0, 1], over ``background`` where it has alpha."""
        pixels = torch.tensor(self._pixels(view)).float() / 255
        alpha = pixels[..., 3] if self.scene.has_alpha else None
        return composite_over(pixels[..., :3], alpha, torch.tensor(background, dtype=torch.float32))

    def _pixels(self, view: "View") -> np.ndarray:
        """The photo of a view as uint8, out of the pixel store where that is there."""
        if view.split not in self._stores:
            store = _store(self.ingest, self.scene, view.split, self.downscale)
            self._stores[view.split] = store, {photo.file: index for index, photo in enumerate(store.photos)}
        store, places = self._stores[view.split]
        stored = store.photo(places[view.file]) if store.is_whole else None
        return _decoded_pixels(self.ingest, self.scene, view, self.downscale) if stored is None else stored


def _store(ingest: Path, scene: "Scene", split: "Split", downscale: float | None) -> PixelStore:
    """Where the pixels of one split at this size are kept, whether or not they are there yet."""
    views = scene.of_split(split)
    photos = [StoredPhoto(view.file, *scaled_size(scene.cameras[view.camera], downscale), view.alpha) for view in views]
    return pixel_store(ingest, split, photos, 4 if scene.has_alpha else 3)


def _decoded_pixels(ingest: Path, scene: "Scene", view: "View", downscale: float | None) -> np.ndarray:
    """The photo of a view as uint8: (H, W, 4) in a scene with alpha, else (H, W, 3) as it is below its alpha."""
    pixels = load_view(ingest, view, *scaled_size(scene.cameras[view.camera], downscale))
    if scene.has_alpha and pixels.shape[2] == 3:  # a photo without transparent parts covers every pixel
        return np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], axis=2)
    return pixels if scene.has_alpha else np.ascontiguousarray(pixels[..., :3])


def training_background(config: Config, scene: "Scene") -> tuple[float, float, float] | Literal["random"]:
    """What lies behind the scene while training; random only where alpha says how much of it is seen."""
    return "random" if scene.has_alpha and config.background == "random" else field_background(config, scene)


def field_background(config: Config, scene: "Scene") -> tuple[float, float, float]:
    """What the finished field is shown over, unless it has a background model. Without alpha that is what the photos
    show behind all; if they do not tell, they fill every ray, and what a field leaves open is black, as published."""
    if scene.backdrop is not None:
        return scene.backdrop
    return WHITE if scene.has_alpha and config.background != "black" else BLACK


def backdrop_tolerance(config: Config, scene: "Scene") -> float:
    """Within how much of the backdrop's colour a photo shows that nothing is there, of 1; 0: no photo does."""
    return 0.0 if scene.backdrop is None or has_background_model(config, scene) else BACKDROP_TOLERANCE / 255


def has_background_model(config: Config, scene: "Scene") -> bool:
    """Whether something is seen at infinity: where space has no end, and no alpha tells what is seen of it."""
    return config.space != "bounded" and not scene.has_alpha
