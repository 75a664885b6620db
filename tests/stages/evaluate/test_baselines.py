"""The trivial predictions that a field is measured against."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf.geometry.scene import View
from stages.evaluate.baselines import mean_photo, nearest_view, resized


def _view(name: str, centre: tuple[float, float, float] = (0, 0, 0), angle: float = 0, roll: float = 0) -> View:
    """A view turned by ``angle`` about y, then rolled about its own axis."""
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    spin = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    pose = np.concatenate([turn @ spin, np.array(centre, float)[:, None]], axis=1)
    return View(name, f"images/{name}", 0, pose, 0.1, 4.0, "train")


def test_the_mean_photo_minimises_the_squared_error():
    photos = torch.rand(5, 6, 8, 3, generator=torch.Generator().manual_seed(0))
    mean = mean_photo(photos, [None] * 5)
    prediction = mean.shown_at(6, 8)
    assert torch.allclose(prediction, photos.mean(0), atol=1e-6)
    best = (photos - prediction).square().mean()
    for shift in (-0.01, 0.01):
        assert (photos - prediction - shift).square().mean() > best


def test_mean_colour_counts_each_size_of_photo_once():
    mean = mean_photo(
        [torch.full((2, 2, 3), 0.2), torch.full((40, 30, 3), 0.8), torch.full((2, 2, 3), 0.2)], [None] * 3
    )
    assert mean.image is None
    assert torch.allclose(mean.shown_at(5, 7), torch.full((5, 7, 3), 0.4))


def test_a_mean_of_masked_photos_uses_unmasked_pixels():
    photos = [torch.full((1, 3, 3), value) for value in (0.2, 0.4, 0.9)]
    used = [torch.tensor([[True, False, False]]), torch.tensor([[True, True, False]]), None]
    mean = mean_photo(photos, used)
    assert torch.allclose(mean.shown_at(1, 3)[0, :, 0], torch.tensor([0.5, 0.65, 0.9]))
    assert torch.allclose(mean.colour, torch.full((3,), 0.5))
    hidden = mean_photo(photos[:2], used[:2])
    assert torch.allclose(hidden.shown_at(1, 3)[0, 2], hidden.colour)


def test_a_photo_that_is_masked_away_does_not_count():
    photos, nothing = [torch.full((2, 2, 3), 0.3), torch.ones(2, 2, 3)], torch.zeros(2, 2, dtype=torch.bool)
    assert torch.allclose(mean_photo(photos, [None, nothing]).shown_at(2, 2), photos[0])


def test_fully_masked_photos_take_the_overall_mean():
    nothing = torch.zeros(2, 2, dtype=torch.bool)
    mean = mean_photo([torch.full((2, 2, 3), 0.3), torch.ones(2, 2, 3)], [nothing, nothing])
    assert torch.allclose(mean.shown_at(2, 2), torch.full((2, 2, 3), 0.65))
    with pytest.raises(ValueError, match="the mean of no photos"):
        mean_photo([], [])


def test_a_test_photo_of_another_size_gets_the_mean_colour():
    mean = mean_photo([torch.linspace(0, 1, 12).reshape(2, 2, 3)], [None])
    assert mean.shown_at(2, 2).std() > 0.1
    assert mean.shown_at(3, 2).shape == (3, 2, 3)
    assert torch.allclose(mean.shown_at(3, 2)[0, 0], mean.colour)


def test_the_mean_of_nothing_is_refused():
    with pytest.raises(ValueError, match="the mean of no photos"):
        mean_photo([], [])


def test_nearest_view_weighs_position_and_direction():
    here = _view("here")
    near_but_turned = _view("turned", (0.1, 0, 0), angle=1.0)
    further_same_way = _view("further", (0.5, 0, 0))
    rolled = _view("rolled", roll=math.pi / 2)
    assert nearest_view(here, [near_but_turned, further_same_way, rolled]) is further_same_way
    assert nearest_view(here, [near_but_turned, rolled]) is near_but_turned


@given(st.floats(-3.1, 3.1), st.floats(0, 2))
@settings(max_examples=40, deadline=None)
def test_the_pose_distance_is_scene_units_plus_radians(angle: float, moved: float):
    turned, shifted = _view("turned", angle=angle), _view("shifted", (moved, 0, 0))
    expected = turned if abs(angle) < moved else shifted
    if abs(abs(angle) - moved) > 1e-6:
        assert nearest_view(_view("here"), [turned, shifted]) is expected


def test_ties_go_to_the_first_name_whatever_the_order():
    a, b = _view("a", (1, 0, 0)), _view("b", (-1, 0, 0))
    assert nearest_view(_view("here"), [b, a]) is nearest_view(_view("here"), [a, b]) is a


def test_resizing_keeps_the_mean_and_the_value_of_flat_photos():
    photo = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(0))
    assert resized(photo, 32, 48) is photo
    assert resized(photo, 16, 24).shape == (16, 24, 3)
    assert resized(photo, 16, 24).mean((0, 1)) == pytest.approx(photo.mean((0, 1)), abs=0.01)
    assert torch.allclose(resized(torch.full((9, 5, 3), 0.3), 7, 11), torch.full((7, 11, 3), 0.3))
