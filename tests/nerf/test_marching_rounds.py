"""Ray-marching rounds of the hash-grid field: what they render, and how many densities they take."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerf.fields import mlp
from nerf.fields.hash_grid import THINNING_THRESHOLD, HashGridField, HashGridSettings
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.kernels import GridLayout, RayStepping, Samples, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import binary_occupancy
from nerf.rendering.early_termination import EARLY_STOP_TRANSMITTANCE
from tests.nerf.hash_grid_fields import CONTRACTED, SMALL, dense_field, field, rays


def in_rounds(model: HashGridField, given: Rays, background: Tensor) -> tuple[Rendering, int]:
    """The rendering, and of how many samples the density was asked for it."""
    asked, encode = [0], reference.encode

    def counted(layout: GridLayout, table: Tensor, points: Tensor) -> Tensor:
        asked[0] += len(points)
        return encode(layout, table, points)

    counting: Any = SimpleNamespace(**vars(reference) | {"encode": counted})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "backend", counting)
        return model.render(given, background), asked[0]


def in_one_pass(
    model: HashGridField, stepping: RayStepping, given: Rays, jitter: Tensor, background: Tensor, thin: float = 0.0
) -> tuple[int, Samples, Rendering]:
    """How many samples stand in occupied cells, those that can be seen, and what rays see; no rounds."""
    samples = reference.march(binary_occupancy(model.occupancy_bits), stepping, given, jitter)
    density = model._density_pass(reference.sample_points(given, samples, model.space.bends_rays))
    front, seen = reference.visible_samples(samples, density.sigma, EARLY_STOP_TRANSMITTANCE, thin, jitter)
    ray_hidden = mlp.direction_hidden(model.weights, reference.spherical_harmonics(given.directions))
    colour = mlp.colour_forward(model.weights, reference, front.ray, density.geometry_features[seen], ray_hidden)
    behind = background.repeat(len(jitter), 1)
    rendering, _ = reference.composite(front, density.sigma[seen], colour, behind, given.far)
    return len(samples.t), front, rendering


def in_short_rounds(monkeypatch: pytest.MonkeyPatch, whole: int, shortest: int, longest: int) -> None:
    for name, length in {
        "ROUND_SAMPLES": {"cpu": whole},
        "MIN_ROUND_SAMPLES_PER_RAY": shortest,
        "MAX_ROUND_SAMPLES_PER_RAY": {"cpu": longest},
    }.items():
        monkeypatch.setattr(f"nerf.rendering.early_termination.{name}", length)


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED])
@pytest.mark.parametrize("lengths", [(1, 1, 1), (60, 2, 5), (1 << 15, 8, 64)])
def test_rounds_through_thin_density_see_what_one_pass_sees(
    settings: HashGridSettings, lengths: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    in_short_rounds(monkeypatch, *lengths)
    model, given, background = field(settings), rays(40), torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    model.set_occupancy(
        model.occupancy_bits.random_(generator=torch.Generator().manual_seed(5))
    )  # half of the cells are closed
    density_evaluations, front, whole = in_one_pass(
        model, model.render_stepping, given, torch.full_like(given.near, 0.5), background
    )
    rounds, asked = in_rounds(model, given, background)
    assert asked == density_evaluations == len(front.t) > 40
    assert whole.opacity.min() < 0.5 < whole.opacity.max()
    torch.testing.assert_close(tuple(rounds), tuple(whole), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED])
def test_rounds_end_soon_behind_opaque_cells(settings: HashGridSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    in_short_rounds(monkeypatch, 80, 2, 64)
    model, given, background = dense_field(settings), rays(40), torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    density_evaluations, front, whole = in_one_pass(
        model, model.render_stepping, given, torch.full_like(given.near, 0.5), background
    )
    rounds, asked = in_rounds(model, given, background)
    assert len(front.t) < asked < 0.7 * density_evaluations
    assert whole.opacity.min() > 0.99
    left = EARLY_STOP_TRANSMITTANCE * torch.tensor([1.0, 5.0, 1.0])  # of a ray's colour, depth and opacity
    for one, other, most in zip(rounds, whole, left, strict=True):
        assert 0 < (one - other).abs().max() < most


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED])
def test_compiled_rounds_see_what_a_single_pass_sees(
    settings: HashGridSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, given = (
        HashGridField(replace(settings, occupancy_resolution=32), 0, warp),
        rays(300).each(lambda part: part.float()),
    )
    model.table.mul_(3e4)
    few = torch.randint(len(model.occupancy_bits), (40,), generator=torch.Generator().manual_seed(5))
    model.set_occupancy(torch.zeros_like(model.occupancy_bits).index_fill_(0, few, -1))
    pictures = []
    for lengths in ((1 << 16, 64, 64), (1, 2, 2)):
        in_short_rounds(monkeypatch, *lengths)
        pictures.append(model.render(given, torch.ones(3)))
    assert pictures[0].opacity.max() > 0.1
    for one, other in zip(*pictures, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED])
@pytest.mark.parametrize("lengths", [(1, 1, 1), (80, 2, 64)])
@pytest.mark.parametrize("dense", [False, True])
def test_training_keeps_all_samples_whatever_the_rounds(
    settings: HashGridSettings, lengths: tuple[int, int, int], dense: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_short_rounds(monkeypatch, *lengths)
    model, given = (dense_field if dense else field)(settings), rays(40)
    model.set_occupancy(model.occupancy_bits.random_(generator=torch.Generator().manual_seed(5)))
    jitter = torch.rand(40, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    density_evaluations, front, whole = in_one_pass(
        model, model.stepping, given, jitter, background, THINNING_THRESHOLD
    )
    done = model.forward(given, jitter, jitter, background.repeat(40, 1))
    assert done.density_evaluations < density_evaluations if dense else done.density_evaluations == density_evaluations
    assert torch.equal(done.samples.starts, front.starts) and torch.equal(done.samples.ray, front.ray)
    torch.testing.assert_close(done.samples[2:], front[2:], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(tuple(done.rendering), tuple(whole), rtol=1e-9, atol=1e-9)


def test_a_ray_ends_after_the_most_samples_it_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    in_short_rounds(monkeypatch, 1, 3, 3)
    model, given = field(replace(SMALL, max_samples_per_ray=7)), rays(40)
    middle = torch.full_like(given.near, 0.5)
    done = model.forward(given, middle, middle, torch.zeros(40, 3, dtype=torch.float64))
    assert done.density_evaluations == 7 * 40 and done.samples.starts.diff().max() <= 7
