"""Rays in the scene frame: origin, unit direction, near, far."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Rays(NamedTuple):
    """A batch of rays; ``near`` and ``far`` are distances along the unit ``directions`` in scene units."""

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    near: Float[Tensor, "*rays"]
    far: Float[Tensor, "*rays"]

    def each(self, change: Callable[[Tensor], Tensor]) -> "Rays":
        """Each of the four changed alike: cut, moved, reshaped."""
        return Rays(*map(change, self))


def join_rays(batches: Iterable[Rays], dim: int = 0) -> Rays:
    """One batch of several, one after the other along ``dim``."""
    return Rays(*(torch.cat(parts, dim) for parts in zip(*batches, strict=True)))


def rays_of_view(
    camera_directions: Float[Tensor, "*pixels 3"],
    scene_from_camera: Float[Tensor, "3 4"],
    near: float,
    far: float,
) -> Rays:
    """Turn a camera's unit ray directions (one per pixel centre, camera frame) into rays of one view."""
    directions = camera_directions @ scene_from_camera[:, :3].T
    origins = scene_from_camera[:, 3].expand_as(directions)
    return Rays(
        origins,
        directions,
        torch.full_like(directions[..., 0], near),
        torch.full_like(directions[..., 0], far),
    )


def points_on(rays: Rays, t: Float[Tensor, "*rays n"]) -> Float[Tensor, "*rays n 3"]:
    """The points at distances ``t`` along the rays."""
    return rays.origins[..., None, :] + t[..., None] * rays.directions[..., None, :]


def clip_to_box(rays: Rays, low: float | Float[Tensor, "3"], high: float | Float[Tensor, "3"]) -> Rays:
    """Cut [near, far] to the box between the corners ``low`` and ``high`` (the slab method of Kay and Kajiya 1986).

    A ray that misses the box between near and far gets the empty interval near = far = its old far. The interval
    says where to look, not what is seen: it carries no gradient.
    """
    with torch.no_grad():
        # A component of 0 would give 0/0 for an origin on a face; the smallest normal number gives the same slabs.
        smallest = torch.finfo(rays.directions.dtype).tiny
        directions = torch.where(rays.directions == 0, smallest, rays.directions)
        first, second = (low - rays.origins) / directions, (high - rays.origins) / directions
        near = torch.maximum(rays.near, torch.minimum(first, second).amax(-1))
        far = torch.minimum(rays.far, torch.maximum(first, second).amin(-1))
        hit = near < far
        return rays._replace(near=torch.where(hit, near, rays.far), far=torch.where(hit, far, rays.far))
