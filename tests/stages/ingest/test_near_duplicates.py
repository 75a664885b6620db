"""Pictures of which one is enough, and pictures that only look alike."""

from itertools import product

import cv2
import numpy as np
import pytest

from stages.ingest.near_duplicates import Brackets, Exposure, exposure, near_duplicates, small, thumbnail, well_exposed
from stages.ingest.sharpness import sharpness
from tests.blots import blots, cut_out

WIDTH, HEIGHT = 400, 300
FAR, NEAR = blots(0, 600, 500), blots(1, 600, 500)


def seen(x: float, y: float = 0, parallax: float = 0, noise: int = 0, picture: np.ndarray = FAR) -> np.ndarray:
    """What a camera sees of a far wall after a shift by (x, y) pixels; with ``parallax`` a nearer box in the middle, a
    quarter of the picture, has shifted by so many pixels more."""
    view = cut_out(picture, 50 + x, 50 + y, WIDTH, HEIGHT)
    if parallax:
        view[75:225, 100:300] = cut_out(NEAR, 50 + x + parallax, 50 + y, 200, 150)
    if noise:
        view = np.clip(view + np.random.default_rng(noise).normal(0, 4, view.shape), 0, 255).astype(np.uint8)
    return view


def found(*pictures: np.ndarray, sharp: tuple[float, ...] = ()) -> dict[int, int]:
    pixels = [one.shape[0] * one.shape[1] for one in pictures]
    return near_duplicates([thumbnail(one) for one in pictures], sharp or (1.0,) * len(pictures), pixels)


def test_a_burst_without_any_motion_is_found_through_the_noise() -> None:
    assert found(seen(0, noise=1), seen(0, noise=2), seen(0, noise=3)) == {1: 0, 2: 0}


@pytest.mark.parametrize(("x", "y"), [(3, 0), (0, -3), (-4, 4), (0.4, 6)])
def test_a_small_shift_of_everything_is_no_baseline(x: float, y: float) -> None:
    assert found(seen(0, noise=1), seen(x, y, noise=2)) == {1: 0}


