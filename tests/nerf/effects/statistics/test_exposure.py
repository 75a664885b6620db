from dataclasses import replace

import numpy as np
import pytest

from nerf.effects.statistics.exposure import EV, THRESHOLD_EV, exposure_statistic, fit_exposure
from nerf.effects.statistics.tracks import TrackColours
from nerf.effects.statistics.warnings import tone_statistic
from tests.nerf.effects.statistics.photographed_points import photographed_points

SEEDS = range(20)


def centred(gain: np.ndarray) -> np.ndarray:
    return gain - np.median(gain, axis=0)


def drawn_gains(seed: int, views: int, deviation_ev: float) -> np.ndarray:
    """Gains per channel whose deviation over photos is just this."""
    gain = np.random.default_rng(1000 + seed).normal(size=(views, 3))
    gain = gain - gain.mean(axis=0)
    return gain * deviation_ev * EV / gain.std()


@pytest.mark.parametrize(("views", "per_point"), [(3, 2), (12, 5), (40, 9)])
def test_known_gains_are_found_to_their_stated_error(views: int, per_point: int) -> None:
    off = []
    for seed in SEEDS:
        gain = drawn_gains(seed, views, 0.4)
        fit = fit_exposure(photographed_points(seed, views, 400, per_point, gain, outliers=0.02))
        # means, for the error is about the mean and the median is noisy itself
        found, truth = fit.log_gain - fit.log_gain.mean(axis=0), gain - gain.mean(axis=0)
        off.append((found - truth) / fit.error)
    assert 0.75 < np.std(off) < 1.3
    assert np.abs(off).max() < 6


