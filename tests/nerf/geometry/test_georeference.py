import re

import numpy as np
import pytest

from nerf.geometry.camera_paths import nearest_rotations
from nerf.geometry.georeference import ONE_LINE, Georeference, east_north_up, georeference
from nerf.geometry.scene import Similarity

HERE = (47.3769, 8.5417, 408.0)
METRES_PER_DEGREE = 111_178.0  # northwards at 47 degrees


def walked(count: int = 12, radius_m: float = 60.0) -> np.ndarray:
    """East, north and up of photos around a house, in metres."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 5 * np.sin(3 * angle)], axis=1)


def places(enu: np.ndarray) -> list[tuple[float, float, float | None]]:
    north, east, height = HERE
    per_degree_east = 75_460.0  # at 47.3769 degrees on WGS 84
    return [(north + y / METRES_PER_DEGREE, east + x / per_degree_east, height + z) for x, y, z in enu]


SFM_FROM_ENU = Similarity(0.13, nearest_rotations(np.random.default_rng(3).normal(size=(3, 3))), np.array([4.0, -2, 9]))


def test_east_north_and_up_are_what_they_say() -> None:
    np.testing.assert_allclose(east_north_up(0.0, 0.0), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(east_north_up(90.0, 0.0)[2], [0, 0, 1], atol=1e-15)
    turned = east_north_up(*HERE[:2])
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-15)


def test_the_scale_and_the_directions_are_found() -> None:
    enu = walked()
    found = georeference(SFM_FROM_ENU.points(enu), places(enu))
    assert isinstance(found, Georeference)
    assert found.used == 12 and 0 < found.error_m < 0.05
    assert found.enu_from_sfm.scale == pytest.approx(1 / 0.13, rel=1e-3)
    back = found.enu_from_sfm.rotation @ SFM_FROM_ENU.rotation
    np.testing.assert_allclose(back, np.eye(3), atol=2e-3)
    told = found.to_json()
    assert told["metres_per_unit"] == found.enu_from_sfm.scale and told["photos"] == 12
    assert told["origin"]["latitude"] == pytest.approx(HERE[0], abs=1e-3)


def test_a_few_wrong_places_do_no_harm() -> None:
    enu = walked(20)
    told = enu + np.random.default_rng(0).normal(0, 1, enu.shape)
    told[[3, 11]] += [[400, 0, 0], [0, -900, 50]]
    found = georeference(SFM_FROM_ENU.points(enu), places(told))
    assert isinstance(found, Georeference)
    assert 15 <= found.used <= 18 and 0.5 < found.error_m < 3
    assert found.enu_from_sfm.scale == pytest.approx(1 / 0.13, rel=0.03)


@pytest.mark.parametrize(
    ("enu", "why"),
    [
        (walked()[:3], "3 registered photos"),
        (walked(radius_m=3) * [1, 1, 0], "within 3 m, and GPS errs by up to 10 m"),
        (np.linspace(0, 90, 7)[:, None] * [1.0, 0, 0], "along one line"),
    ],
)
def test_it_says_why_not(enu: np.ndarray, why: str) -> None:
    assert why in str(georeference(SFM_FROM_ENU.points(enu), places(enu)))


@pytest.mark.parametrize("stale", [2, 5, 8])
def test_positions_kept_from_elsewhere_do_no_harm(stale: int) -> None:
    """What a phone says until it has a fix: 300 m off, where all photos are within 20 m."""
    for seed in range(10):
        enu = walked(20, radius_m=20)
        told = enu + np.random.default_rng(seed).normal(0, 2, enu.shape)
        told[:stale] = [300, 100, 20]
        found = georeference(SFM_FROM_ENU.points(enu), places(told))
        assert isinstance(found, Georeference)
        assert found.used <= 20 - stale and found.error_m < 6
        assert found.enu_from_sfm.scale == pytest.approx(1 / 0.13, rel=0.2)


def test_a_photo_without_height_is_left_out() -> None:
    enu = walked() + np.linspace(0, 60, 12)[:, None] * [0, 0, 1]  # round a tower and up
    known = places(enu)
    known[4] = (*known[4][:2], None)
    found = georeference(SFM_FROM_ENU.points(enu), known)
    assert isinstance(found, Georeference) and found.used == 11
    assert found.enu_from_sfm.scale == pytest.approx(1 / 0.13, rel=1e-3)


def test_where_most_have_no_height_none_counts() -> None:
    enu = walked() * [1, 1, 0]
    known = [place if index < 5 else (*place[:2], None) for index, place in enumerate(places(enu))]
    found = georeference(SFM_FROM_ENU.points(enu), known)
    assert isinstance(found, Georeference) and found.origin[2] == 0 and found.used == 12


@pytest.mark.parametrize("seed", range(5))
def test_noise_across_a_straight_walk_tells_no_direction(seed: int) -> None:
    enu = np.linspace(0, 100, 12)[:, None] * [1.0, 0, 0]
    told = enu + np.random.default_rng(seed).normal(0, 7, enu.shape) * [1, 1, 0]
    winding = enu + np.random.default_rng(9).normal(0, 0.1, enu.shape)  # as a hand holds a camera
    assert georeference(SFM_FROM_ENU.points(winding), places(told)) == ONE_LINE


def test_positions_on_a_line_but_for_outliers_tell_no_direction() -> None:
    """A phone that stands still, is moved once, and has one stale position."""
    told = np.zeros((60, 3))
    told[40:59, 0], told[59, 1] = 15.0, 300.0
    known = [(north, east, None) for north, east, _ in places(told)]
    assert georeference(np.random.default_rng(0).normal(size=(60, 3)), known) == ONE_LINE


def test_positions_drawn_to_a_road_tell_no_direction() -> None:
    random = np.random.default_rng(0)
    walk = np.linspace(0, 100, 40)[:, None] * [1.0, 0, 0] + random.normal(0, 8, (40, 3)) * [0, 1, 0]
    told = walk * [1, 0, 0] + random.normal(0, 1, (40, 3)) * [1, 1, 0]
    told[7, 1] = 300.0
    assert georeference(SFM_FROM_ENU.points(walk), places(told)) == ONE_LINE


def test_gps_unrelated_to_the_photos_is_refused() -> None:
    told = np.random.default_rng(1).normal(0, 60, (12, 3))
    why = georeference(SFM_FROM_ENU.points(walked()), places(told))
    assert isinstance(why, str)
    assert re.fullmatch(r"the GPS positions span \d+ m and are \d+ m off the reconstruction", why)
