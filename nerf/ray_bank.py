"""All pixels of a set of photos, and what it takes to turn any of them into a ray.

Photos may differ in size and camera. They are laid end to end: a *pixel* index counts through all of them, row
by row. Pixels stay uint8 and bearing vectors are stored once per camera, so that a hundred photos of two
megapixels take 0.6 GB and not 8.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf.rays import Rays


class RayBank(NamedTuple):
    """Photos as one table of pixels; make it with :func:`build_ray_bank`.

    View v owns the pixels [first_pixel[v], first_pixel[v + 1]); its bearing vectors start at
    ``directions[first_direction[v]]``, in the same order. ``pixels`` have 3 channels, or 4 with a straight (not
    premultiplied) alpha.
    """

    pixels: UInt8[Tensor, "pixels channels"]
    directions: Float[Tensor, "bearings 3"]
    first_pixel: Int[Tensor, "views_and_end"]
    first_direction: Int[Tensor, "views"]
    poses: Float[Tensor, "views 3 4"]
    near: Float[Tensor, "views"]
    far: Float[Tensor, "views"]

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self.pixels.device

    def to(self, device: torch.device | str) -> "RayBank":
        """This bank with its tables on ``device``."""
        return RayBank(*(table.to(device) for table in self))

    def lookup(self, pixel: Int[Tensor, "rays"]) -> tuple[Rays, Float[Tensor, "rays 3"], Float[Tensor, "rays"] | None]:
        """The rays through given pixels, with the pixels' colours and alpha in [0, 1] (None without a channel)."""
        view = torch.searchsorted(self.first_pixel, pixel, right=True) - 1
        within = pixel - self.first_pixel[view]
        in_camera = self.directions[self.first_direction[view] + within]
        pose = self.poses[view]
        directions = (pose[:, :, :3] @ in_camera[:, :, None])[:, :, 0]
        rays = Rays(pose[:, :, 3], directions, self.near[view], self.far[view])
        values = self.pixels[pixel].float() / 255
        return rays, values[:, :3], values[:, 3] if values.shape[1] == 4 else None

    def sample(
        self, count: int, generator: torch.Generator
    ) -> tuple[Rays, Float[Tensor, "rays 3"], Float[Tensor, "rays"] | None]:
        """:meth:`lookup` of ``count`` pixels drawn uniformly, with replacement."""
        pixel = torch.randint(len(self.pixels), (count,), generator=generator, device=self.device)
        return self.lookup(pixel)


def build_ray_bank(
    photos: Sequence[UInt8[Tensor, "_ _ channels"]],
    camera_of: Sequence[int],
    camera_directions: Sequence[Float[Tensor, "_ _ 3"]],
    poses: Float[Tensor, "views 3 4"],
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
) -> RayBank:
    """Lay photos end to end.

    Args:
        photos: one (height, width, channels) picture per view, all with 3 or all with 4 channels.
        camera_of: per view, the index of its camera in ``camera_directions``.
        camera_directions: per camera, (height, width, 3) unit bearing vectors of the pixel centres (camera frame).
        poses: scene_from_camera of every view.
        near, far: distances along the unit ray, per view.

    Raises:
        ValueError: if there are no photos or one has another size than its camera.
    """
    if not photos:
        raise ValueError("a ray bank needs at least one photo")
    for view, (photo, camera) in enumerate(zip(photos, camera_of, strict=True)):
        if photo.shape[:2] != camera_directions[camera].shape[:2]:
            sizes = f"{tuple(photo.shape[:2])}, its camera {camera} {tuple(camera_directions[camera].shape[:2])}"
            raise ValueError(f"photo {view} has size {sizes}")
    first_bearing = _starts([directions.shape[0] * directions.shape[1] for directions in camera_directions])
    return RayBank(
        pixels=torch.cat([photo.flatten(0, 1) for photo in photos]),
        directions=torch.cat([directions.flatten(0, 1) for directions in camera_directions]),
        first_pixel=_starts([photo.shape[0] * photo.shape[1] for photo in photos]),
        first_direction=first_bearing[torch.tensor(camera_of)],
        poses=poses,
        near=near,
        far=far,
    )


def _starts(counts: list[int]) -> Int[Tensor, "counts_and_end"]:
    """Where each of several runs of ``counts`` items begins, and at last where the last one ends."""
    return torch.cat([torch.zeros(1, dtype=torch.int64), torch.tensor(counts).cumsum(0)])
