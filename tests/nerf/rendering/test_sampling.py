import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.rendering.sampling import Spacing, invert_cdf, midpoint_edges, sample_pdf, stratified
from nerf.runtime.randomness import generator
from tests.reference import paper_loop


def rays(near: float, far: float, count: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.full((count,), near, dtype=dtype), torch.full((count,), far, dtype=dtype)


@pytest.mark.parametrize("spacing", ["linear", "log"])
def test_one_sample_in_every_bin_and_far_at_the_end(spacing: Spacing) -> None:
    t = stratified(*rays(0.5, 32.0, 300), 6, generator("cpu", 0), spacing)
    if spacing == "linear":
        edges = torch.linspace(0.5, 32.0, 7, dtype=torch.float64)
    else:
        edges = torch.tensor([0.5, 1, 2, 4, 8, 16, 32], dtype=torch.float64)
    assert (t[:, :-1] >= edges[:-1]).all() and (t[:, :-1] <= edges[1:]).all()
    assert (t[:, -1] == 32).all()
    # Uniform within each bin: the mean share of a bin is 1/2, with a standard error of 0.017.
    share = (t[:, :-1] - edges[:-1]) / (edges[1:] - edges[:-1])
    expected = 0.5 if spacing == "linear" else 1 / math.log(2) - 1
    assert (share.mean(0) - expected).abs().max() < 0.07
    assert share.std() > 0.25


def test_without_a_generator_samples_are_bin_centres() -> None:
    assert stratified(*rays(1, 3, 1), 4, None)[0].tolist() == [1.25, 1.75, 2.25, 2.75, 3]
    assert stratified(*rays(1, 16, 1), 2, None, "log")[0].tolist() == pytest.approx([2, 8, 16])


@pytest.mark.parametrize("spacing", ["linear", "log"])
def test_an_empty_interval_is_one_point(spacing: Spacing) -> None:
    assert torch.equal(stratified(*rays(4, 4, 2), 5, generator("cpu", 1), spacing), torch.full((2, 6), 4.0).double())


def test_stratified_integrates_without_bias() -> None:
    """The mean of sin over the samples estimates its mean over [0, 3]; strata make the error tiny."""
    t = stratified(*rays(0, 3, 2000), 8, generator("cpu", 2))[:, :-1]
    assert t.sin().mean().item() == pytest.approx((1 - math.cos(3)) / 3, abs=2e-3)


def test_edges_lie_half_way_between_samples() -> None:
    t = torch.tensor([[1.0, 2.0, 4.0, 10.0]])
    assert midpoint_edges(t, torch.tensor([0.5])).tolist() == [[0.5, 1.5, 3.0, 10.0]]


def test_samples_follow_the_pdf() -> None:
    edges = torch.tensor([[0.0, 1, 2, 6]], dtype=torch.float64)
    t = sample_pdf(edges, torch.tensor([[1.0, 3, 4]], dtype=torch.float64), 8000, generator("cpu", 3))
    counts = torch.histogram(t[0], bins=edges[0]).hist / 8000
    torch.testing.assert_close(counts, torch.tensor([1, 3, 4], dtype=torch.float64) / 8, atol=2e-4, rtol=0)
    last = t[t > 2]
    assert last.mean().item() == pytest.approx(4, abs=0.01)
    assert last.std().item() == pytest.approx(4 / 12**0.5, abs=0.01)


def test_inverts_the_cdf_like_the_slow_loop() -> None:
    random = torch.Generator().manual_seed(5)
    edges = torch.sort(torch.rand(40, 9, dtype=torch.float64, generator=random), -1).values
    weights = torch.relu(torch.randn(40, 8, dtype=torch.float64, generator=random))
    u = torch.rand(40, 16, dtype=torch.float64, generator=random)
    found = invert_cdf(edges, weights, u)
    for i in range(40):
        expected = [paper_loop.invert_cdf(edges[i].tolist(), weights[i].tolist(), v) for v in u[i].tolist()]
        assert found[i].tolist() == pytest.approx(expected, abs=1e-12)


def test_a_ray_without_weight_is_sampled_alike_in_every_bin() -> None:
    t = sample_pdf(torch.tensor([0.0, 1, 10]), torch.zeros(2), 4, None)
    assert t.tolist() == pytest.approx([0.25, 0.75, 3.25, 7.75])


@pytest.mark.parametrize("weight", [1e-45, 1e-30, 1.0, 1e30])
@pytest.mark.parametrize("spike", [0, 2, 4])
def test_one_spike_takes_every_sample(weight: float, spike: int) -> None:
    edges = torch.tensor([1.0, 2, 3, 3.5, 4, 8])
    weights = torch.zeros(5)
    weights[spike] = weight
    t = sample_pdf(edges, weights, 64, generator("cpu", 4))
    assert (t >= edges[spike]).all() and (t <= edges[spike + 1]).all()


def test_both_ends_of_the_distribution_are_ends_of_its_support() -> None:
    edges = torch.arange(6.0)
    t = invert_cdf(edges, torch.tensor([0.0, 2, 0, 1, 0]), torch.tensor([0.0, 1.0]))
    assert t.tolist() == pytest.approx([1, 4], abs=1e-6)


WEIGHTS = st.one_of(st.just(0.0), st.floats(0, 1, width=32), st.floats(0, 2.0**100, width=32), st.just(1e-45))


@given(
    st.lists(WEIGHTS, min_size=6, max_size=6),
    st.lists(st.floats(0, 1000, width=32), min_size=7, max_size=7),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_samples_ascend_within_their_bins_whatever_the_weights(
    weights: list[float], edges: list[float], dtype: torch.dtype
) -> None:
    """Repeated edges included: hypothesis likes them."""
    e, w = torch.tensor(sorted(edges), dtype=dtype), torch.tensor(weights, dtype=dtype)
    u = torch.linspace(0, 1, 33, dtype=dtype)
    t = invert_cdf(e, w, u)
    assert torch.isfinite(t).all()
    used = w > 0 if w.sum() > 0 else torch.ones(6, dtype=torch.bool)
    assert t.min() >= e[:-1][used].min() and t.max() <= e[1:][used].max()
    assert (t.diff() >= -1e-6 * e[-1]).all()


def test_a_weight_that_is_not_a_number_is_not_hidden() -> None:
    t = sample_pdf(torch.arange(4.0).expand(2, 4), torch.tensor([[0.5, math.nan, 0.1], [1.0, 1.0, 1.0]]), 3, None)
    assert t[0].isnan().all() and t[1].tolist() == [0.5, 1.5, 2.5]


def test_no_gradient_passes() -> None:
    weights = torch.ones(4, requires_grad=True)
    assert not sample_pdf(torch.arange(5.0), weights, 3, None).requires_grad


def test_chunks_of_rays_are_independent() -> None:
    edges, weights = torch.sort(torch.rand(8, 5), -1).values, torch.rand(8, 4)
    assert torch.equal(sample_pdf(edges, weights, 7, None)[2:5], sample_pdf(edges[2:5], weights[2:5], 7, None))
