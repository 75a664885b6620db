"""The training photos of a scene as depth maps are made of them: viewpoints, pixels, and which pairs are matched."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.sparse import csr_matrix

from nerf.geometry.reconstruction import observations_by_view
from nerf.geometry.scene import Scene, View
from stages.contract import Inputs, StageError
from stages.depth.consistency import SparseDepths
from stages.depth.neighbours import Tracks, choose_pairs, depth_range, tracks_of
from stages.depth.rectification import CannotRectify, Pixels, Rectified, Viewpoint, rectify
from stages.io.files import read_scene, read_tensors
from stages.io.pixels import OPAQUE_FROM, even_contrast, load_mask, load_pixels, load_view
from stages.sfm.colmap.cameras import camera_rays

MAX_DISPARITIES = 512  # of a pair: a surface closer than that is not found by it
CONTRAST_WINDOW, CONTRAST_NOISE = 7, 4.0  # pixels; grey values: less contrast is not stretched
KEPT_PHOTOS = 48  # in memory, decoded: neighbours mostly follow each other


def _nearby(values: np.ndarray) -> np.ndarray:
    return cv2.blur(values, (CONTRAST_WINDOW, CONTRAST_WINDOW), borderType=cv2.BORDER_REFLECT)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """OpenCV's own threads are off: pairs and photos are given to the cores instead."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@dataclass(frozen=True)
class TrainingPhotos:
    """The training photos of a scene at 1/``downscale`` of their size, by their number among themselves."""

    ingest: Path
    scene: Scene
    points: Mapping[str, np.ndarray]
    downscale: float

    def __getstate__(self) -> dict[str, object]:
        """As they travel to another process: without what is cached."""
        return {each.name: self.__dict__[each.name] for each in fields(self)}

    @cached_property
    def tracks(self) -> Tracks:
        return tracks_of(self.scene, self.scene.indices_of("train"), self.points)

    @cached_property
    def _sees(self) -> csr_matrix:
        return self.tracks.sees(len(self.views))

    @cached_property
    def _observations(self) -> list[np.ndarray]:
        """Of each photo the numbers of its observations among those of the points."""
        of_views = observations_by_view(self.points["view"], len(self.scene.views))
        return [of_views[index] for index in self.scene.indices_of("train")]

    @cached_property
    def views(self) -> tuple[View, ...]:
        return self.scene.of_split("train")

    @cached_property
    def poses(self) -> Float[np.ndarray, "n 3 4"]:
        return np.stack([view.scene_from_camera for view in self.views])

    @cached_property
    def viewpoints(self) -> list[Viewpoint]:
        """From where each photo was taken; those of one camera share their rays."""
        rays = {index: self._rays(index) for index in {view.camera for view in self.views}}
        return [Viewpoint(self.scene.cameras[v.camera], v.scene_from_camera, rays[v.camera]) for v in self.views]

    def _rays(self, index: int) -> Float[np.ndarray, "h w 3"]:
        camera = self.scene.cameras[index]
        width, height = (max(1, int(side / self.downscale + 0.5)) for side in (camera.width, camera.height))
        return camera_rays(camera, width, height)

    @cached_property
    def pixels(self) -> Callable[[int], Pixels]:
        """By a photo's number its grey pixels of even contrast, and what masks and transparency leave of them."""
        return lru_cache(KEPT_PHOTOS)(self._pixels)

    @cached_property
    def colours(self) -> Callable[[int], UInt8[np.ndarray, "h w 3"]]:
        """By a photo's number the photo itself, sRGB; each is looked up from many others."""
        return lru_cache(KEPT_PHOTOS)(self._colours)

    def _pixels(self, number: int) -> Pixels:
        view, (width, height) = self.views[number], self.viewpoints[number].size
        pixels = load_view(self.ingest, view, width, height)
        used = np.ones((height, width), bool)
        if self.scene.has_alpha and pixels.shape[2] == 4:
            used &= pixels[..., 3] >= OPAQUE_FROM
        if view.mask is not None:
            used &= load_mask(self.ingest / view.mask, width, height)
        grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
        return Pixels(even_contrast(grey, _nearby, CONTRAST_NOISE), used)

    def _colours(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        width, height = self.viewpoints[number].size
        return np.ascontiguousarray(load_pixels(self.ingest / self.views[number].file, width, height)[..., :3])

    def sparse_depths(self, number: int) -> SparseDepths:
        """The sparse points that a photo shows."""
        viewpoint = self.viewpoints[number]
        seen = self._observations[number]
        at = (self.points["xy"][seen] * viewpoint.scale).astype(int)
        column, row = np.clip(at, 0, np.array(viewpoint.size) - 1).T
        towards = self.points["xyz"][self.points["point"][seen]] - viewpoint.scene_from_camera[:, 3]
        return SparseDepths(row, column, np.linalg.norm(towards, axis=1))

    def rectified(self, one: int, other: int) -> Rectified:
        """The rectified pair. Raises CannotRectify."""
        depths = depth_range(self.poses, self.tracks.points, self._sees, (one, other), self.views)
        return rectify(self.viewpoints[one], self.viewpoints[other], depths, MAX_DISPARITIES)

    def pairs(self, neighbours: int) -> tuple[dict[tuple[int, int], Rectified], dict[tuple[int, int], str]]:
        """The pairs to be matched, and those left out with the reason."""
        found, left_out = dict[tuple[int, int], Rectified](), dict[tuple[int, int], str]()

        def usable(one: int, other: int) -> bool:
            pair = (one, other)
            try:
                if pair not in found and pair not in left_out:
                    found[pair] = self.rectified(*pair)
            except CannotRectify as why:
                left_out[pair] = str(why)
            return pair in found

        return {pair: found[pair] for pair in choose_pairs(self.poses, self.tracks, neighbours, usable)}, left_out


def read_training_photos(inputs: Inputs, downscale: float) -> TrainingPhotos:
    """The training photos of a scene. Raises StageError where a pose is not finite."""
    scene = read_scene(inputs["normalise"])
    for index in scene.indices_of("train"):
        if not np.isfinite(scene.views[index].scene_from_camera).all():
            what = f"the pose of {scene.views[index].name} is not finite"
            hint = "Make it again: pipeline normalise WORKSPACE --force"
            raise StageError("depth.pose-not-finite", what, "scene.json holds NaN or infinity", hint)
    points = read_tensors(inputs["normalise"] / "points.safetensors")
    return TrainingPhotos(inputs["ingest"], scene, points, downscale)
