"""Samples along rays (``nerf.kernels.torch.marching``): where the occupancy grid is empty, whole
neighbourhoods of bricks are skipped."""

import threading

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, Contraction
from nerf.kernels import BinaryOccupancy, RayStepping, Samples
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.occupancy import cell_number
from nerf.kernels.warp.packing import new_packed

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_BOX = wp.constant(Box.half)
_CONTRACTED_BOX = wp.constant(Contraction.half)
_MAX_INVERSE = wp.constant(1.0e30)


def march(
    occupied: BinaryOccupancy,
    stepping: RayStepping,
    rays: Rays,
    jitter: Float[Tensor, "rays"],
    capacity: int | None = None,
) -> Samples:
    """As in nerf.kernels.torch.marching."""
    count, device = len(jitter), jitter.device
    length = count * stepping.max_samples
    # A CUDA graph goes on using its memory; what is kept here may be replaced by a longer one.
    kept = capacity is None
    sample_numbers = _scratch(length, device) if kept else torch.empty(length, dtype=torch.int32, device=device)
    counts = torch.zeros(count + 1, dtype=torch.int32, device=device)
    ends = torch.empty(count, 2, device=device)
    sizes = (
        stepping.step_size,
        stepping.cone_angle,
        int(stepping.contracted),
        stepping.occupancy_resolution,
        stepping.max_samples,
    )
    stride = 1 if jitter.is_cuda else stepping.max_samples
    launch(_march, count, *occupied, *sizes, stride, *rays, jitter, sample_numbers, counts, ends)
    starts, (ray,), (t, dt) = new_packed(counts, 1, 2, capacity)
    launch(_pack, count, *sizes[:2], stride, sample_numbers, starts, ends, jitter, ray, t, dt)
    return Samples(starts, ray, t, dt)


def sample_points(rays: Rays, samples: Samples, contracted: bool) -> Float[Tensor, "samples 3"]:
    """As in nerf.kernels.torch.marching."""
    points = samples.t.new_empty(len(samples.t), 3)
    launch(_sample_points, len(points), int(contracted), rays.origins, rays.directions, samples.ray, samples.t, points)
    return points


