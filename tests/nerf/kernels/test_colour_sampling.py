"""Samples whose colours stand for all in a picture, of both backends, against loops over each ray."""

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from nerf.kernels import Backend, ColourSamples, Samples, warp
from nerf.kernels import torch as reference
from tests.devices import DEVICES, skip_without
from tests.nerf.kernels.agreement import COUNTS, normal, packed, uniform

BACKENDS = pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])
OPACITY_STEP = 1 / 64


@pytest.fixture(params=DEVICES, autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """Everything below runs on the CPU and, where there is one, on a GPU."""
    skip_without(request.param)
    with torch.device(request.param):
        yield request.param


def selected_of(
    backend: Backend, samples: Samples, sigma: Tensor, depth: Tensor | None = None, accumulated: Tensor | None = None
) -> tuple[ColourSamples, Tensor, Tensor]:
    """A first round's, and what is known of the rays behind it."""
    count = len(samples.starts) - 1
    depth = torch.zeros(count, dtype=torch.float64) if depth is None else depth.clone()
    accumulated = torch.zeros(count) if accumulated is None else accumulated.clone()
    return backend.select_colour_samples(samples, sigma, OPACITY_STEP, depth, accumulated), depth, accumulated


def cut(samples: Samples, sigma: Tensor, first: int) -> Iterator[tuple[Samples, Tensor]]:
    """Two rounds: the ``first`` samples of each ray, and its others."""
    place = torch.arange(len(samples.t)) - samples.starts.index_select(0, samples.ray)
    for part in (place < first, place >= first):
        counts = torch.bincount(samples.ray[part], minlength=len(samples.starts) - 1)
        starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0)).int()
        yield Samples(starts, samples.ray[part], samples.t[part], samples.dt[part]), sigma[part]


@BACKENDS
@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_samples_at_which_a_quantum_ends_stand_for_those_before(backend: Backend, device: str, scale: float) -> None:
    samples = packed(device, COUNTS)
    sigma = scale * uniform(device, 21, len(samples.t)).square()
    selected, depth, accumulated = selected_of(backend, samples, sigma)
    rows, weights = list[int](), list[float]()
    for ray in range(len(COUNTS)):
        tau = stood_for = 0.0
        for i in range(int(samples.starts[ray]), int(samples.starts[ray + 1])):
            before, tau = tau, tau + float(sigma[i]) * float(samples.dt[i])
            quanta = [math.floor(-math.expm1(-x) / OPACITY_STEP + 0.5) for x in (before, tau)]
            if quanta[1] > quanta[0]:
                rows.append(i)
                weights.append(-math.expm1(-tau) - stood_for)
                stood_for = -math.expm1(-tau)
        assert float(depth[ray]) == pytest.approx(tau, rel=1e-6)
        assert float(accumulated[ray]) == pytest.approx(stood_for, abs=1e-6)
    assert 5 < len(rows) < len(samples.t) and selected.rows.tolist() == rows
    assert selected.weights.tolist() == pytest.approx(weights, abs=1e-6)
    assert (
        selected.samples.starts[-1] == len(rows) and selected.rows.dtype == selected.samples.starts.dtype == torch.int32
    )
    for kept, of_all in zip(selected.samples[1:], samples[1:], strict=True):
        assert torch.equal(kept, of_all.index_select(0, selected.rows))
    assert torch.equal(
        selected.samples.starts.diff(), torch.bincount(selected.samples.ray, minlength=len(COUNTS)).int()
    )


@BACKENDS
def test_waves_go_on_where_the_last_ended(backend: Backend, device: str) -> None:
    samples = packed(device, COUNTS)
    sigma = uniform(device, 21, len(samples.t))
    whole, depth, accumulated = selected_of(backend, samples, sigma)
    (one, its), (other, others) = cut(samples, sigma, 5)
    first, half_depth, half_accumulated = selected_of(backend, one, its)
    second, *at_last = selected_of(backend, other, others, half_depth, half_accumulated)
    torch.testing.assert_close(at_last, [depth, accumulated])
    t, order = torch.cat([first.samples.t, second.samples.t]), torch.cat([first.samples.ray, second.samples.ray])
    order = order.argsort(stable=True)
    assert torch.equal(t[order], whole.samples.t) and len(first.weights) and len(second.weights)
    torch.testing.assert_close(torch.cat([first.weights, second.weights])[order], whole.weights, rtol=0, atol=1e-6)


@BACKENDS
def test_a_picture_is_off_by_a_quantum_at_most(backend: Backend, device: str) -> None:
    """Beside all samples' colours; where one sample stops nearly all light, that one shows."""
    samples = packed(device, [40] * 50)
    sigma = 4 * uniform(device, 21, 2000) ** 4
    sigma[20::40] = 500.0
    colour = (normal(device, 22, 2000, 3)).sigmoid()
    far = torch.full((50,), 9.0)
    wanted, weights = reference.composite(samples, sigma, colour, torch.zeros(50, 3), far)
    selected, depth, accumulated = selected_of(backend, samples, sigma)
    seen = torch.zeros(50, 4)
    backend.accumulate_colours(selected, colour.index_select(0, selected.rows), seen)
    assert len(selected.rows) < 0.6 * float((weights > 0).sum())
    assert float((seen[:, :3] - wanted.colour).abs().max()) < OPACITY_STEP
    assert float((seen[:, 3] - wanted.depth).abs().max()) < OPACITY_STEP * float(samples.t.max())
    assert ((-torch.expm1(-depth) - accumulated).abs() <= OPACITY_STEP).all()
    again = seen.clone()
    backend.accumulate_colours(selected, colour.index_select(0, selected.rows), again)
    torch.testing.assert_close(again, 2 * seen)


@BACKENDS
@pytest.mark.parametrize("sigma", [0.0, 1e-45, 1e30, math.inf])
def test_extreme_densities(backend: Backend, device: str, sigma: float) -> None:
    samples = packed(device, [4, 4])
    selected, depth, accumulated = selected_of(backend, samples, torch.full((8,), sigma))
    solid = sigma > 1
    assert selected.rows.tolist() == ([0, 4] if solid else []) and selected.weights.tolist() == [1.0] * len(
        selected.rows
    )
    assert accumulated.tolist() == [float(solid)] * 2 and depth.isfinite().all()


@BACKENDS
def test_nan_density_reaches_its_own_ray_alone(backend: Backend, device: str) -> None:
    samples = packed(device, [4, 4])
    sigma = torch.full((8,), 0.5)
    sigma[2] = math.nan
    selected, depth, accumulated = selected_of(backend, samples, sigma)
    assert (
        depth.isnan().tolist() == [True, False] and accumulated.isfinite().all() and selected.weights.isfinite().all()
    )
    assert selected.samples.starts[1] <= 2 and accumulated[1] > 0


@BACKENDS
@pytest.mark.parametrize("rays", [0, 3])
def test_no_rays_and_no_samples(backend: Backend, device: str, rays: int) -> None:
    selected, depth, accumulated = selected_of(backend, packed(device, [0] * rays), torch.zeros(0))
    assert len(selected.rows) == 0 and selected.samples.starts.tolist() == [0] * (rays + 1)
    seen = torch.ones(rays, 4)
    backend.accumulate_colours(selected, torch.zeros(0, 3), seen)
    assert not depth.any() and not accumulated.any() and (seen == 1).all()
