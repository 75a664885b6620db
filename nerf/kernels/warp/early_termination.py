"""Between two rounds of ray marching (``nerf.kernels.torch.early_termination``): a ray is one thread's loop."""

from collections.abc import Sequence

import torch
import warp as wp
from jaxtyping import Float, Float64, Int32
from torch import Tensor

from nerf.kernels import RayStepping, Samples
from nerf.kernels.warp.compositing import optical_thickness
from nerf.kernels.warp.launch import launch
from nerf.kernels.warp.marching import s_to_t, t_to_s

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


def finish_round(
    stepping: RayStepping,
    samples: Samples,
    sigma: Float[Tensor, "samples"],
    threshold: float,
    jitter: Float[Tensor, "rays"],
    far: Float[Tensor, "rays"],
    optical_depth: Float64[Tensor, "rays"],
    near: Float[Tensor, "rays"],
) -> None:
    """As in nerf.kernels.torch.early_termination."""
    sizes, packed = stepping[:2], (samples.starts, samples.t, samples.dt)
    launch(
        _finish_round,
        len(far),
        *sizes,
        stepping.max_samples,
        *packed,
        sigma,
        threshold,
        jitter,
        far,
        optical_depth,
        near,
    )


def pack_rounds(rounds: Sequence[Samples]) -> tuple[Samples, Int32[Tensor, "samples"]]:
    """As in nerf.kernels.torch.early_termination."""
    starts, rays = sum(each.starts for each in rounds[1:]) + rounds[0].starts, len(rounds[0].starts) - 1
    total, device, before = sum(len(each.t) for each in rounds), starts.device, 0
    order, ray = (torch.zeros(total, dtype=torch.int32, device=device) for _ in range(2))
    t, dt = (torch.zeros(total, device=device) for _ in range(2))
    next_entry = starts[:-1].clone()
    for each in rounds:
        launch(_pack_round, rays, each.starts, each.t, each.dt, before, next_entry, order, ray, t, dt)
        before += len(each.t)
    return Samples(starts, ray, t, dt), order


@wp.kernel
def _finish_round(
    step_size: float,
    cone_angle: float,
    max_samples: int,
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    sigma: wp.array[float],
    threshold: float,
    jitter: wp.array[float],
    far: wp.array[float],
    optical_depth: wp.array[wp.float64],
    near: wp.array[float],
):
    ray = wp.tid()
    start = starts[ray]
    end = starts[ray + 1]
    tau = optical_depth[ray]
    for i in range(start, end):
        tau += wp.float64(optical_thickness(sigma[i], lengths[i]))
    optical_depth[ray] = tau
    next_near = far[ray]
    if end - start == max_samples and wp.exp(-float(tau)) >= threshold:
        s = t_to_s(step_size, cone_angle, distances[end - 1]) + (1.0 - jitter[ray])
        next_near = wp.min(next_near, s_to_t(step_size, cone_angle, s))
    near[ray] = next_near


@wp.kernel
def _pack_round(
    starts: wp.array[int],
    distances: wp.array[float],
    lengths: wp.array[float],
    before: int,
    next_entry: wp.array[int],
    order: wp.array[int],
    rays: wp.array[int],
    packed_distances: wp.array[float],
    packed_lengths: wp.array[float],
):
    ray = wp.tid()
    entry = next_entry[ray]
    for i in range(starts[ray], starts[ray + 1]):
        order[entry] = before + i
        rays[entry] = ray
        packed_distances[entry] = distances[i]
        packed_lengths[entry] = lengths[i]
        entry += 1
    next_entry[ray] = entry
