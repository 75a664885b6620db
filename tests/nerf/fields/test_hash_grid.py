import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf.fields import mlp
from nerf.fields.background import BACKGROUND_LAYOUT, background_colour
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.kernels import Backend, GridLayout, warp
from nerf.kernels import torch as reference
from nerf.kernels.torch.occupancy import binary_occupancy
from tests.nerf.hash_grid_fields import (
    BACKENDS,
    CONTRACTED,
    DIFFUSE,
    FORWARD,
    OUTDOORS,
    SMALL,
    field,
    rays,
)


def seen_by_autograd(model: HashGridField, given: Rays, jitter: Tensor, background: Tensor) -> Tensor:
    """The loss sum(colour * k) + sum(depth) written with plain torch, differentiable in parameters and rays."""
    settings, space = model.settings, model.space
    mapped = space.map_rays(given.each(lambda part: part.detach()))
    samples = reference.march(binary_occupancy(model.occupancy_bits), model.stepping, mapped.rays, jitter)
    lengths = samples.dt * mapped.scene_length(samples.t, samples.ray)
    samples = samples._replace(t=mapped.to_scene(samples.t, samples.ray), dt=lengths)
    points = space.forward(given.origins[samples.ray] + samples.t[:, None] * given.directions[samples.ray])
    points = (points + space.half) / (2 * space.half)
    features = encoded_by_autograd(model.layout, model.table, points)
    if settings.background_model:
        on_sphere = encoded_by_autograd(BACKGROUND_LAYOUT, model.background_table, (given.directions + 1) / 2)
        background = torch.sigmoid(on_sphere.view(len(on_sphere), -1, 4).sum(1))[:, :3]
    weights = model.weights
    geometry_features = torch.relu(features @ weights.density_hidden) @ weights.density_out.T
    sigma = geometry_features[:, 0].clamp(max=15).exp()
    harmonics = model.encode_directions(given.directions)[samples.ray]
    hidden = torch.relu(torch.cat([geometry_features, harmonics], -1) @ weights.colour_hidden)
    rendering, _ = reference.composite(
        samples, sigma, torch.sigmoid(hidden @ weights.colour_out.T), background, given.far
    )
    return (rendering.colour * torch.tensor([1.0, 2.0, -3.0])).sum() + rendering.depth.sum()