def sample_points_backward(
    rays: Rays, samples: Samples, contracted: bool, grad_points: Float[Tensor, "samples 3"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """As in nerf.kernels.torch.marching."""
    grad_origins, grad_directions = torch.empty_like(rays.origins), torch.empty_like(rays.directions)
    packed = samples.starts, samples.t, grad_points
    arguments = int(contracted), rays.origins, rays.directions, *packed, grad_origins, grad_directions
    launch(_sample_points_backward, len(grad_origins), *arguments)
    return grad_origins, grad_directions


# Memory that a march fills and its own second half reads; kept, as fetching fresh pages takes longer than both.
_thread_local = threading.local()


def _scratch(length: int, device: torch.device) -> Tensor:
    scratch: dict[torch.device, Tensor] = vars(_thread_local).setdefault("scratch", {})
    kept = scratch.get(device)
    if kept is None or len(kept) < length:
        kept = scratch[device] = torch.empty(length, dtype=torch.int32, device=device)
    return kept


@wp.func
def s_to_t(step_size: float, cone_angle: float, s: float):
    """t(s) of nerf.kernels.RayStepping."""
    if cone_angle == 0.0:
        return step_size * s
    beyond = wp.max(cone_angle * s - 1.0, 0.0)
    return wp.min(step_size * s, step_size / cone_angle) * wp.exp(beyond)


@wp.func
def t_to_s(step_size: float, cone_angle: float, t: float):
    """s(t), the inverse of t(s)."""
    if cone_angle == 0.0:
        return t / step_size
    until = step_size / cone_angle
    return wp.min(t, until) / step_size + wp.log(wp.max(t, until) / until) / cone_angle


@wp.func
def _contract(point: wp.vec3):
    """As nerf.geometry.space_maps.contraction.contract: the largest component r > 1 becomes 2 - 1/r, the others in
    proportion."""
    r = wp.max(wp.max(wp.abs(point[0]), wp.abs(point[1])), wp.abs(point[2]))
    if r <= 1.0:
        return point
    inverse = 1.0 / r
    return (2.0 - inverse) * (inverse * point)


@wp.func
def _unit_coordinates(contracted: int, point: wp.vec3):
    if contracted != 0:
        return (_contract(point) + wp.vec3(_CONTRACTED_BOX)) / (2.0 * _CONTRACTED_BOX)
    return (point + wp.vec3(_BOX)) / (2.0 * _BOX)


@wp.func
def _slab(origin: float, direction: float):
    """Where a ray is between -BOX and BOX along one axis; everywhere or nowhere if it runs along them."""
    if direction == 0.0:
        if wp.abs(origin) <= _BOX:
            return wp.vec2(-wp.inf, wp.inf)
        return wp.vec2(wp.inf, -wp.inf)
    a = (-_BOX - origin) / direction
    b = (_BOX - origin) / direction
    return wp.vec2(wp.min(a, b), wp.max(a, b))


@wp.func
def _clip_to_box(origin: wp.vec3, direction: wp.vec3):
    """Where a ray enters the box of a bounded scene, and where it leaves it."""
    x = _slab(origin[0], direction[0])
    y = _slab(origin[1], direction[1])
    z = _slab(origin[2], direction[2])
    return wp.vec2(wp.max(wp.max(x[0], y[0]), z[0]), wp.min(wp.min(x[1], y[1]), z[1]))


@wp.func
def _inverse(contracted: int, direction: wp.vec3):
    """Of how fast unit coordinates move along the ray where they are linear; finite where one stands still."""
    inverse = wp.cw_div(wp.vec3(wp.where(contracted != 0, 2.0 * _CONTRACTED_BOX, 2.0 * _BOX)), direction)
    return wp.vec3(_finite(inverse[0]), _finite(inverse[1]), _finite(inverse[2]))


@wp.func
def _cell(cells: int, u: wp.vec3):
    """Which holds a point, or is the nearest to it."""
    scaled = float(cells) * u
    last = cells - 1
    return wp.vec3i(
        wp.clamp(int(scaled[0]), 0, last), wp.clamp(int(scaled[1]), 0, last), wp.clamp(int(scaled[2]), 0, last)
    )


@wp.func
def _finite(number: float):
    return wp.where(wp.abs(number) < _MAX_INVERSE, number, _MAX_INVERSE)


@wp.func
def _empty_span(contracted: int, cells: int, cell: wp.vec3i, empty: int, u: wp.vec3, point: wp.vec3, inverse: wp.vec3):
    """How far along the ray it stays, but for rounding at a face, within the cube of ``2 empty - 1`` bricks per side
    around a cell, which holds its point (unit: u).

    Where unit coordinates are linear, up to where it leaves these bricks or that region. Where space is contracted, r
    being the largest component of the point, coordinates in [-2, 2] move at most 4/3 times as fast as the point, and
    at most 4/(r - a) times within a distance a of it; so within a distance m of the nearest face (in the largest
    component) it stays for max(3/4 m, m r / (4 + m)).
    """
    width = 1.0 / float(cells)
    around = 4.0 * float(empty - 1)
    low = (wp.vec3(float(cell[0] & ~3), float(cell[1] & ~3), float(cell[2] & ~3)) - wp.vec3(around)) * width
    high = low + wp.vec3((2.0 * around + 4.0) * width)
    contracted_span = float(0.0)
    if contracted != 0:
        r = wp.max(wp.abs(point))
        m = 2.0 * _CONTRACTED_BOX * wp.min(wp.min(u - low, high - u))
        contracted_span = wp.max(0.75 * m, m * r / (4.0 + m))
        if r >= 1.0:
            return contracted_span
        low = wp.max(low, wp.vec3(0.25))  # [-1, 1] of [-2, 2]
        high = wp.min(high, wp.vec3(0.75))
    exits = wp.max(wp.cw_mul(low - u, inverse), wp.cw_mul(high - u, inverse))
    return wp.max(contracted_span, wp.min(exits))


@wp.func
def _place(ray: int, sample: int, stride: int, rays: int):
    """Of a ray's sample in memory, where rays are ``stride`` apart: the samples of a ray follow each other, or those of
    a GPU's neighbouring threads, which have neighbouring rays."""
    return ray * stride + wp.where(stride == 1, sample * rays, sample)


@wp.kernel
def _march(
    bits: wp.array[wp.int64],
    empty_distance: wp.array[wp.uint8],
    step_size: float,
    cone_angle: float,
    contracted: int,
    cells: int,
    max_samples: int,
    stride: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    nears: wp.array[float],
    fars: wp.array[float],
    jitter: wp.array[float],
    sample_numbers: wp.array[int],
    counts: wp.array[int],
    ends: wp.array[wp.vec2],
):
    ray = wp.tid()
    o = origins[ray]
    d = directions[ray]
    near = nears[ray]
    far = fars[ray]
    counts[ray + 1] = 0
    if near >= far:  # it has ended
        return
    if contracted == 0:
        within = _clip_to_box(o, d)
        near = wp.max(near, within[0])
        far = wp.max(near, wp.min(far, within[1]))
    first = t_to_s(step_size, cone_angle, near)
    last = t_to_s(step_size, cone_angle, far) - first
    count = int(0)
    k = int(0)
    inverse = _inverse(contracted, d)
    while float(k) < last and count < max_samples:
        s = first + jitter[ray] + float(k)
        t = s_to_t(step_size, cone_angle, s)
        if t >= far:
            break
        point = o + t * d
        u = _unit_coordinates(contracted, point)
        cell = _cell(cells, u)
        number = cell_number(cells, cell[0], cell[1], cell[2])
        word = bits[number >> 6]
        if word == wp.int64(0):
            empty = wp.max(1, int(empty_distance[number >> 6]))
            span = _empty_span(contracted, cells, cell, empty, u, point, inverse)
            # Rounded down by a thousandth of a step: a step too few is looked at again, one too many is lost.
            steps = t_to_s(step_size, cone_angle, t + span) - s - 0.001
            k += wp.max(1, int(wp.min(steps, 1.0e6)) + 1)
        else:
            if ((word >> wp.int64(number & 63)) & wp.int64(1)) != wp.int64(0):
                sample_numbers[_place(ray, count, stride, counts.shape[0] - 1)] = k
                count += 1
            k += 1
    counts[ray + 1] = count
    ends[ray] = wp.vec2(first, far)


@wp.kernel
def _pack(
    step_size: float,
    cone_angle: float,
    stride: int,
    sample_numbers: wp.array[int],
    starts: wp.array[int],
    ends: wp.array[wp.vec2],
    jitter: wp.array[float],
    rays: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
):
    ray = wp.tid()
    start = starts[ray]
    first = ends[ray][0]
    far = ends[ray][1]
    for i in range(start, starts[ray + 1]):
        k = float(sample_numbers[_place(ray, i - start, stride, starts.shape[0] - 1)])
        start_t = s_to_t(step_size, cone_angle, first + k)
        end_t = wp.min(s_to_t(step_size, cone_angle, first + k + 1.0), far)
        rays[i] = ray
        distances[i] = s_to_t(step_size, cone_angle, first + jitter[ray] + k)
        lengths[i] = end_t - start_t


@wp.kernel
def _sample_points(
    contracted: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    rays: wp.array[int],
    distances: wp.array[float],
    points: wp.array[wp.vec3],
):
    i = wp.tid()
    ray = rays[i]
    points[i] = _unit_coordinates(contracted, origins[ray] + distances[i] * directions[ray])


@wp.func
def _unit_coordinates_backward(contracted: int, point: wp.vec3, grad: wp.vec3):
    """With r = |x_a| the largest component: y_i = f x_i for f = (2 - 1/r) / r, and df/dr = -2 (r - 1) / r³."""
    if contracted == 0:
        return grad / (2.0 * _BOX)
    g = grad / (2.0 * _CONTRACTED_BOX)
    axis = int(0)
    if wp.abs(point[1]) > wp.abs(point[axis]):
        axis = 1
    if wp.abs(point[2]) > wp.abs(point[axis]):
        axis = 2
    r = wp.abs(point[axis])
    if r <= 1.0:
        return g
    inverse = 1.0 / r
    on_face = inverse * point
    change = -2.0 * (1.0 - inverse) * inverse * wp.dot(g, on_face) * wp.sign(point[axis])
    scaled = (2.0 - inverse) * inverse * g
    return wp.vec3(
        scaled[0] + wp.where(axis == 0, change, 0.0),
        scaled[1] + wp.where(axis == 1, change, 0.0),
        scaled[2] + wp.where(axis == 2, change, 0.0),
    )


@wp.kernel
def _sample_points_backward(
    contracted: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    starts: wp.array[int],
    distances: wp.array[float],
    grad_points: wp.array[wp.vec3],
    grad_origins: wp.array[wp.vec3],
    grad_directions: wp.array[wp.vec3],
):
    ray = wp.tid()
    # In float64: of a ray of 4096 equal gradients a float32 sum loses more than 1e-5.
    grad_origin = wp.vec3d()
    grad_direction = wp.vec3d()
    for i in range(starts[ray], starts[ray + 1]):
        t = distances[i]
        grad = _unit_coordinates_backward(contracted, origins[ray] + t * directions[ray], grad_points[i])
        grad_origin += wp.vec3d(grad)
        grad_direction += wp.vec3d(t * grad)
    grad_origins[ray] = wp.vec3(grad_origin)
    grad_directions[ray] = wp.vec3(grad_direction)
