import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nerf.effects.statistics.tracks import MAX_IN_TRACK, TrackColours, log_light, log_noise, usable
from tests.nerf.effects.statistics.photographed_points import photographed_points


@given(st.floats(0.01, 0.99))
def test_noise_of_the_logarithm_is_its_slope(value: float) -> None:
    step = 1e-6
    slope = (log_light(np.array([value + step])) - log_light(np.array([value - step]))) / (2 * step)
    np.testing.assert_allclose(log_noise(np.array([value])), slope, rtol=0.03)


def test_black_has_a_logarithm() -> None:
    assert np.isfinite(log_light(np.zeros(3))).all() and np.isfinite(log_noise(np.zeros(3))).all()


def test_usable_observations_are_unsaturated_and_seen_twice() -> None:
    tracks = photographed_points(0, points=6, per_point=2)
    tracks.saturated[:] = False
    tracks.saturated[2] = True  # the point's other observation has no partner any more
    tracks.view[4] = tracks.view[5]  # two features of one photo
    used = usable(tracks)
    assert sorted(used) == [0, 1, 6, 7, 8, 9, 10, 11]
    assert (np.diff(tracks.point[used]) >= 0).all()


def test_long_tracks_are_thinned_evenly() -> None:
    tracks = photographed_points(0, views=500, points=3, per_point=400)
    tracks.saturated[:] = False
    used = usable(tracks)
    assert len(used) == 3 * MAX_IN_TRACK
    view = np.sort(tracks.view[used][tracks.point[used] == 1])
    assert np.diff(np.searchsorted(np.sort(tracks.view[tracks.point == 1]), view)).max() <= 7


def test_empty_tracks() -> None:
    tracks = TrackColours.empty(4)
    assert len(tracks) == 0 and len(usable(tracks)) == 0 and len(tracks.only(np.zeros(0, bool))) == 0
