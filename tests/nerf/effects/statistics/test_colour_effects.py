"""Vignetting, view dependence, transients and participating media: found where they are."""

from dataclasses import replace

import numpy as np
import pytest

from nerf.effects.statistics import outlier_images, view_dependence, vignetting, warnings
from nerf.effects.statistics.exposure import EV, fit_exposure
from nerf.effects.statistics.statistic import Statistic
from nerf.effects.statistics.tracks import TrackColours
from nerf.rendering.srgb_arrays import linear_light
from tests.nerf.effects.statistics.photographed_points import encoded, photographed_points

SEEDS = range(20)


def exposed(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=12) * 0.4


def shining(seed: int, strength: float, **settings: object) -> TrackColours:
    """Points whose sRGB values rise and fall with the azimuth they are seen from, with this deviation over a turn."""
    tracks = photographed_points(seed, per_point=6, **settings)  # pyright: ignore[reportArgumentType]
    azimuth = np.arctan2(tracks.towards[:, 1], tracks.towards[:, 0])
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, tracks.point.max() + 1)[tracks.point]
    change = strength * np.sqrt(2) * np.sin(azimuth + phase)
    colour = np.clip(tracks.colour + change[:, None], 0, 1)
    return replace(tracks, colour=colour, saturated=((colour < 0.02) | (colour > 0.98)).any(axis=1))


@pytest.mark.parametrize("gain", [-0.33, 0.2])
def test_vignetting_is_found_under_exposures(gain: float) -> None:
    for seed in SEEDS:
        tracks = photographed_points(seed, log_gain=exposed(seed), vignetting=gain)
        found = vignetting.vignetting_statistic(vignetting.radial_slope(tracks, fit_exposure(tracks)))
        assert abs(found.value + gain / EV) < 5 * found.noise
        assert found.called_for is (gain == -0.33), "no lens makes corners brighter"
        assert (" darker than " in found.words) == (gain < 0)


def test_exposure_is_not_mistaken_for_vignetting() -> None:
    for seed in SEEDS:
        tracks = photographed_points(seed, log_gain=exposed(seed), outliers=0.02)
        # photos of which some show points in their middle only
        tracks = replace(tracks, radius=np.where(tracks.view % 2, 0.3 * tracks.radius, tracks.radius))
        assert (
            vignetting.vignetting_statistic(vignetting.radial_slope(tracks, fit_exposure(tracks))).called_for is False
        )


def test_points_at_one_radius_say_nothing_of_vignetting() -> None:
    tracks = photographed_points(0)
    tracks = replace(tracks, radius=np.full(len(tracks), 0.5))
    found = vignetting.vignetting_statistic(vignetting.radial_slope(tracks, fit_exposure(tracks)))
    assert (
        found.called_for is False and found.words == "not measured: every point lies at the same radius in all photos"
    )


def test_diffuse_points_do_not_call_for_view_dependence() -> None:
    for seed in SEEDS:
        tracks = photographed_points(seed, log_gain=exposed(seed), points=600, outliers=0.01)
        assert view_dependence.view_dependence_statistic(tracks, fit_exposure(tracks)).called_for is False


def test_shining_points_call_for_view_dependence() -> None:
    for seed in SEEDS:
        tracks = shining(seed, 0.035, points=600, log_gain=exposed(seed))
        found = view_dependence.view_dependence_statistic(tracks, fit_exposure(tracks))
        assert found.called_for is True, found
        assert 0.018 < found.value < 0.04


def test_rough_windows_seen_from_aside_are_not_view_dependence() -> None:
    """Noise that grows with texture and angle, but not where there is no texture."""
    for seed in range(8):
        draw = np.random.default_rng(seed)
        tracks = photographed_points(seed, points=800, per_point=6)
        texture = draw.uniform(0, 0.15, tracks.point.max() + 1)[tracks.point]
        # the piece that a window shows moves with the direction it is seen from: alike in neighbours, unlike far apart
        azimuth = np.arctan2(tracks.towards[:, 1], tracks.towards[:, 0])
        phase = draw.uniform(0, 2 * np.pi, (tracks.point.max() + 1, 3))[tracks.point]
        colour = np.clip(tracks.colour + 0.3 * texture[:, None] * np.sin(azimuth[:, None] + phase), 0, 1)
        rough = replace(tracks, colour=colour, texture=texture)
        told = view_dependence.view_dependence_statistic(rough, fit_exposure(rough))
        untold = replace(rough, texture=None)
        taken = view_dependence.view_dependence_statistic(untold, fit_exposure(untold))
        assert told.value < 0.7 * taken.value
        assert told.called_for is not True


def test_one_direction_says_nothing_of_view_dependence() -> None:
    tracks = photographed_points(0)
    tracks = replace(tracks, towards=np.tile([0.0, 0.0, 1.0], (len(tracks), 1)))
    found = view_dependence.view_dependence_statistic(tracks, fit_exposure(tracks))
    assert found.called_for is None and found.words == (
        "not measured: the angles between viewing directions hardly vary: 0.0° to 0.0°"
    )


