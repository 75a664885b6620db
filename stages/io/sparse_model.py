"""A sparse reconstruction in plain numpy: cameras, poses, points, and which image sees which point where."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from nerf.geometry.scene import Camera

EDGE_ON = 1e-6  # of its distance: a point less deep than this is beside the camera, where no lens looks


@dataclass(frozen=True)
class SparseImage:
    """A registered photo: its file relative to ingest's ``images/``, its camera, its pose."""

    file: str
    camera: int  # index into SparseModel.cameras
    sfm_from_camera: Float[np.ndarray, "3 4"]


@dataclass(frozen=True)
class SparseModel:
    """A sparse reconstruction in the sfm frame; images in order of ``file``, points in order of COLMAP's ids.

    Observation k says that image ``view[k]`` sees point ``point[k]`` at pixel ``xy[k]``; by view, then keypoint.
    """

    cameras: list[Camera]
    images: list[SparseImage]
    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"]
    error_px: Float[np.ndarray, "points"]
    view: Int[np.ndarray, "observations"]
    point: Int[np.ndarray, "observations"]
    xy: Float[np.ndarray, "observations 2"]

    @classmethod
    def without_points(cls, cameras: list[Camera], images: list[SparseImage]) -> "SparseModel":
        """Cameras alone; ``images`` in order of ``file``."""
        none = np.zeros(0, int)
        return cls(
            cameras, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), none, none, np.zeros((0, 2))
        )

    def without_points_behind(self) -> tuple["SparseModel", int]:
        """This model without the observations whose point does not lie in front of its camera, and how many those are.
        Points that nobody sees any more are left out, too."""
        poses = np.array([image.sfm_from_camera for image in self.images]).reshape(-1, 3, 4)[self.view]
        away = self.xyz[self.point] - poses[:, :, 3]
        depth = np.einsum("ni,ni->n", away, poses[:, :, 2])
        front = depth > EDGE_ON * np.linalg.norm(away, axis=1)
        points, point = np.unique(self.point[front], return_inverse=True)
        model = SparseModel(
            self.cameras,
            self.images,
            self.xyz[points],
            self.rgb[points],
            self.error_px[points],
            self.view[front],
            point,
            self.xy[front],
        )
        return model, int((~front).sum())

    def restricted(
        self,
        kept: Sequence[int],
        pixel_maps: Sequence[Float[np.ndarray, "2 3"]],
        cameras: list[Camera],
        images: list[SparseImage],
    ) -> "SparseModel":
        """What ``images``, which stand for the images ``kept`` of this model, see of its points.

        ``pixel_maps`` take pixels (x, y, 1) of the old images to pixels of the new ones.
        """
        bounds = np.searchsorted(self.view, np.arange(len(self.images) + 1))
        own = [slice(bounds[index], bounds[index + 1]) for index in kept]
        view = np.repeat(np.arange(len(kept)), [part.stop - part.start for part in own])
        points, point = np.unique(np.concatenate([self.point[part] for part in own]), return_inverse=True)
        xy = [self.xy[part] @ pixels[:, :2].T + pixels[:, 2] for part, pixels in zip(own, pixel_maps, strict=True)]
        return SparseModel(
            cameras, images, self.xyz[points], self.rgb[points], self.error_px[points], view, point, np.concatenate(xy)
        )
