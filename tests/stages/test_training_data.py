from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.scene import Camera
from stages.training_data import scaled_size, training_bank, view_pixels, view_rays
from tests.stages.photo_scene import CAMERA, FOCAL, HEIGHT, WIDTH, ball_photo, photographed


@given(st.integers(1, 9000), st.integers(1, 9000), st.floats(1.0, 50.0))
def test_scaled_sizes_are_within_half_a_pixel(width: int, height: int, downscale: float) -> None:
    scaled = scaled_size(Camera("PINHOLE", width, height, ()), downscale)
    for size, full in zip(scaled, (width, height), strict=True):
        assert isinstance(size, int) and size >= 1
        assert abs(size - full / downscale) <= 0.5 or size == 1


@pytest.mark.parametrize(
    ("downscale", "size"), [(1.0, (1417, 1064)), (2.0, (709, 532)), (2.5, (567, 426)), (1e9, (1, 1))]
)
def test_halves_are_rounded_up(downscale: float, size: tuple[int, int]) -> None:
    assert scaled_size(Camera("PINHOLE", 1417, 1064, ()), downscale) == size


def test_a_views_rays_go_through_its_pixel_centres(tmp_path: Path) -> None:
    _, scene = photographed(tmp_path)
    view = scene.views[1]
    rays = view_rays(scene, view, 1.0)
    assert rays.near.shape == (HEIGHT, WIDTH)
    assert torch.all(rays.near == view.near) and torch.all(rays.far == view.far)
    in_camera = np.array([(3.5 - WIDTH / 2) / FOCAL, (5.5 - HEIGHT / 2) / FOCAL, 1])
    expected = view.scene_from_camera[:, :3] @ in_camera / np.linalg.norm(in_camera)
    np.testing.assert_allclose(rays.directions[5, 3], expected, atol=1e-6)
    np.testing.assert_allclose(rays.origins[5, 3], view.scene_from_camera[:, 3], atol=1e-6)


@pytest.mark.parametrize("downscale", [1.0, 2.0, 3.3])
def test_the_bank_and_the_views_are_the_same_pixels_and_rays(downscale: float, tmp_path: Path) -> None:
    inputs, scene = photographed(tmp_path)
    bank = training_bank(inputs["ingest"], scene, "train", downscale)
    rays, colours, alpha = bank.lookup(torch.arange(len(bank.pixels)))
    views = scene.of_split("train")
    assert alpha is None and len(bank.near) == len(views) == 6
    pixels = [view_pixels(inputs["ingest"], scene, view, downscale).flatten(0, 1) for view in views]
    assert torch.equal(colours, torch.cat(pixels))
    directions = [view_rays(scene, view, downscale).directions.flatten(0, 1) for view in views]
    torch.testing.assert_close(rays.directions, torch.cat(directions))


def test_transparent_pixels_are_shown_over_the_background(tmp_path: Path) -> None:
    inputs, scene = photographed(tmp_path, channels=4)
    over_white = view_pixels(inputs["ingest"], scene, scene.views[0], 1.0)
    torch.testing.assert_close(over_white, torch.from_numpy(ball_photo()).float() / 255)
    over_green = view_pixels(inputs["ingest"], scene, scene.views[0], 1.0, (0.0, 1.0, 0.0))
    assert over_green[0, 0].tolist() == [0, 1, 0]
    assert training_bank(inputs["ingest"], scene, "train", 1.0).pixels.shape[1] == 4


def test_stray_alpha_in_an_opaque_scene_is_laid_over_white(tmp_path: Path) -> None:
    inputs, scene = photographed(tmp_path, channels=4)
    opaque = replace(scene, has_alpha=False)
    bank = training_bank(inputs["ingest"], opaque, "train", 1.0)
    assert bank.pixels.shape[1] == 3
    assert torch.equal(bank.pixels[: WIDTH * HEIGHT], torch.from_numpy(ball_photo()).flatten(0, 1))


def test_cameras_of_test_views_do_not_enter_the_training_bank(tmp_path: Path) -> None:
    inputs, scene = photographed(tmp_path)
    other = replace(CAMERA, params=(FOCAL, FOCAL, 1.0, 1.0))
    views = tuple(replace(view, camera=int(view.split == "train")) for view in scene.views)
    mixed = replace(scene, cameras=(other, CAMERA), views=views)
    bank = training_bank(inputs["ingest"], mixed, "train", 1.0)
    assert len(bank.directions) == WIDTH * HEIGHT
    assert torch.equal(bank.directions, training_bank(inputs["ingest"], scene, "train", 1.0).directions)