def test_a_small_turn_is_no_baseline() -> None:
    turn = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), 1.0, 1.0)
    turned = cv2.warpAffine(seen(0), turn, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
    assert found(seen(0), turned) == {1: 0}


@pytest.mark.parametrize("stops", [-3.0, -1.0, 1.0])
def test_another_exposure_hides_nothing(stops: float) -> None:
    """Linear light times 2^stops, clipped and encoded again (gamma 2.2): a stop more clips a few per cent."""
    dim, again = (0.7 * seen(x, noise=noise) + 10 for x, noise in ((0, 1), (2, 2)))
    linear = (again / 255) ** 2.2 * 2**stops
    clipped = (linear > 1).mean()
    assert 0.01 < clipped < 0.15 if stops > 0 else clipped == 0
    exposed = np.rint(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    assert found(dim.astype(np.uint8), exposed) == {1: 0}


def test_a_shift_that_shows_something_new_is_kept() -> None:
    assert found(seen(0), seen(16)) == {}


@pytest.mark.parametrize("parallax", [3, -3, 5])
def test_parallax_is_a_baseline_however_small_the_shift(parallax: float) -> None:
    assert found(seen(0, parallax=0.01, noise=1), seen(0, parallax=0.01 + parallax, noise=2)) == {}
    assert found(seen(0, parallax=0.01, noise=1), seen(1, parallax=0.01, noise=2)) == {1: 0}


def test_a_passer_by_does_not_make_another_picture() -> None:
    walked = seen(0, noise=1)
    walked[200:230, 30:60] = 20
    assert found(seen(0, noise=2), walked) == {1: 0}


def test_other_pictures_are_kept() -> None:
    assert found(seen(0), seen(0, picture=NEAR), seen(0)[::-1].copy()) == {}


def test_the_sharpest_stays_and_of_equals_the_first() -> None:
    same = [seen(0, noise=index) for index in (1, 2, 3)]
    assert found(*same, sharp=(1.0, 3.0, 2.0)) == {0: 1, 2: 1}
    assert found(*same, sharp=(1.0, 1.0, 1.0)) == {1: 0, 2: 0}


def reduced(picture: np.ndarray, width: int) -> np.ndarray:
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("height", [720, 721, 810])
@pytest.mark.parametrize("width", [200, 341, 500, 800])
def test_of_a_photo_and_its_reduced_copy_the_photo_stays(width: int, height: int) -> None:
    """Whatever is rounded: the thumbnails of some copies are a row lower than those of their photos."""
    photo = cut_out(blots(2, 1100, 900), 5, 5, 1080, height)
    copy = reduced(photo, width)
    values = (sharpness(copy), sharpness(photo))
    assert values[0] > 1.5 * values[1]  # a reduced copy has the sharper edges
    assert found(copy, photo, sharp=values) == {0: 1}


def test_of_a_photo_and_its_crop_the_sharper_stays() -> None:
    photo, crop = seen(0, noise=1), seen(0, noise=2)[2:-2, 3:-3]
    assert found(photo, crop, sharp=(1.0, 2.0)) == {0: 1}
    assert found(photo, crop, sharp=(2.0, 1.0)) == {1: 0}


def test_a_smaller_photo_from_elsewhere_is_kept() -> None:
    assert found(seen(0), reduced(seen(16), 200)) == {}
    assert found(seen(0, parallax=0.01), reduced(seen(0, parallax=5), 250)) == {}


def test_of_a_slow_walk_enough_is_kept() -> None:
    """Steps of 0.75 % of the width: each like the next, the first and the last are not."""
    left_out = found(*(seen(3.0 * step) for step in range(12)))
    kept = sorted(set(range(12)) - set(left_out))
    assert 3 <= len(kept) < 12
    assert all(abs(index - left_out[index]) * 3 <= 0.025 * WIDTH for index in left_out)
    assert max(np.diff([*kept, 11])) * 3 <= 0.05 * WIDTH


def test_blank_pictures_and_other_shapes_say_nothing() -> None:
    blank = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    assert found(blank, blank) == {}
    assert found(seen(0), np.rot90(seen(0)).copy(), seen(0)[:, :-60].copy()) == {}
    assert near_duplicates([], [], []) == {}


def test_what_is_transparent_counts_as_black() -> None:
    opaque, rest = seen(0), seen(0, picture=NEAR)
    hidden = np.dstack([rest, np.zeros((HEIGHT, WIDTH), np.uint8)])
    hidden[:, :200, 3] = 255
    black = np.where(hidden[..., 3:] > 0, rest, 0)
    assert np.array_equal(thumbnail(hidden), thumbnail(black))
    assert thumbnail(opaque).shape == (240, 320)


def test_turntable_photos_differ_where_masks_say_what_counts() -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    one, other = seen(0, noise=1), seen(0, noise=2)
    for view, turned in ((one, 0), (other, 12)):
        view[130:170, 180:220] = cut_out(NEAR, 50 + turned, 50, 40, 40)
    mask[130:170, 180:220] = 255
    assert found(one, other) == {1: 0}
    assert near_duplicates([thumbnail(view, small(mask)) for view in (one, other)], (1.0, 1.0), (1, 1)) == {}
    whole = np.full((HEIGHT, WIDTH), 255, np.uint8)
    assert near_duplicates([thumbnail(view, small(whole)) for view in (one, other)], (1.0, 1.0), (1, 1)) == {1: 0}


def test_the_answer_does_not_depend_on_threads() -> None:
    pictures = [seen(2.0 * step, noise=step + 1) for step in range(6)]
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        one = found(*pictures)
    finally:
        cv2.setNumThreads(before)
    assert one == found(*pictures) != {}


def exposed(picture: np.ndarray, ev: float) -> np.ndarray:
    linear = (picture / 255) ** 2.2 * 2**ev
    return np.rint(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)


def test_exposure_is_measured_in_stops_and_counts_what_is_lost() -> None:
    plain = np.clip(0.6 * seen(0) + 30, 0, 255).astype(np.uint8)
    dark, right, light = (exposure(exposed(plain, ev)) for ev in (-4, 0, 3))
    assert right.level_ev - dark.level_ev == pytest.approx(4, abs=0.3)
    assert right.usable > 0.95
    assert dark.usable < 0.8 and light.usable < 0.8


OF_A_PLACE = [Exposure(-3.0, 0.98), Exposure(-5.0, 0.8), Exposure(-1.0, 0.7)]  # 0, -2 and +2 EV


def test_of_brackets_the_best_exposed_is_kept_the_same_everywhere() -> None:
    exposures = OF_A_PLACE * 2 + [Exposure(-3.0, 0.9), Exposure(-5.0, 0.95), Exposure(-1.0, 0.7), Exposure(-3.0, 1.0)]
    lightest = {0: 2, 1: 2, 3: 5, 4: 5, 6: 8, 7: 8}
    found, pattern = well_exposed(lightest, exposures, [100] * 10)
    assert found == {1: 0, 2: 0, 4: 3, 5: 3, 7: 6, 8: 6}
    assert pattern == Brackets(3, 3, 1)


@pytest.mark.parametrize(
    ("stops", "best", "by_exposure"),
    [
        ((0, -2), 0, False),
        ((0, 2), 0, False),
        ((0, -1, 1, -2, 2), 1, False),
        ((0, -1 / 3, 1 / 3), 1 / 3, False),
        ((2, 0, -2), 0, True),
    ],
)
def test_pictures_of_brackets_keep_the_well_exposed(stops: tuple[float, ...], best: float, by_exposure: bool) -> None:
    """Pairs, five exposures and thirds of a stop (the places are dark), and exposures in folders of their own."""
    places = [np.clip(0.4 * seen(60 * place - 40) + 40, 0, 255).astype(np.uint8) for place in range(2)]
    order = [(place, ev) for ev in stops for place in range(2)] if by_exposure else list(product(range(2), stops))
    pictures = [exposed(places[place], ev) for place, ev in order]
    same = near_duplicates([thumbnail(p) for p in pictures], [sharpness(p) for p in pictures], [1] * len(pictures))
    left_out, pattern = well_exposed(same, [exposure(p) for p in pictures], [1] * len(pictures))
    assert [order[i] for i in range(len(order)) if i not in left_out] == [(0, best), (1, best)]
    assert pattern == Brackets(2, len(stops), sorted(stops).index(best))


def test_one_place_with_several_exposures_is_no_pattern() -> None:
    assert well_exposed({0: 2, 1: 2}, OF_A_PLACE, [100] * 3) == ({1: 0, 2: 0}, None)


def test_a_burst_keeps_its_sharpest() -> None:
    assert well_exposed({0: 1, 2: 1}, [Exposure(-3.0, 0.9), Exposure(-3.1, 0.8), Exposure(-3.2, 0.95)], [9] * 3) == (
        {0: 1, 2: 1},
        None,
    )


def test_a_reduced_copy_is_not_kept_for_its_exposure() -> None:
    found, _ = well_exposed({0: 1}, [Exposure(-3.0, 0.95), Exposure(-1.0, 0.5)], [100, 400])
    assert found == {0: 1}
