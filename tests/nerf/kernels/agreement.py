"""Warp's kernels beside the torch reference: numbers for both, and whether they agree.

They are compared with the reference in float64 on the same float32 inputs. ``relative_error`` is the largest
difference over the largest wanted number, of the whole tensor unless said otherwise: single entries may be
differences of large numbers, of which no float32 program has more digits. Where they are not,
``assert_each_close``.
"""

from typing import Any

import torch
from torch import Tensor

from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box
from nerf.kernels import BinaryOccupancy, RayStepping, Samples, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import binary_occupancy

TOLERANCE = 1e-5
BOUNDED = RayStepping(2 * Box.half * 3**0.5 / 256, 0.0, False, 32, 1024)
CONTRACTED = RayStepping(0.01, 0.02, True, 32, 1024)
STEPPINGS = {"bounded": BOUNDED, "contracted": CONTRACTED}


def generator(seed: int) -> torch.Generator:
    return torch.Generator("cpu").manual_seed(seed)


def normal(device: str, seed: int, *shape: int) -> Tensor:
    """The same numbers on every device."""
    return torch.randn(shape, generator=generator(seed), device="cpu").to(device)


def uniform(device: str, seed: int, *shape: int) -> Tensor:
    """The same numbers on every device."""
    return torch.rand(shape, generator=generator(seed), device="cpu").to(device)


def doubled(value: Any) -> Any:
    """Floating-point tensors as float64, also within tuples; everything else as it is."""
    if isinstance(value, tuple):
        parts = [doubled(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value.double() if isinstance(value, Tensor) and value.is_floating_point() else value


def relative_error(found: Tensor, wanted: Tensor) -> float:
    assert found.dtype == torch.float32 and found.shape == wanted.shape and found.isfinite().all()
    if not wanted.numel():
        return 0.0
    largest = float(wanted.abs().max())
    difference = float((found.double() - wanted.double()).abs().max())
    return difference / largest if largest else difference


def assert_each_close(found: Tensor, wanted: Tensor, floor: float) -> None:
    """Entry by entry, where each is computed by itself: TOLERANCE of it or, where it is a small difference of larger
    numbers or too small for all digits of float32, ``floor``."""
    assert found.dtype == torch.float32 and found.isfinite().all()
    torch.testing.assert_close(found.double(), wanted, rtol=TOLERANCE, atol=floor)


def tensors_in(result: Any) -> list[Tensor]:
    if result is None:
        return []
    return [result] if isinstance(result, Tensor) else [tensor for part in result for tensor in tensors_in(part)]


def agree(function: str, *arguments: Any, tolerance: float = TOLERANCE) -> Any:
    """Warp's result, once it is known to be the reference's."""
    result = getattr(warp, function)(*arguments)
    wanted = getattr(reference, function)(*doubled(arguments))
    for one, right in zip(tensors_in(result), tensors_in(wanted), strict=True):
        if right.is_floating_point():
            assert relative_error(one, right) < tolerance, function
        else:
            assert torch.equal(one, right), function
    return result


def rays_of(origins: Tensor, directions: Tensor, near: float, far: float) -> Rays:
    ends = (torch.full_like(origins[:, 0], end) for end in (near, far))
    return Rays(origins, directions / directions.norm(dim=-1, keepdim=True), *ends)


def random_rays(device: str, count: int, far: float = 30.0) -> Rays:
    """Origins inside and outside, some directions along one or two axes, some rays that begin on the box."""
    origins, directions = 1.5 * normal(device, 5, count, 3), normal(device, 6, count, 3)
    part = count // 16
    directions[:part, 0] = 0
    directions[part : 2 * part, 1:] = 0
    directions[2 * part : 3 * part, :2] = -0.0
    origins[3 * part : 4 * part, 2] = Box.half
    origins[4 * part : 5 * part] = origins[4 * part : 5 * part].clamp(-0.5, 0.5)
    return rays_of(origins, directions, 0.05, far)


def occupied_of(device: str, kind: str, cells: int) -> BinaryOccupancy:
    if kind in ("empty", "full"):
        return binary_occupancy(torch.full((cells**3 // 64,), -1 if kind == "full" else 0, device=device))
    thickness = uniform(device, 7, cells**3)
    if kind == "bricks":  # three bricks of ten, all of their cells
        return binary_occupancy(-(thickness.view(-1, 64)[:, 0] < 0.3).long())
    return binary_occupancy(reference.occupancy_bits(thickness, {"random": 0.5, "sparse": 0.97}[kind]))


def packed(device: str, counts: list[int], lengths: Tensor | None = None) -> Samples:
    starts = torch.tensor([0, *counts], device=device).cumsum(0).int()
    ray = torch.repeat_interleave(torch.arange(len(counts), device=device), starts.diff()).int()
    dt = 0.02 + 0.1 * uniform(device, 13, sum(counts)) if lengths is None else lengths
    t = torch.cat([dt[:0], *(0.1 + part.cumsum(0) for part in dt.split(counts))])
    return Samples(starts, ray, t - dt / 2, dt)


COUNTS = [0, 3, 1, 0, 0, 40, 1, 7, 128, 0]
