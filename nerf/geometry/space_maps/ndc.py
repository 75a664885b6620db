"""Normalised device coordinates (NDC): the space map of cameras that face one way (Mildenhall et al. 2020, appendix C).

All that they can see, to infinity, fills the cube. Straight lines stay straight, so rays are mapped once and marched by
equal steps. Densities are per scene unit, other than in the paper: so they do not depend on the direction, and a field
begins thin before the cameras, where the cube is large and little is known.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf import REGION_HALF_SIZE
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.mapped_rays import Line, MappedRays

# Of the near plane's depth: points nearer to the apex's plane than this, or behind it, are mapped as if they were here,
# far outside of the cube.
MIN_DEPTH = 1e-3
MAX_ANGLE_DEG = 75.0  # of a ray off the mean axis, for a pyramid to hold it; at 90 it would be as wide as space
AXES_TOLERANCE = 1e-6  # axes were read from JSON with all digits; what is farther off is no rotation


@dataclass(frozen=True)
class Ndc:
    """The pyramid that a virtual camera at ``apex`` sees beyond the depth ``near``, in (-0.9, 0.9)³.

    ``axes``: the camera's x (right), y (down) and z (forward) in the scene frame. ``slopes``: how far the pyramid
    reaches to the side at depth 1, along x and y. A point at depth Z goes to half (X / (Z slope_x), Y / (Z slope_y),
    1 - 2 near / Z): appendix C with the signs of our axes. The far plane is at infinity, where the cube ends.
    """

    apex: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    slopes: tuple[float, float]
    near: float
    kind: Literal["ndc"] = "ndc"
    half: ClassVar[float] = REGION_HALF_SIZE
    bends_rays: ClassVar[bool] = False
    unbounded: ClassVar[bool] = True

    def __post_init__(self) -> None:
        axes = np.array(self.axes)
        if axes.shape != (3, 3) or not np.allclose(axes @ axes.T, np.eye(3), atol=AXES_TOLERANCE):
            raise ValueError(f"the axes of the pyramid are {self.axes}; they must be three at right angles")
        if not (np.isfinite(self.apex).all() and all(0 < each < math.inf for each in (*self.slopes, self.near))):
            raise ValueError(
                f"slopes {self.slopes} and near {self.near} must be positive numbers, apex {self.apex} finite"
            )

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Of scene points; those before the near plane, or behind the apex, are far outside of the cube."""
        local = self._local(points)
        return self._projected(local[..., :2], local[..., 2].clamp(min=MIN_DEPTH * self.near))

    def inverse(self, mapped: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """The scene points again, within the open cube; on its far face they are at infinity."""
        x, y, z = mapped.unbind(-1)
        depth = 2 * self.near / (1 - z / self.half)
        sideways = (each * (slope / self.half) * depth for each, slope in zip((x, y), self.slopes, strict=True))
        return torch.stack([*sideways, depth], -1) @ self._matrix(mapped) + _constant(self.apex, mapped)

    def pull_back(
        self, points: Float[Tensor, "*points 3"], grad: Float[Tensor, "*points 3"]
    ) -> Float[Tensor, "*points 3"]:
        """Gradients of scene points from those of mapped ones: with the transposed Jacobian of :meth:`forward`."""
        x, y, z = self._local(points).unbind(-1)
        least = MIN_DEPTH * self.near
        inverse = 1 / z.clamp(min=least)
        along_x, along_y = (grad[..., axis] * inverse * (self.half / slope) for axis, slope in enumerate(self.slopes))
        forward = 2 * self.half * self.near * inverse * grad[..., 2] - along_x * x - along_y * y
        along_z = torch.where(z < least, 0, forward * inverse)
        return torch.stack([along_x, along_y, along_z], -1) @ self._matrix(grad)

    def scene_length(self, mapped: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """Length in the scene for a length in the cube along the line of sight from the apex, at mapped points within
        the open cube."""
        points = self.inverse(mapped) - _constant(self.apex, mapped)
        depth = 2 * self.near / (1 - mapped[..., 2] / self.half)
        return depth * points.norm(dim=-1) / (2 * self.half * self.near)

    def map_rays(self, rays: Rays) -> MappedRays:
        """Rays as straight lines through the cube, each from where it has passed the near plane, with distances of the
        cube. What is behind that plane for good has no length."""
        matrix = self._matrix(rays.origins)
        origins, directions = (rays.origins - _constant(self.apex, rays.origins)) @ matrix.T, rays.directions @ matrix.T
        slope = directions[..., 2]
        with torch.no_grad():  # the interval says where to look, not what is seen
            # Where it passes the near plane, be it to the front or to the back; nowhere if it runs along it.
            passes = (self.near - origins[..., 2]) / torch.where(slope == 0, torch.finfo(slope.dtype).tiny, slope)
            start = torch.where(slope > 0, torch.maximum(rays.near, passes), rays.near)
            far = torch.where(slope < 0, torch.minimum(rays.far, passes), rays.far)
        at_start = origins + start[..., None] * directions
        # The plane is met to rounding: a ray that starts there starts in the cube.
        depth = torch.where(start > rays.near, at_start[..., 2].clamp(min=self.near), at_start[..., 2])
        seen = (start < far) & (depth >= self.near)
        depth = depth.clamp(min=self.near)
        at = self._projected(at_start[..., :2], depth)
        towards = directions[..., :2] * self._scale(rays.origins) - at[..., :2] * slope[..., None]
        velocity = torch.cat([towards, ((self.half - at[..., 2]) * slope)[..., None]], -1)
        speed = velocity.norm(dim=-1)
        line = Line(torch.where(seen, start, rays.far), depth, slope, speed)
        length = torch.where(seen, MappedRays(rays, line).from_scene(far), 0)
        return MappedRays(Rays(at, velocity / speed[..., None], torch.zeros_like(length), length), line)

    def _projected(
        self, sideways: Float[Tensor, "*points 2"], depth: Float[Tensor, "*points"]
    ) -> Float[Tensor, "*points 3"]:
        """Points in the cube of those in the camera frame of the apex, by their x, y and positive depth."""
        forward = self.half * (1 - 2 * self.near / depth)
        return torch.cat([sideways * self._scale(sideways) / depth[..., None], forward[..., None]], -1)

    def _scale(self, like: Tensor) -> Float[Tensor, "2"]:
        return _constant(tuple(self.half / each for each in self.slopes), like)

    def _matrix(self, like: Tensor) -> Float[Tensor, "3 3"]:
        return _constant(self.axes, like)

    def _local(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        return (points - _constant(self.apex, points)) @ self._matrix(points).T


def _constant(values: tuple[Any, ...], like: Tensor) -> Tensor:
    return _tensor(values, like.dtype, like.device)


@functools.cache
def _tensor(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Made once: to copy numbers to a GPU the host waits for it, which a CUDA graph may not."""
    with torch.inference_mode(False):  # for whoever comes first may not need gradients
        return torch.tensor(values, dtype=dtype, device=device)


def enclosing_ndc(
    poses: Float[np.ndarray, "views 3 4"],
    borders: list[Float[np.ndarray, "_ 3"]],
    near: Float[np.ndarray, "views"],
) -> Ndc | None:
    """The narrowest pyramid along the mean optical axis that holds all that the views see from their ``near`` (distance
    along a unit ray) on.

    ``poses`` are scene_from_camera; ``borders`` per view unit ray directions (camera frame) of its outline. None where
    a ray runs more than MAX_ANGLE_DEG off the mean axis: these cameras do not face one way.
    """
    axes = _mean_axes(poses[:, :, :3].mean(0))
    if axes is None:
        return None
    rays = [border @ (axes @ pose[:, :3]).T for border, pose in zip(borders, poses, strict=True)]
    least = min(ray[:, 2].min() for ray in rays)
    if least < math.cos(math.radians(MAX_ANGLE_DEG)):
        return None
    slopes = np.max([np.abs(ray[:, :2] / ray[:, 2:]).max(0) for ray in rays], axis=0)
    centres = poses[:, :, 3] @ axes.T
    # Along each side axis the pyramid's outline is a wedge; the deepest that holds all centres:
    to_left, to_right = ((centres[:, 2:] + sign * centres[:, :2] / slopes).min(0) for sign in (1, -1))
    apex = np.append(slopes * (to_left - to_right) / 2, ((to_left + to_right) / 2).min())
    depth = min(
        centre[2] - apex[2] + distance * ray[:, 2].min()
        for centre, distance, ray in zip(centres, near, rays, strict=True)
    )
    right, down, forward = (_triple(axis) for axis in axes)
    return Ndc(_triple(apex @ axes), (right, down, forward), (float(slopes[0]), float(slopes[1])), float(depth))


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _mean_axes(mean: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"] | None:
    """The camera axes, as rows, whose forward is that of the ``mean`` of rotations scene_from_camera, and whose right
    is as near to its as can be; any where the photos were rolled every way. None where they look every way."""
    length = np.linalg.norm(mean[:, 2])
    if length < math.cos(math.radians(MAX_ANGLE_DEG)):
        return None
    forward = mean[:, 2] / length
    for right in (mean[:, 0], np.eye(3)[np.abs(forward).argmin()]):
        right = right - forward * (right @ forward)
        if (length := np.linalg.norm(right)) > 1e-3:
            right = right / length
            return np.stack([right, np.cross(forward, right), forward])
    return None
