"""Samples along rays where the occupancy grid says that there may be something, and the points at which they stand."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.geometry.rays import Rays, clip_to_box
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import Contraction, contract
from nerf.kernels import BinaryOccupancy, RayStepping, Samples
from nerf.kernels.torch.occupancy import cell_numbers, is_occupied
from nerf.kernels.torch.packing import padded_samples


def march(
    occupied: BinaryOccupancy,
    stepping: RayStepping,
    rays: Rays,
    jitter: Float[Tensor, "rays"],
    capacity: int | None = None,
) -> Samples:
    """The samples that lie in occupied cells.

    ``jitter`` in [0, 1) says where in its interval each sample of a ray stands; a sample that would stand at or
    beyond far is left out. Empty cells are skipped without leaving the stepping: a sample's place does not depend on
    what lies before it.
    """
    if not stepping.contracted:
        rays = clip_to_box(rays, -Box.half, Box.half)
    first = t_to_s(stepping, rays.near)
    counts = torch.ceil(t_to_s(stepping, rays.far) - first)
    k = torch.arange(int(counts.max()) if len(counts) else 0, dtype=first.dtype, device=first.device)
    t = s_to_t(stepping, (first + jitter)[:, None] + k)
    wanted = (k < counts[:, None]) & (t < rays.far[:, None])
    # The same as points_on(rays, t), laid out axis by axis: torch is several times faster without a row of 3 innermost.
    points = (rays.origins.T[:, :, None] + t * rays.directions.T[:, :, None]).movedim(0, -1)
    points = unit_coordinates(points, stepping.contracted)
    wanted &= is_occupied(occupied.bits, cell_numbers(stepping.occupancy_resolution, points))
    if len(k) > stepping.max_samples:
        wanted &= wanted.cumsum(-1) <= stepping.max_samples
    ray, k_wanted = wanted.nonzero(as_tuple=True)
    start, end = (s_to_t(stepping, first[ray] + k_wanted + edge) for edge in (0, 1))
    dt = torch.minimum(end, rays.far[ray]) - start
    samples = Samples(_starts_of(wanted.sum(-1)), ray.int(), t[wanted], dt)
    return samples if capacity is None else padded_samples(samples, capacity)


def s_to_t(stepping: RayStepping, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """t(s) of :class:`nerf.kernels.RayStepping`."""
    if not stepping.cone_angle:
        return stepping.step_size * s
    beyond = (stepping.cone_angle * s - 1).clamp(min=0)
    return torch.minimum(stepping.step_size * s, s.new_tensor(stepping.linear_until)) * torch.exp(beyond)


def t_to_s(stepping: RayStepping, t: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """s(t), the inverse of :func:`s_to_t`."""
    if not stepping.cone_angle:
        return t / stepping.step_size
    linear_until = stepping.linear_until
    return (
        t.clamp(max=linear_until) / stepping.step_size
        + torch.log(t.clamp(min=linear_until) / linear_until) / stepping.cone_angle
    )


def normalised_distance(stepping: RayStepping, t: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The measure m in which losses tell distances: dm = dt / max(t_1, t) where steps grow from t_1 on (beyond it m is
    log t + const), distances themselves if they do not."""
    if not stepping.cone_angle:
        return t
    relative = t / stepping.linear_until
    return relative.clamp(max=1) + torch.log(relative.clamp(min=1))


def sample_points(rays: Rays, samples: Samples, contracted: bool) -> Float[Tensor, "samples 3"]:
    """The samples' points o + t d, in unit coordinates."""
    return unit_coordinates(_scene_points(rays, samples), contracted)


def sample_points_backward(
    rays: Rays, samples: Samples, contracted: bool, grad_points: Float[Tensor, "samples 3"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """Gradients of the rays' origins and directions."""
    if contracted:
        grad = _contract_backward(_scene_points(rays, samples), grad_points / (2 * Contraction.half))
    else:
        grad = grad_points / (2 * Box.half)
    ray, zero = samples.ray.long(), torch.zeros_like(rays.origins)
    return zero.index_add(0, ray, grad), zero.index_add(0, ray, samples.t[:, None] * grad)


def unit_coordinates(points: Float[Tensor, "*points 3"], contracted: bool) -> Float[Tensor, "*points 3"]:
    """Scene points in unit coordinates; those outside the box of a bounded scene leave [0, 1]^3."""
    half = Contraction.half if contracted else Box.half
    return ((contract(points) if contracted else points) + half) / (2 * half)


def _starts_of(counts: Tensor) -> Int32[Tensor, "rays_and_end"]:
    """Where each ray's samples start among packed ones, and at last their number."""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0)).int()


def _scene_points(rays: Rays, samples: Samples) -> Float[Tensor, "samples 3"]:
    origins, directions = rays.origins.index_select(0, samples.ray), rays.directions.index_select(0, samples.ray)
    return origins + samples.t[:, None] * directions


def _contract_backward(
    points: Float[Tensor, "samples 3"], grad: Float[Tensor, "samples 3"]
) -> Float[Tensor, "samples 3"]:
    """With r = |x_a| the largest component: y_i = f x_i for f = (2 - 1/r) / r, and df/dr = -2 (r - 1) / r³.

    Axis a alone also gets the change of f. Written in x/r and 1/r, so that nothing overflows far away.
    """
    largest, axis = points.abs().max(-1, keepdim=True)
    inverse = 1 / largest.clamp(min=1)
    on_face = points * inverse
    change = -2 * (1 - inverse) * inverse * (grad * on_face).sum(-1, keepdim=True) * on_face.gather(-1, axis).sign()
    result = (2 - inverse) * inverse * grad
    return result.scatter_add(-1, axis, change)
