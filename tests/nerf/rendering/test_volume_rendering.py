import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.rendering.volume_rendering import composite, volume_weights
from tests.reference import paper_loop

BLACK = torch.zeros(3, dtype=torch.float64)


def random_rays(rays: int = 6, n: int = 9) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    return 5 * rand(rays, n) ** 3, rand(rays, n, 3), 1 + torch.sort(rand(rays, n + 1), -1).values


def test_a_homogeneous_medium_follows_beer_and_lambert() -> None:
    t = torch.linspace(2, 5, 65, dtype=torch.float64)
    sigma = torch.full((64,), 0.7, dtype=torch.float64)
    rendering, weights = composite(sigma, torch.ones(64, 3, dtype=torch.float64), t, BLACK)
    opacity = 1 - math.exp(-0.7 * 3)
    assert rendering.opacity.item() == pytest.approx(opacity, abs=1e-14)
    assert rendering.colour.tolist() == pytest.approx([opacity] * 3, abs=1e-14)
    assert weights[0].item() == pytest.approx(1 - math.exp(-0.7 * 3 / 64), abs=1e-15)


def test_depth_of_a_homogeneous_medium_tends_to_its_closed_form() -> None:
    """E[min(t, far)] = near + (1 - exp(-sigma L)) / sigma; samples at interval starts err by half an interval."""
    expected = 2 + (1 - math.exp(-0.7 * 3)) / 0.7
    errors = []
    for n in (100, 200):
        t = torch.linspace(2, 5, n + 1, dtype=torch.float64)
        sigma = torch.full((n,), 0.7, dtype=torch.float64)
        rendering, _ = composite(sigma, torch.ones(n, 3, dtype=torch.float64), t, BLACK)
        errors.append(expected - rendering.depth.item())
    assert 0 < errors[1] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.01)


def test_weights_and_unstopped_light_partition_unity() -> None:
    sigma, _, t = random_rays()
    weights, optical_depth = volume_weights(sigma, t)
    torch.testing.assert_close(weights.sum(-1) + torch.exp(-optical_depth), torch.ones(6, dtype=torch.float64))


def test_splitting_an_interval_changes_nothing() -> None:
    sigma, colour, t = random_rays()
    middle = (t[:, :-1] + t[:, 1:]) / 2
    finer = torch.sort(torch.cat([t, middle], -1), -1).values
    whole, _ = composite(sigma, colour, t, BLACK)
    split, _ = composite(sigma.repeat_interleave(2, -1), colour.repeat_interleave(2, -2), finer, BLACK)
    torch.testing.assert_close(split.colour, whole.colour)
    torch.testing.assert_close(split.opacity, whole.opacity)


def test_shift_and_scale_of_the_ray() -> None:
    sigma, colour, t = random_rays()
    before, _ = composite(sigma, colour, t, BLACK)
    after, _ = composite(sigma / 10, colour, 10 * t + 3, BLACK)
    torch.testing.assert_close(after.colour, before.colour)
    torch.testing.assert_close(after.depth, 10 * before.depth + 3)


def test_the_background_may_differ_from_ray_to_ray() -> None:
    sigma, colour, t = random_rays()
    backgrounds = torch.linspace(0, 1, 18, dtype=torch.float64).reshape(6, 3)
    together, _ = composite(sigma, colour, t, backgrounds)
    for i in range(6):
        alone, _ = composite(sigma[i], colour[i], t[i], backgrounds[i])
        torch.testing.assert_close(together.colour[i], alone.colour)


def test_agrees_with_the_slow_loop() -> None:
    sigma, colour, t = random_rays()
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    rendering, weights = composite(sigma, colour, t, background)
    for i in range(6):
        expected = paper_loop.composite(
            list(sigma[i].numpy()), list(colour[i].numpy()), t[i, :-1].tolist(), t[i, -1].item(), background.numpy()
        )
        assert rendering.colour[i].tolist() == pytest.approx(expected[0].real.tolist(), abs=1e-13)
        assert rendering.depth[i].item() == pytest.approx(expected[1], abs=1e-13)
        assert rendering.opacity[i].item() == pytest.approx(expected[2], abs=1e-13)
        assert weights[i].tolist() == pytest.approx(expected[3], abs=1e-13)


def test_gradients() -> None:
    sigma, colour, t = (x.requires_grad_() for x in random_rays(2, 5))
    assert torch.autograd.gradcheck(lambda s, c, t: tuple(composite(s, c, t, BLACK)[0]), (sigma, colour, t))


def test_an_empty_interval_shows_the_background_and_reports_far() -> None:
    t = torch.full((1, 5), 7.0, requires_grad=True)
    sigma = torch.full((1, 4), 1e30, requires_grad=True)
    rendering, _ = composite(sigma, torch.rand(1, 4, 3), t, torch.tensor([0.2, 0.4, 0.6]))
    torch.testing.assert_close(rendering.colour, torch.tensor([[0.2, 0.4, 0.6]]))
    assert rendering.depth.item() == 7 and rendering.opacity.item() == 0
    (rendering.colour.sum() + rendering.depth.sum()).backward()
    assert sigma.grad is not None and t.grad is not None
    assert torch.isfinite(sigma.grad).all() and torch.isfinite(t.grad).all()


def test_a_dense_interval_behind_a_thin_one_survives() -> None:
    weights, _ = volume_weights(torch.tensor([0.1, 1e30, 5.0]), torch.tensor([0.0, 1.0, 2.0, 3.0]))
    torch.testing.assert_close(weights, torch.tensor([1 - math.exp(-0.1), math.exp(-0.1), 0.0]))


DENSITIES = st.one_of(
    st.just(0.0), st.floats(0, 2.0**100, width=32), st.floats(-30, 30).map(lambda e: 10.0**e), st.just(3e38)
)


@given(st.lists(DENSITIES, min_size=5, max_size=5), st.sampled_from([torch.float32, torch.float64]))
def test_value_and_gradient_are_finite_at_every_density(densities: list[float], dtype: torch.dtype) -> None:
    """With intervals up to 10 long, 3e38 overflows float32 in the product and in the sum as well."""
    sigma = torch.tensor(densities, dtype=dtype, requires_grad=True)
    t = torch.tensor([0.5, 0.75, 0.75, 1.0, 11.0, 12.0], dtype=dtype)
    colour = torch.tensor([[1.0, 0.0, 0.5]] * 5, dtype=dtype, requires_grad=True)
    rendering, weights = composite(sigma, colour, t, torch.ones(3, dtype=dtype))
    (rendering.colour.square().sum() + rendering.depth + rendering.opacity + weights.square().sum()).backward()
    assert sigma.grad is not None and colour.grad is not None
    for value in (*rendering, weights, sigma.grad, colour.grad):
        assert torch.isfinite(value).all()
    assert 0 <= rendering.opacity.item() <= 1
    assert 0.5 <= rendering.depth.item() <= 12 * (1 + 1e-6)


def test_a_density_that_is_not_a_number_is_not_hidden() -> None:
    sigma = torch.tensor([1.0, math.nan, 1.0])
    rendering, _ = composite(sigma, torch.ones(3, 3), torch.arange(4.0), torch.zeros(3))
    assert rendering.colour.isnan().all()
