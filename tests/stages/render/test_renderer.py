"""What a renderer draws, and how its speed is found."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from stages.io.files import write_json
from stages.render.renderer import Renderer, TimeBudget, trained_seconds


class Slow:
    """A field whose every ray costs the same time, by the clock it carries."""

    chunk_rays = 64

    def __init__(self, seconds_per_ray: float) -> None:
        self.seconds_per_ray, self.rays, self.now = seconds_per_ray, 0, 0.0

    def density(self, points):
        return points[..., 0]

    def density_and_colour(self, points, directions):
        return points[..., 0], points

    def render(self, rays: Rays, background: torch.Tensor) -> Rendering:
        self.now += self.seconds_per_ray * len(rays.near)
        self.rays += len(rays.near)
        return Rendering(rays.directions * background, rays.far, rays.near)


def square(side: int) -> Rays:
    grid = torch.arange(3.0 * side * side).reshape(side, side, 3)
    return Rays(grid, grid, grid[..., 0], grid[..., 1])


def renderer(seconds_per_ray: float = 0.0) -> Renderer:
    return Renderer(Slow(seconds_per_ray), torch.tensor([1.0, 2.0, 3.0]))


def test_a_picture_has_every_ray_in_its_place() -> None:
    shares: list[float] = []
    picture = renderer().render(square(40), shares.append)
    torch.testing.assert_close(picture.colour, square(40).directions * torch.tensor([1.0, 2.0, 3.0]))
    assert picture.depth.shape == picture.opacity.shape == (40, 40)
    assert shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize("seconds_per_ray", [1e-5, 1e-4])
def test_the_speed_found_is_the_fields(seconds_per_ray: float, monkeypatch: pytest.MonkeyPatch) -> None:
    field = Slow(seconds_per_ray)
    monkeypatch.setattr("stages.render.renderer.time", SimpleNamespace(perf_counter=lambda: field.now))
    speed = Renderer(field, torch.zeros(3)).rays_per_second(square, 100, 0.02)
    assert speed == pytest.approx(1 / seconds_per_ray)


def test_timing_ends_at_the_largest_picture() -> None:
    field = Slow(0.0)
    Renderer(field, torch.zeros(3)).rays_per_second(square, 50, 1e9)
    assert field.rays == 24**2 + 24**2 + 34**2 + 49**2 + 50**2


def test_a_picture_smaller_than_the_first_one_tried_will_do() -> None:
    assert renderer().rays_per_second(square, 5, 1e9) > 0


def test_training_took_as_long_as_its_curve_says(tmp_path: Path) -> None:
    write_json(tmp_path / "curve.json", {"points": [{"seconds": 2.0}, {"seconds": 61.5}]})
    assert trained_seconds(tmp_path) == 61.5


def test_images_have_a_share_of_the_time_given(tmp_path: Path) -> None:
    write_json(tmp_path / "curve.json", {"points": [{"seconds": 50.0}]})
    assert TimeBudget(None, tmp_path, 3.0).seconds_left() == 15.0
    assert 5 < TimeBudget(10.0, tmp_path, 3.0).seconds_left() <= 7
    assert 0 < TimeBudget(1.0, tmp_path, 3.0).seconds_left() <= 1
    assert (TimeBudget(None, tmp_path, 3.0).message(), TimeBudget(10.0, tmp_path, 3.0).message()) == (
        "training took 50 s",
        "given 10 s, of which 7 s are left for rendering",
    )
