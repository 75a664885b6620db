import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
import torch

from nerf.fields.interface import Rendering
from nerf.fields.vanilla import BOX, SOFTPLUS_SHIFT, VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, SpaceMap, space_map
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.runtime.randomness import generator
from tests.reference import paper_loop

SMALL = VanillaSettings(
    depth=3, width=6, skip=0, position_frequencies=3, direction_frequencies=2, samples_coarse=4, samples_fine=5
)
FORWARD = Ndc((0.1, -1.5, 0.0), ((0.96, 0.28, 0.0), (0.0, 0.0, -1.0), (-0.28, 0.96, 0.0)), (1.2, 1.4), 0.4)
VARIANTS = {
    "as published": {"density_activation": "relu"},
    "softplus": {},
    "contracted": {"space": Contraction(), "spacing": "log"},
    "forward-facing": {"space": FORWARD},
    "no view dependence": {"view_dependence": False},
    "no positional encoding": {"positional_encoding": False},
    "no hierarchical sampling": {"hierarchical": False},
    "no skip": {"skip": 4},
}
BACKGROUND = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)


def rays_at(target_spread: float, count: int, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays from a sphere of radius 3 past the origin; with a wide spread some of them miss the box."""
    random = torch.Generator().manual_seed(1)
    origins = torch.randn(count, 3, dtype=torch.float64, generator=random)
    origins = 3 * origins / origins.norm(dim=-1, keepdim=True)
    targets = target_spread * (2 * torch.rand(count, 3, dtype=torch.float64, generator=random) - 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    near, far = torch.full((count,), 0.5, dtype=torch.float64), torch.full((count,), 9.0, dtype=torch.float64)
    return Rays(*(part.to(dtype) for part in (origins, directions, near, far)))


def model_of(settings: VanillaSettings, seed: int = 0) -> VanillaNerf:
    """A float64 model with random biases as well, and a little denser than a fresh one, so that rays saturate."""
    model = VanillaNerf(settings, seed).double()
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("bias"):
                parameter.copy_(0.3 * torch.randn(parameter.shape, dtype=torch.float64, generator=random))
            if name.endswith("density_head.bias"):
                parameter.copy_(torch.tensor([1.0]))
    return model


def weights_of(model: VanillaNerf) -> paper_loop.Weights:
    return {name: value.double().numpy() for name, value in model.state_dict().items()}


def middle_jitter(settings: VanillaSettings) -> tuple[np.ndarray, np.ndarray]:
    first = settings.samples_coarse if settings.hierarchical else settings.queries_per_ray
    return np.full(first, 0.5), np.full(settings.samples_fine, 0.5)


def slow(
    weights: paper_loop.Weights, settings: VanillaSettings, rays: Rays, jitters: list | None = None
) -> list[tuple]:
    """(coarse, fine) of every ray by the slow loop."""
    results = []
    for i in range(len(rays.near)):
        ray = (rays.origins[i].numpy(), rays.directions[i].numpy(), rays.near[i].item(), rays.far[i].item())
        jitter = jitters[i] if jitters else middle_jitter(settings)
        results.append(
            paper_loop.render(weights, dataclasses.asdict(settings), SOFTPLUS_SHIFT, ray, BACKGROUND.numpy(), jitter)
        )
    return results


def difference(renderings: tuple[Rendering, Rendering], expected: list[tuple]) -> float:
    """The largest error of colour, opacity and depth (depth relative to far, 9)."""
    errors = []
    for i, pair in enumerate(expected):
        for rendering, (colour, depth, opacity) in zip(renderings, pair, strict=True):
            errors.append(np.abs(rendering.colour[i].detach().double().numpy() - colour).max())
            errors.append(abs(rendering.opacity[i].item() - opacity))
            errors.append(abs(rendering.depth[i].item() - depth) / 9)
    return max(errors)


@pytest.mark.parametrize("variant", VARIANTS)
def test_float64_agrees_with_the_slow_loop(variant: str) -> None:
    settings = dataclasses.replace(SMALL, **VARIANTS[variant])
    model, rays = model_of(settings), rays_at(1.5, 12)
    with torch.no_grad():
        renderings = model.render_training(rays, BACKGROUND, None)
    assert renderings[1].opacity.max() > 0.2
    assert (renderings[1].opacity.min() == 0) != settings.space.bends_rays  # some rays miss the box
    expected = slow(weights_of(model), settings, rays)
    assert difference(renderings, expected) < 1e-9
    only_fine = model.render(rays, BACKGROUND)
    assert difference((only_fine, only_fine), [(fine, fine) for _, fine in expected]) < 1e-9


def test_random_samples_agree_with_the_slow_loop() -> None:
    model, rays = model_of(SMALL), rays_at(0.8, 5)
    with torch.no_grad():
        renderings = model.render_training(rays, BACKGROUND, generator("cpu", 7))
    same = generator("cpu", 7)
    first, second = (torch.rand(5, n, dtype=torch.float64, generator=same).numpy() for n in (4, 5))
    jitters = list(zip(first, second, strict=True))
    assert difference(renderings, slow(weights_of(model), SMALL, rays, jitters)) < 1e-9
    assert difference(renderings, slow(weights_of(model), SMALL, rays)) > 1e-3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("space", [Box(), Contraction()], ids=["box", "contraction"])
@pytest.mark.parametrize(
    "settings",
    [VanillaSettings(width=16), VanillaSettings(depth=4, width=64, samples_coarse=32, samples_fine=32)],
    ids=["narrow", "shallow"],
)
def test_float32_agrees_with_the_slow_loop_at_the_published_frequencies(
    settings: VanillaSettings, space: SpaceMap, seed: int
) -> None:
    settings = dataclasses.replace(settings, space=space)
    model, rays = VanillaNerf(settings, seed), rays_at(0.8 + 0.1 * seed, 2, torch.float32)
    with torch.no_grad():
        renderings = model.render_training(rays, BACKGROUND.float(), None)
    assert renderings[1].colour.dtype == torch.float32
    expected = slow(weights_of(model), settings, rays.each(lambda part: part.double()))
    assert 0 < difference(renderings, expected) < 1e-5


def loss_gradients(model: VanillaNerf, rays: Rays) -> dict[str, np.ndarray]:
    model.zero_grad()
    coarse, fine = model.render_training(rays, BACKGROUND.to(rays.near.dtype), None)
    loss = sum((r.colour**2).sum() + 0.1 * r.depth.sum() + r.opacity.sum() for r in (coarse, fine))
    assert isinstance(loss, torch.Tensor)
    loss.backward()
    return {name: p.grad.double().numpy() for name, p in model.named_parameters() if p.grad is not None}


def complex_step_gradients(model: VanillaNerf, settings: VanillaSettings, rays: Rays) -> dict[str, np.ndarray]:
    weights: Any = {name: value.astype(complex) for name, value in weights_of(model).items()}
    gradients = {name: np.zeros(value.shape) for name, value in weights.items()}
    for name, value in weights.items():
        for index in np.ndindex(value.shape):
            before = value[index]
            value[index] += 1e-30j
            pairs = slow(weights, settings, rays)
            loss = sum(np.sum(c**2) + 0.1 * d + o for pair in pairs for c, d, o in pair)
            gradients[name][index] = loss.imag / 1e-30
            value[index] = before
    return gradients


@pytest.mark.parametrize(
    ("variant", "sizes"),
    [("softplus", {}), ("as published", {}), ("contracted", {}), ("no hierarchical sampling", {"samples_fine": 1})],
)
def test_gradients_of_every_weight_agree_with_the_slow_loop(variant: str, sizes: dict[str, int]) -> None:
    tiny = {"width": 4, "depth": 2, "position_frequencies": 1, "direction_frequencies": 1, "samples_coarse": 3}
    settings = dataclasses.replace(SMALL, **(tiny | {"samples_fine": 3} | sizes | VARIANTS[variant]))
    model, rays = model_of(settings), rays_at(0.5, 2)
    expected = complex_step_gradients(model, settings, rays)
    assert all(np.abs(g).max() > 1e-4 for g in expected.values())
    found = loss_gradients(model, rays)
    assert found.keys() == expected.keys()
    assert max(np.abs(found[name] - expected[name]).max() for name in found) < 1e-9
    rough = loss_gradients(model.float(), rays.each(lambda part: part.float()))
    assert 0 < max(np.abs(rough[name] - expected[name]).max() for name in rough) < 1e-5


def test_published_sizes() -> None:
    """The published code has 595 844 weights; three layers of it also take the 3 identity terms gamma lacks here."""
    sizes = {name: tuple(value.shape) for name, value in VanillaNerf(VanillaSettings(), 0).fine.named_parameters()}
    assert sizes["trunk.0.weight"] == (256, 60) and sizes["trunk.5.weight"] == (256, 316)
    assert all(sizes[f"trunk.{i}.weight"] == (256, 256) for i in (1, 2, 3, 4, 6, 7))
    assert sizes["colour_hidden.weight"] == (128, 280) and sizes["colour_head.weight"] == (3, 128)
    assert sum(math.prod(size) for size in sizes.values()) == 595_844 - 3 * (256 + 256 + 128)


def test_queries_per_ray_are_the_published_ones() -> None:
    assert VanillaSettings().queries_per_ray == 64 + 192


def test_without_hierarchical_sampling_there_is_one_network_and_one_rendering() -> None:
    model = VanillaNerf(dataclasses.replace(SMALL, hierarchical=False), 0)
    assert not any(name.startswith("coarse") for name, _ in model.named_parameters())
    coarse, fine = model.render_training(rays_at(0.5, 3, torch.float32), torch.ones(3), None)
    assert coarse is fine


def test_without_view_dependence_colour_has_no_direction_weights() -> None:
    points, d = torch.rand(4, 3) - 0.5, torch.nn.functional.normalize(torch.randn(2, 4, 3), dim=-1)
    seeing, blind = VanillaNerf(SMALL, 0), VanillaNerf(dataclasses.replace(SMALL, view_dependence=False), 0)
    one, other = (seeing.density_and_colour(points, towards)[1] for towards in d)
    assert not torch.allclose(one, other)
    one, other = (blind.density_and_colour(points, towards)[1] for towards in d)
    assert torch.equal(one, other)
    assert blind.fine.colour_hidden.in_features == SMALL.width


def test_opposite_directions_along_an_axis_are_told_apart() -> None:
    up = torch.tensor([[0.0, 0.0, 1.0]])
    model, point = VanillaNerf(SMALL, 0), torch.zeros(1, 3)
    one, other = (model.density_and_colour(point, towards)[1] for towards in (up, -up))
    assert not torch.allclose(one, other, atol=1e-4)


def test_no_points_are_no_trouble() -> None:
    model, none = VanillaNerf(SMALL, 0), torch.zeros(0, 3)
    assert model.density(none).shape == (0,)
    assert [each.shape for each in model.density_and_colour(none, none)] == [(0,), (0, 3)]


def test_density_is_independent_of_direction_and_zero_outside_the_box() -> None:
    model = VanillaNerf(SMALL, 0)
    points = torch.tensor([[0.3, -0.2, 0.1], [0.0, BOX + 1e-3, 0.0], [2.3, -0.2, 0.1], [1e30, 0.0, 0.0]])
    sigma = model.density(points)
    assert sigma[0] > 0 and sigma[1:].tolist() == [0, 0, 0]
    torch.testing.assert_close(model.density_and_colour(points, torch.rand(4, 3))[0], sigma)


def test_a_contracted_field_fills_all_of_space() -> None:
    model = VanillaNerf(dataclasses.replace(SMALL, space=Contraction(), spacing="log"), 0)
    sigma = model.density(torch.tensor([[0.3, 0.1, 0.1], [2.3, 0.1, 0.1], [1e4, 0.0, 0.0], [1e30, 0.0, 0.0]]))
    assert torch.isfinite(sigma).all() and (sigma > 0).all()
    assert sigma[0] != sigma[1]


@pytest.mark.parametrize("space", [Box(), Contraction()], ids=["box", "contraction"])
def test_a_fresh_field_is_neither_empty_nor_opaque(space: SpaceMap) -> None:
    settings = VanillaSettings(depth=4, width=64, samples_coarse=16, samples_fine=16, space=space)
    for seed in range(3):
        opacity = VanillaNerf(settings, seed).render(rays_at(0.5, 64, torch.float32), torch.ones(3)).opacity
        assert 0.05 < opacity.mean() < 0.95


def test_weights_are_a_function_of_the_seed_alone() -> None:
    before = torch.get_rng_state()
    first, again, other = (VanillaNerf(SMALL, seed).state_dict() for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["fine.trunk.0.weight"], other["fine.trunk.0.weight"])
    assert not torch.equal(first["fine.trunk.0.weight"], first["coarse.trunk.0.weight"])


def test_rays_may_have_any_leading_shape() -> None:
    model, rays = VanillaNerf(SMALL, 0), rays_at(0.8, 6, torch.float32)
    grid = rays.each(lambda part: part.reshape(2, 3, *part.shape[1:]))
    torch.testing.assert_close(
        model.render(grid, torch.ones(3)).colour.reshape(6, 3), model.render(rays, torch.ones(3)).colour
    )


def test_a_ray_that_misses_shows_the_background() -> None:
    model = VanillaNerf(SMALL, 0)
    missing = Rays(torch.tensor([[5.0, 5.0, 0]]), torch.tensor([[0.0, 0, 1]]), torch.tensor([1.0]), torch.tensor([4.0]))
    coarse, fine = model.render_training(missing, torch.tensor([[0.1, 0.2, 0.3]]), generator("cpu", 0))
    for rendering in (coarse, fine):
        torch.testing.assert_close(rendering.colour, torch.tensor([[0.1, 0.2, 0.3]]))
        assert (rendering.depth.item(), rendering.opacity.item()) == (4, 0)
    (coarse.colour.sum() + fine.colour.sum()).backward()
    assert all(p.grad is not None and not p.grad.any() for p in model.parameters())


@pytest.mark.parametrize("activation", ["softplus", "relu"])
@pytest.mark.parametrize("size", [-1e30, 1e30])
def test_extreme_densities_are_finite_in_value_and_gradient(activation: Any, size: float) -> None:
    model = VanillaNerf(dataclasses.replace(SMALL, density_activation=activation), 0)
    for mlp in (model.coarse, model.fine):
        assert mlp is not None
        torch.nn.init.constant_(mlp.density_head.bias, size)
    coarse, fine = model.render_training(rays_at(0.5, 4, torch.float32), torch.ones(3), generator("cpu", 0))
    assert torch.allclose(fine.opacity, torch.tensor(1.0 if size > 0 else 0.0))
    (coarse.colour.sum() + fine.colour.sum() + fine.depth.sum()).backward()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize("net", ["coarse", "fine"])
def test_a_weight_that_is_not_a_number_is_not_hidden(net: str) -> None:
    model = VanillaNerf(SMALL, 0)
    torch.nn.init.constant_(model.get_parameter(f"{net}.density_head.bias"), math.nan)
    assert model.render(rays_at(0.5, 4, torch.float32), torch.ones(3)).colour.isnan().all()


def test_settings_survive_json() -> None:
    settings = dataclasses.replace(SMALL, space=Contraction(), spacing="log", density_activation="relu")
    again = json.loads(json.dumps(dataclasses.asdict(settings)))
    assert VanillaSettings(**again | {"space": space_map(**again["space"])}) == settings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": 0}, "depth is 0; it must be at least 1"),
        ({"samples_coarse": 1}, "samples_coarse is 1; it must be at least 2"),
        ({"position_frequencies": 0}, "position_frequencies is 0; it must be at least 1"),
    ],
)
def test_impossible_sizes_are_refused_with_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(SMALL, **change)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("spacing", "cubic", "spacing is 'cubic'; it must be 'linear' or 'log'"),
        ("density_activation", "exp", "density_activation is 'exp'; it must be 'softplus' or 'relu'"),
    ],
)
def test_unknown_choices_are_refused_with_words(name: str, value: str, words: str) -> None:
    settings = dataclasses.replace(SMALL)
    object.__setattr__(settings, name, value)  # the constructor's types are checked in tests, not outside
    with pytest.raises(ValueError, match=words):
        settings.__post_init__()