def encoded_by_autograd(layout: GridLayout, table: Tensor, points: Tensor) -> Tensor:
    features = []
    for level, resolution in enumerate(layout.resolutions):
        scaled = points * resolution
        cell = scaled.detach().floor().clamp(0, resolution - 1)
        inside = scaled - cell
        value = torch.zeros(len(points), layout.features, dtype=points.dtype)
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            share = torch.where(corner.bool(), inside, 1 - inside).prod(-1)
            x, y, z = (cell.long() + corner).unbind(-1)
            if layout.is_hashed(level):
                number = (x ^ (y * 2654435761) ^ (z * 805459861)) % layout.level_rows(level)
            else:
                number = (x * (resolution + 1) + y) * (resolution + 1) + z
            value = value + share[:, None] * table[layout.level_offsets[level] + number]
        features.append(value)
    return torch.cat(features, -1)


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED, OUTDOORS, DIFFUSE, FORWARD])
def test_all_gradients_are_those_of_autograd(settings: HashGridSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerf.fields.hash_grid.THINNING_THRESHOLD", 0.0)
    model, given = field(settings), rays()
    jitter = torch.rand(6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    background = torch.rand(6, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    done = model.forward(given, jitter, jitter, background)
    assert done.density_evaluations == len(done.samples.t), "these are to be compared without early termination"
    ones = torch.ones(6, dtype=torch.float64)
    grad = Rendering(torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64).expand(6, 3), ones, 0 * ones)
    gradients = model.backward(done, grad, torch.zeros_like(done.weights))
    grad_table = torch.zeros_like(model.table)
    reference.encode_backward_table(model.layout, range(2), done.points, gradients.features, grad_table)
    ray_hidden = model.rays_backward(done, gradients)

    of_sky = [model.background_backward(done, gradients)] if settings.background_model else []

    skies = [model.background_table] if settings.background_model else []
    parameters = [model.table, *model.weights, *skies, given.origins, given.directions]
    for parameter in parameters:
        parameter.requires_grad_()
    wanted = torch.autograd.grad(seen_by_autograd(model, given, jitter, background), parameters)
    assert all(part.abs().max() > 1e-3 for part in wanted)
    torch.testing.assert_close((grad_table, *gradients.weights, *of_sky, *ray_hidden), wanted, rtol=1e-9, atol=1e-10)


def test_density_is_bounded_in_value_and_gradient() -> None:
    logits = torch.tensor([-1e30, -100.0, 0.0, 15.0, 16.0, 1e30])
    geometry_features = torch.zeros(6, 16)
    geometry_features[:, 0] = logits
    sigma = mlp.sigma_of(geometry_features)
    assert sigma.isfinite().all()
    assert sigma.max() == pytest.approx(math.exp(15))
    assert sigma[2] == 1


def test_it_is_a_radiance_model_of_the_scene_frame() -> None:
    model = field()
    assert isinstance(model, RadianceModel)
    points = torch.tensor([[[0.0, 0, 0], [0.89, 0.1, -0.89]], [[0.91, 0, 0], [0, 0, -5]]], dtype=torch.float64)
    density = model.density(points)
    assert (density[0] > 0).all() and (density[1] == 0).all()
    towards = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    again, colour = model.density_and_colour(points, towards.expand_as(points))
    torch.testing.assert_close(again, density)
    assert colour.shape == points.shape and ((colour > 0) & (colour < 1)).all()
    compiled = HashGridField(SMALL, 0, warp)
    assert compiled.density_and_colour(points.float(), towards.float().expand_as(points))[1].shape == points.shape
    assert (field(CONTRACTED).density(1e6 * points) > 0).all()


def test_density_agrees_with_what_rays_see() -> None:
    """The opacity along a ray is 1 - exp(-∫ sigma dt), here by the middle rule on the field's own stepping."""
    model, given = field(), rays()
    rendering = model.render(given, torch.zeros(3, dtype=torch.float64))
    step = model.stepping.step_size
    middle = torch.full((6,), 0.5, dtype=torch.float64)
    samples = reference.march(binary_occupancy(model.occupancy_bits), model.stepping, given, middle)
    points = given.origins[samples.ray] + samples.t[:, None] * given.directions[samples.ray]
    depth = torch.zeros(6, dtype=torch.float64).index_add(0, samples.ray.long(), model.density(points) * samples.dt)
    torch.testing.assert_close(rendering.opacity, -torch.expm1(-depth), rtol=0, atol=2e-3)
    assert rendering.opacity.min() > 0.05 and samples.dt.max() == pytest.approx(step)


def test_contracted_space_is_rendered_with_closer_samples_than_trained() -> None:
    """The opacity of a drawn ray by the middle rule with shorter steps; a box keeps its own."""
    model, given = field(CONTRACTED), rays()
    closer = model.stepping._replace(
        step_size=model.stepping.step_size / 1.5, cone_angle=model.stepping.cone_angle / 1.5, max_samples=1536
    )
    middle = torch.full((6,), 0.5, dtype=torch.float64)
    samples = reference.march(binary_occupancy(model.occupancy_bits), closer, given, middle)
    points = given.origins[samples.ray] + samples.t[:, None] * given.directions[samples.ray]
    depth = torch.zeros(6, dtype=torch.float64).index_add(0, samples.ray.long(), model.density(points) * samples.dt)
    drawn = model.render(given, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(drawn.opacity, -torch.expm1(-depth), rtol=0, atol=2e-3)
    assert field().render_stepping == field().stepping


def test_closed_cells_are_not_seen() -> None:
    model, given = field(), rays()
    model.set_occupancy(torch.zeros_like(model.occupancy_bits))
    rendering = model.render(given, torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64))
    assert (rendering.opacity == 0).all()
    assert torch.equal(rendering.depth, given.far)
    assert rendering.colour[3].tolist() == [0.2, 0.4, 0.6]


@pytest.mark.parametrize("settings", [SMALL, CONTRACTED])
def test_density_is_zero_in_empty_cells_and_beyond_the_box(
    settings: HashGridSettings,
) -> None:
    model = field(settings)
    model.occupancy_bits[::2] = 0
    points = 2.4 * torch.rand(500, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64) - 1.2
    density, colour = model.density_and_colour(points, torch.nn.functional.normalize(points, dim=-1))
    assert 0.1 < (density > 0).double().mean() < 0.9
    torch.testing.assert_close(density, model.density(points))
    assert colour.isfinite().all(), "also where it is without meaning"


def test_what_nothing_stops_ends_in_the_sky_whatever_the_background() -> None:
    model, given = field(OUTDOORS), rays()
    model.set_occupancy(torch.zeros_like(model.occupancy_bits))
    seen = [model.render(given, torch.full((3,), shade, dtype=torch.float64)).colour for shade in (0.0, 1.0)]
    assert torch.equal(*seen) and seen[0].std(0).min() > 0.01
    torch.testing.assert_close(seen[0], background_colour(reference, model.background_table, given.directions))
    there_too = Rays(1000 + given.origins, *given[1:])
    assert torch.equal(model.render(there_too, torch.zeros(3, dtype=torch.float64)).colour, seen[0])


def test_a_new_sky_is_grey_all_around() -> None:
    model = HashGridField(OUTDOORS, 1, reference)
    assert (
        background_colour(reference, model.background_table, torch.nn.functional.normalize(torch.randn(99, 3))) == 0.5
    ).all()


@BACKENDS
def test_a_new_sky_is_a_grey_background_bit_for_bit(backend: Backend) -> None:
    with_sky, without = HashGridField(OUTDOORS, 1, backend), HashGridField(CONTRACTED, 1, backend)
    assert_same_field(with_sky, without)
    assert with_sky.state_dict().keys() - without.state_dict().keys() == {"background_table"}


@BACKENDS
def test_zero_view_dependence_is_diffuse_bit_for_bit(backend: Backend) -> None:
    dependent, diffuse = HashGridField(SMALL, 1, backend), HashGridField(DIFFUSE, 1, backend)
    dependent.colour_hidden[mlp.GEOMETRY_FEATURES :] = 0
    weights = dependent.state_dict()
    diffuse.load_state_dict(weights | {"colour_hidden": weights["colour_hidden"][: mlp.GEOMETRY_FEATURES]})
    assert_same_field(dependent, diffuse)


def assert_same_field(one: HashGridField, other: HashGridField) -> None:
    """What two fields let rays see before grey, drawn and in training, and what both have of gradients."""
    given, grey = rays(40).each(lambda part: part.float()), torch.full((3,), 0.5)
    for model in (one, other):
        model.table.mul_(2e4)
    for found, wanted in zip(one.render(given, grey), other.render(given, grey), strict=True):
        assert torch.equal(found, wanted) and found.std() > 0.001
    jitter = torch.rand(40, generator=torch.Generator().manual_seed(3))
    done = [model.forward(given, jitter, jitter, grey.repeat(40, 1)) for model in (one, other)]
    assert all(torch.equal(*both) for both in zip(*(passed.rendering for passed in done), strict=True))
    grad = Rendering(torch.ones(40, 3), torch.ones(40), torch.zeros(40))
    gradients = [model.backward(passed, grad, passed.weights) for model, passed in zip((one, other), done, strict=True)]
    assert torch.equal(gradients[0].features, gradients[1].features) and gradients[0].features.any()
    for found, wanted in zip(*(each.weights for each in gradients), strict=True):
        assert torch.equal(found[: len(wanted)], wanted) and wanted.any()


def test_parameters_depend_on_the_seed_alone() -> None:
    one, same, other = (HashGridField(SMALL, seed, reference).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["table"], other["table"])
    assert set(one) == {
        "table",
        "occupancy_bits",
        "empty_distance",
        "density_hidden",
        "density_out",
        "colour_hidden",
        "colour_out",
    }
    assert 0.9e-4 < one["table"].abs().max() <= 1e-4


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_levels": 0}, "levels is 0; it must be at least 1"),
        ({"base_res": 10}, "max_res is 9; it must be at least 10"),
        ({"occupancy_resolution": 10}, "occupancy_resolution is 10; it must be a multiple of 4"),
        ({"cone_angle": 0.0}, r"min_step_size \(0.002\) and cone_angle \(0.0\) must be positive"),
    ],
)
def test_impossible_sizes_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **wrong)