def passed_by(seed: int, share: float, photos: int = 2) -> tuple[TrackColours, TrackColours]:
    """Tracks, and as many expected places; someone in grey hides a share of these in the first photos."""
    both = photographed_points(
        seed, views=14, points=900, per_point=8, log_gain=np.random.default_rng(seed).normal(size=14) * 0.3
    )
    draw = np.random.default_rng(seed)
    expected = draw.random(len(both)) < 0.3
    hidden = expected & (both.view < photos) & (draw.random(len(both)) < share)
    colour = np.where(hidden[:, None], 0.45 + 0.02 * draw.normal(size=both.colour.shape), both.colour)
    # surfaces hide each other in all photos
    mistaken = expected & (draw.random(len(both)) < 0.05)
    colour = np.where(mistaken[:, None], colour[draw.permutation(len(both))], colour)
    seen = replace(both, colour=colour)
    return seen.only(~expected), seen.only(expected)


def passers_by(tracks: TrackColours, expected: TrackColours | None) -> Statistic:
    fit = fit_exposure(tracks)
    return warnings.transients_statistic(outlier_images.outlier_images(tracks, fit, expected), fit)


def test_a_passer_by_in_few_photos_is_seen() -> None:
    for seed in SEEDS:
        tracks, expected = passed_by(seed, share=0.6)
        found = passers_by(tracks, expected)
        assert found.called_for is True, found
        assert found.words.startswith("2 of 14 photos are outliers: ")


def test_what_all_photos_have_is_no_passer_by() -> None:
    for seed in SEEDS:
        tracks, expected = passed_by(seed, share=0.0)
        found = passers_by(tracks, expected)
        assert found.called_for is False, found


def test_expected_places_are_those_that_two_near_photos_see() -> None:
    position = np.array([[0.0, 0, 0], [0, 0, 1]])
    centres = np.array([[3.0, 0, 0], [3, 0.2, 0], [-3, 0, 0], [9, 0, 0]])

    def places(seen: list[tuple[int, int]], centre: list[float]) -> list[int]:
        view, point = np.array(seen).T
        offset = centres[view] - position[point]
        length = np.linalg.norm(offset, axis=1)
        found = outlier_images.expected_places(offset / length[:, None], length, point, np.array(centre), position)
        return found.tolist()

    assert places([(0, 0), (1, 0), (0, 1)], [3, -0.2, 0]) == [0]
    assert places([(0, 0), (2, 0)], [3, -0.2, 0]) == []  # one of them from behind
    assert places([(0, 0), (3, 0)], [3, -0.2, 0]) == []  # one of them from far away


def test_photos_that_show_a_point_alike_are_near_each_other() -> None:
    draw = np.random.default_rng(0)
    here = draw.normal(size=(2000, 3))
    there = here * draw.uniform(0.6, 1.6, (2000, 1)) + 0.15 * draw.normal(size=here.shape)
    distance = np.linalg.norm(there, axis=1)

    def alike(k: int) -> bool:
        twice = there[[k, k]] / distance[k], distance[[k, k]], np.zeros(2, int)
        return len(outlier_images.expected_places(*twice, here[k], np.zeros((1, 3)))) == 1

    apart = np.linalg.norm(there - here, axis=1) / distance
    farthest = max(apart[k] for k in range(2000) if alike(k))
    assert 0.9 * outlier_images.NEAR_APART < farthest <= outlier_images.NEAR_APART


def hazy(seed: int, per_unit: float) -> TrackColours:
    """Points through a medium as bright as the points are on average."""
    tracks = photographed_points(seed, points=800, noise=0.004, log_gain=exposed(seed) / 2)
    tracks = replace(tracks, distance=2 * tracks.distance - 5)
    left = np.exp(-per_unit * tracks.distance)[:, None]
    light = linear_light(tracks.colour) * left + 0.3 * np.exp(exposed(seed) / 2)[tracks.view][:, None] * (1 - left)
    return replace(tracks, colour=encoded(light))


def test_fog_is_seen_and_clear_air_is_not() -> None:
    for seed in SEEDS:
        fog, clear = hazy(seed, 0.5), hazy(seed, 0.0)
        assert warnings.participating_media_statistic(fog, fit_exposure(fog)).called_for is True
        assert warnings.participating_media_statistic(clear, fit_exposure(clear)).called_for is False


def test_without_tracks_nothing_is_known() -> None:
    none = TrackColours.empty(3)
    fit = fit_exposure(none)
    for found, decided in (
        (vignetting.vignetting_statistic(vignetting.radial_slope(none, fit)), False),
        (view_dependence.view_dependence_statistic(none, fit), None),
        (passers_by(none, none), False),
        (passers_by(none, None), False),
        (warnings.participating_media_statistic(none, fit), False),
    ):
        assert found.called_for is decided and found.words.startswith("not measured: ")
        assert found.value == 0 and np.isinf(found.noise)
