from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.paper import PaperSettings
from nerf.scene import Camera, Scene
from nerf.training import TrainerSettings
from stages.training_data import scaled_size
from stages.training_size import LEAST_LONG_SIDE, chosen_downscale, rays_per_second
from tests.stages.photo_scene import photographed


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return photographed(tmp_path_factory.mktemp("photos"))[1]  # six training photos


def of_size(scene: Scene, width: int, height: int) -> Scene:
    return replace(scene, cameras=(Camera("PINHOLE", width, height, (1.0, 1.0, 0.0, 0.0)),))


def test_the_budget_draws_each_pixel_about_once(scene: Scene) -> None:
    large = of_size(scene, 2000, 1000)
    downscale = chosen_downscale(large, 3_000_000)
    assert downscale == 2.0
    width, height = scaled_size(large.cameras[0], downscale)
    assert 6 * width * height == 3_000_000


@given(st.integers(30, 6000), st.integers(30, 6000), st.floats(1.0, 1e10))
def test_photos_are_never_enlarged_nor_made_tiny(scene: Scene, width: int, height: int, rays: float) -> None:
    sized = of_size(scene, width, height)
    downscale = chosen_downscale(sized, rays)
    assert downscale >= 1
    long_side = max(scaled_size(sized.cameras[0], downscale))
    assert long_side >= min(LEAST_LONG_SIDE, max(width, height))


@given(st.floats(1.0, 1e9), st.floats(1.0, 100.0))
def test_more_rays_never_mean_smaller_photos(scene: Scene, rays: float, factor: float) -> None:
    sized = of_size(scene, 3000, 2000)
    assert chosen_downscale(sized, rays * factor) <= chosen_downscale(sized, rays)


def test_the_speed_is_measured_on_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.training_size.TIMED_SECONDS", 0.05)
    _, scene = photographed(tmp_path, channels=4)
    field = PaperSettings(depth=1, width=8, samples_coarse=2, samples_fine=2)
    speed = rays_per_second(scene, field, TrainerSettings(64, 0, (1.0, 1.0, 1.0)), "cpu")
    assert 10 < speed < 1e7