def test_the_gauge_is_the_median() -> None:
    gain = drawn_gains(0, 12, 0.4)
    fit = fit_exposure(photographed_points(0, log_gain=gain))
    np.testing.assert_allclose(np.median(fit.log_gain, axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(fit.log_gain, centred(gain), atol=0.05)


def test_all_photos_brighter_changes_nothing() -> None:
    usual = photographed_points(3, log_gain=drawn_gains(3, 12, 0.3), noise=0.0)
    brighter = photographed_points(3, log_gain=drawn_gains(3, 12, 0.3) + 0.2, noise=0.0)
    both = ~(usual.saturated | brighter.saturated)
    found = [fit_exposure(replace(tracks, saturated=~both)).log_gain for tracks in (usual, brighter)]
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_order_and_names_of_observations_change_nothing() -> None:
    tracks = photographed_points(4, log_gain=drawn_gains(4, 12, 0.3))
    order = np.random.default_rng(0).permutation(len(tracks))
    renamed = replace(tracks.only(order), point=10_000 - 3 * tracks.point[order])
    np.testing.assert_allclose(fit_exposure(renamed).log_gain, fit_exposure(tracks).log_gain, atol=1e-9)


def test_occluded_photos_do_not_count() -> None:
    gain = np.zeros((12, 3))
    gain[:3] = 0.5 * EV
    fit, odd = fit_exposure(photographed_points(5, log_gain=gain)), np.arange(12) < 3
    assert exposure_statistic(fit).called_for is True
    found = exposure_statistic(fit, None, odd)
    assert found.called_for is False and "; 3 photos excluded as outliers" in found.words
    assert exposure_statistic(fit, None, np.ones(12, bool)).value == exposure_statistic(fit).value


@pytest.mark.parametrize("outliers", [0.0, 0.05])
@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_equal_exposures_are_not_called_for(noise: float, outliers: float) -> None:
    for seed in SEEDS:
        found = exposure_statistic(fit_exposure(photographed_points(seed, noise=noise, outliers=outliers)))
        assert found.called_for is False, found


def test_the_least_difference_is_called_for() -> None:
    for seed in SEEDS:
        gain = drawn_gains(seed, 12, 1.15 * THRESHOLD_EV)
        found = exposure_statistic(fit_exposure(photographed_points(seed, log_gain=gain)))
        assert found.called_for is True, found
        assert 0.9 < found.value / (1.15 * THRESHOLD_EV) < 1.1


@pytest.mark.parametrize(("deviation_ev", "called_for"), [(0.0, False), (0.2, True)])
def test_a_photo_that_is_badly_measured_decides_nothing(deviation_ev: float, called_for: bool) -> None:
    for seed in SEEDS:
        fit = fit_exposure(photographed_points(seed, log_gain=drawn_gains(seed, 12, 1.0) * deviation_ev))
        assert exposure_statistic(fit).called_for is called_for
        gain, error = fit.log_gain.copy(), fit.error.copy()
        gain[4, 0], error[4, 0] = gain[4, 0] + 1.2 * EV, EV
        found = exposure_statistic(fit._replace(log_gain=gain, error=error), np.zeros(12))
        assert found.called_for is called_for, found
        assert "; 1 photo excluded: gain uncertain by over 0.1 EV; EXIF exposures span 0 EV" in found.words
        bent = tone_statistic(fit._replace(contrast=np.eye(12)[4], contrast_error=fit.contrast_error + np.eye(12)[4]))
        assert bent.called_for is False
        unsure = exposure_statistic(fit._replace(error=fit.error + EV))
        assert unsure.called_for is None and "excluded" not in unsure.words, "better than nothing"


@pytest.mark.parametrize(("span_ev", "called_for"), [(11.0, True), (15.0, False)])
def test_gains_beyond_all_light_are_no_exposures(span_ev: float, called_for: bool) -> None:
    fit = fit_exposure(photographed_points(0, log_gain=drawn_gains(0, 12, 0.3)))
    gain = np.repeat(np.linspace(0, span_ev * EV, 12)[:, None], 3, axis=1)
    found = exposure_statistic(fit._replace(log_gain=gain))
    assert found.called_for is called_for
    assert found.words.endswith("no exposures differ by so much") is not called_for
    gain[:11] = 0  # one photo is not the set
    assert exposure_statistic(fit._replace(log_gain=gain)).called_for is True


def test_exif_exposures_decide_nothing() -> None:
    gain = np.linspace(-0.5, 0.5, 12) * EV
    fit = fit_exposure(photographed_points(3, log_gain=gain))
    alone = exposure_statistic(fit)
    told = gain / EV + 7.0  # the constant is unknown
    agreeing, deviating = exposure_statistic(fit, told), exposure_statistic(fit, -told)
    assert agreeing.words.startswith(f"{alone.words}; EXIF exposures span 1 EV, and the gains differ from them by 0.0")
    assert "differ from them by 0.6" in deviating.words  # twice the gains' own deviation, 0.314
    assert agreeing[:5] == deviating[:5] == alone[:5]
    sparse = np.where(np.arange(12) < 1, told, np.nan)
    assert exposure_statistic(fit, sparse) == exposure_statistic(fit, np.full(12, np.nan)) == alone


def test_between_the_thresholds_a_pilot_decides() -> None:
    for seed in SEEDS:
        gain = drawn_gains(seed, 12, 0.75 * THRESHOLD_EV)
        assert exposure_statistic(fit_exposure(photographed_points(seed, log_gain=gain))).called_for is None


def test_vignetting_is_not_mistaken_for_exposure() -> None:
    for seed in SEEDS:
        fit = fit_exposure(photographed_points(seed, vignetting=-0.7))
        np.testing.assert_allclose(fit.vignetting, -0.7, atol=0.05)
        assert exposure_statistic(fit).called_for is False


def test_highlights_in_one_photo_hardly_move_its_gain() -> None:
    tracks = photographed_points(5)
    colour = tracks.colour.copy()
    shining = (tracks.view == 4) & (np.random.default_rng(0).random(len(tracks)) < 0.2)
    colour[shining] = 0.93
    gain = fit_exposure(replace(tracks, colour=colour)).log_gain
    assert np.abs(gain).max() < 0.03
    assert np.abs(colour - tracks.colour)[shining].mean() > 0.2


def test_clipped_points_are_left_out() -> None:
    gain = np.zeros(12)
    gain[:4] = 1.0
    fit = fit_exposure(photographed_points(6, points=1500, log_gain=gain, noise=0.003))
    np.testing.assert_allclose(fit.log_gain, centred(gain[:, None]).repeat(3, 1), atol=0.02)


def test_photos_without_common_points_have_infinite_error() -> None:
    tracks = photographed_points(7, views=6)
    apart = replace(tracks, views=9, view=np.where(tracks.point < 300, tracks.view, 6 + tracks.view % 3))
    fit = fit_exposure(apart)
    np.testing.assert_array_equal(fit.known, [True] * 6 + [False] * 3)
    assert np.isinf(fit.error[6:]).all() and np.isfinite(fit.error[:6]).all()
    np.testing.assert_array_equal(fit.log_gain[6:], 0)
    assert exposure_statistic(fit).words.endswith("; 3 photos excluded: too few points shared with the others")


def test_without_tracks_nothing_is_known() -> None:
    fit = fit_exposure(TrackColours.empty(5))
    assert fit.log_gain.shape == (5, 3) and np.isinf(fit.error).all()
    assert exposure_statistic(fit).called_for is None and tone_statistic(fit).called_for is False
    assert exposure_statistic(fit).words == tone_statistic(fit).words == "not measured: no tracks"


@pytest.mark.parametrize("points", [1, 3])
def test_so_few_common_points_are_no_evidence(points: int) -> None:
    fit = fit_exposure(photographed_points(8, views=3, points=points, per_point=3, log_gain=np.array([0.0, 0.5, 1.0])))
    assert np.isfinite(fit.log_gain).all()
    assert exposure_statistic(fit).called_for is not True


def test_the_words() -> None:
    gain = np.zeros(12)
    gain[3] = 0.8 * EV
    words = exposure_statistic(fit_exposure(photographed_points(9, points=4000, log_gain=gain, noise=0.002))).words
    assert words.startswith("gains span 0.8 EV, ") and words.endswith(" × their noise")


def test_powers_are_seen_as_tone_and_gains_are_not() -> None:
    for seed in SEEDS:
        power = np.ones(12)
        power[::2] = 1.5
        bent = tone_statistic(fit_exposure(photographed_points(seed, gamma=power)))
        straight = tone_statistic(fit_exposure(photographed_points(seed, log_gain=drawn_gains(seed, 12, 0.4))))
        assert bent.called_for is True and straight.called_for is False, (bent, straight)
