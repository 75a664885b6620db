"""What is known of rays between two rounds of samples, of both backends, against loops over each ray."""

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from nerf.kernels import Backend, RayStepping, Samples, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.marching import t_to_s
from tests.devices import DEVICES, skip_without

BACKENDS = pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])
COUNTS = (0, 4, 1, 4, 4, 0, 3, 4)
BOUNDED, CONTRACTED = RayStepping(0.05, 0.0, False, 8, 4), RayStepping(0.05, 0.1, True, 8, 4)


@pytest.fixture(params=DEVICES, autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[None]:
    """Everything below runs on the CPU and, where there is one, on a GPU."""
    skip_without(request.param)
    with torch.device(request.param):
        yield


def random_numbers(count: int, seed: int) -> Tensor:
    return torch.rand(count, generator=torch.Generator("cpu").manual_seed(seed), device="cpu").to(torch.zeros(0).device)


def round_of(counts: tuple[int, ...], seed: int = 1) -> Samples:
    starts = torch.tensor([0, *counts]).cumsum(0).int()
    ray = torch.repeat_interleave(torch.arange(len(counts)), starts.diff()).int()
    dt = 0.05 + 0.1 * random_numbers(sum(counts), seed)
    t = torch.cat([dt[:0], *(0.3 + part.cumsum(0) for part in dt.split(counts))])
    return Samples(starts, ray, t, dt)


def ended(
    backend: Backend, stepping: RayStepping, samples: Samples, sigma: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    """Depth and near after a round that began with a depth of 0.5 on all rays."""
    count = len(samples.starts) - 1
    depth, near = torch.full((count,), 0.5, dtype=torch.float64), torch.full((count,), 0.2)
    backend.finish_round(stepping, samples, sigma, threshold, jitters(count), torch.full((count,), 9.0), depth, near)
    return depth, near


def jitters(count: int) -> Tensor:
    return torch.linspace(0, 0.9, count)


@BACKENDS
@pytest.mark.parametrize("stepping", [BOUNDED, CONTRACTED])
def test_rays_with_light_go_on_behind_their_last_sample(backend: Backend, stepping: RayStepping) -> None:
    samples = round_of(COUNTS)
    sigma = random_numbers(len(samples.t), 2)
    sigma[samples.ray == 3] = 50.0  # which stops its light
    depth, near = ended(backend, stepping, samples, sigma, 0.2)
    for ray, count in enumerate(COUNTS):
        mine = slice(int(samples.starts[ray]), int(samples.starts[ray + 1]))
        assert float(depth[ray]) == pytest.approx(
            0.5 + float((sigma[mine] * samples.dt[mine]).double().sum()), rel=1e-6
        )
        if count < stepping.max_samples or ray == 3:
            assert near[ray] == 9
            continue
        assert near[ray] < 9
        steps = t_to_s(stepping, near[ray]) - t_to_s(stepping, samples.t[mine][-1])
        assert float(steps) == pytest.approx(1 - float(jitters(len(COUNTS))[ray]), abs=1e-4)
    assert (near < 9).sum() == 3


@BACKENDS
def test_the_light_decides_as_it_does_for_visible_samples(backend: Backend) -> None:
    """A ray goes on exactly if a sample behind its last one would be visible."""
    samples, sigma = round_of((4,) * 200), random_numbers(800, 3)
    depth, near = torch.zeros(200, dtype=torch.float64), torch.zeros(200)
    backend.finish_round(BOUNDED, samples, sigma, 0.8, jitters(200), torch.full((200,), 9.0), depth, near)
    more = round_of((5,) * 200)
    longer = more._replace(dt=with_fifth(samples.dt))
    front, _ = backend.visible_samples(longer, with_fifth(sigma), 0.8, 0.0, jitters(200))
    goes_on = front.starts.diff() == 5
    assert 20 < goes_on.sum() < 180 and torch.equal(near < 9, goes_on)


def with_fifth(values: Tensor) -> Tensor:
    return torch.nn.functional.pad(values.view(-1, 4), (0, 1), value=1.0).flatten()


@BACKENDS
def test_a_ray_whose_density_is_no_number_ends_there(backend: Backend) -> None:
    samples = round_of((4, 4))
    sigma = torch.full((8,), 0.1)
    sigma[2] = math.nan
    depth, near = ended(backend, BOUNDED, samples, sigma, 0.2)
    assert depth.isnan().tolist() == [True, False] and near[0] == 9 and near[1] < 2


@BACKENDS
@pytest.mark.parametrize("sigma", [0.0, 1e-45, 1e30, math.inf])
def test_extreme_densities(backend: Backend, sigma: float) -> None:
    depth, near = ended(backend, CONTRACTED, round_of((4, 4)), torch.full((8,), sigma), 1e-3)
    assert depth.isfinite().all() and torch.equal(near < 9, torch.full((2,), sigma < 1))


@BACKENDS
def test_waves_are_packed_ray_by_ray_in_their_order(backend: Backend) -> None:
    rounds = [round_of(COUNTS, 1), round_of((0, 4, 0, 0, 2, 0, 0, 1), 2), round_of((0, 1, 0, 0, 0, 0, 0, 0), 3)]
    samples, order = backend.pack_rounds(rounds)
    t = torch.cat([each.t for each in rounds])
    before, wanted = 0, [list[int]() for _ in COUNTS]
    for each in rounds:
        for ray in range(len(COUNTS)):
            wanted[ray] += range(before + int(each.starts[ray]), before + int(each.starts[ray + 1]))
        before += len(each.t)
    assert order.tolist() == [place for ray_hidden in wanted for place in ray_hidden]
    assert samples.starts.diff().tolist() == [len(ray_hidden) for ray_hidden in wanted]
    assert samples.starts.dtype == samples.ray.dtype == order.dtype == torch.int32
    assert torch.equal(samples.ray, torch.repeat_interleave(torch.arange(8), samples.starts.diff()).int())
    assert torch.equal(samples.t, t[order]) and torch.equal(samples.dt, torch.cat([w.dt for w in rounds])[order])


@BACKENDS
def test_one_round_stays_and_may_have_no_samples(backend: Backend) -> None:
    for counts in (COUNTS, (0, 0)):
        round = round_of(counts)
        samples, order = backend.pack_rounds([round])
        assert all(torch.equal(one, other) for one, other in zip(samples, round, strict=True))
        assert order.tolist() == list(range(sum(counts)))
    depth, near = ended(backend, CONTRACTED, round_of((0, 0)), torch.zeros(0), 0.1)
    assert depth.tolist() == [0.5, 0.5] and near.tolist() == [9, 9]