def test_what_is_empty_follows_from_what_is_occupied() -> None:
    model = field(replace(SMALL, occupancy_resolution=32))
    for cell in (5, 17):
        bits = torch.zeros_like(model.occupancy_bits)
        bits[cell] = 1
        model.set_occupancy(bits)
        assert torch.equal(model.occupancy_bits, bits)
        assert (
            torch.equal(model.empty_distance, binary_occupancy(bits).empty_distance)
            and model.empty_distance.unique().numel() > 3
        )


@pytest.mark.parametrize(
    "settings", [replace(SMALL, diagonal_steps=500), replace(CONTRACTED, min_step_size=0.005, cone_angle=0.01)]
)
def test_thin_samples_that_stand_for_others_keep_picture_and_gradients(
    settings: HashGridSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On average over the offsets, but for what second order in a thin sample's thickness makes of it."""
    model, given, draws = field(settings), rays(40), 64
    jitter = torch.rand(40, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64).expand(40, 3)
    grad = Rendering(torch.full_like(background, 1.0), torch.zeros(40).double(), torch.zeros(40).double())

    def seen_and_gradients(offset: float) -> tuple[int, list[Tensor]]:
        done = model.forward(given, jitter, torch.full_like(jitter, offset), background)
        gradients = model.backward(done, grad, torch.zeros_like(done.weights))
        probability = done.optical_thickness / (done.density.sigma * done.samples.dt)
        assert 1 / 17 < probability.min() <= probability.max() < 1.001
        return len(done.points), [*done.rendering, *gradients.weights]

    with monkeypatch.context() as patch:
        patch.setattr("nerf.fields.hash_grid.THINNING_THRESHOLD", 0.0)
        every, wanted = seen_and_gradients(0.0)
    counts, found = zip(*(seen_and_gradients((draw + 0.5) / draws) for draw in range(draws)), strict=True)
    assert max(counts) < 0.9 * every
    for each, right in zip(zip(*found, strict=True), wanted, strict=True):
        mean = torch.stack(each).mean(0)
        assert (mean - right).abs().max() < 0.02 * right.abs().max()
