from pathlib import Path

import numpy as np
import pytest

from stages import matching_plan, sfm
from stages.contract import StageError
from stages.matching_plan import about, check_matcher, chosen_matcher, measure
from stages.pairing import Places
from stages.photos import Photo
from tests.synthetic_photos import SyntheticPhotos

FEATURES = {"max_image_size": 1600, "max_features": 4096}


def photos(count: int) -> list[Photo]:
    return [Photo(f"{i}.jpg", f"images/{i}.jpg", 240, 180, 0, None, None, False, 1.0) for i in range(count)]


@pytest.mark.parametrize(
    ("seconds", "matcher", "notes"),
    [
        (
            0.034,
            "retrieval",
            ["400 photos have 79,800 pairs, about 45 min: retrieval of 30 neighbours each, about 5 min"],
        ),
        (
            1.0,
            "retrieval",
            ["400 photos have 79,800 pairs, about 22 h 10 min: retrieval of 30 neighbours each, about 2 h 30 min"],
        ),
        (0.002, "exhaustive", []),
    ],
)
def test_the_choice_follows_the_measurement_and_is_said(
    seconds: float, matcher: str, notes: list[str], progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matching_plan, "_seconds_per_pair", lambda *_: seconds)
    assert chosen_matcher(photos(400), Path(), 30, FEATURES, progress) == matcher
    assert progress.notes == notes


@pytest.mark.parametrize(
    ("places", "words"),
    [
        (Places(time_s=np.arange(400.0)), "neighbours in time, 30 each, about 5 min"),
        (Places(position_m=9.0 * np.arange(1200.0).reshape(400, 3)), "the 30 nearest places of each, about 5 min"),
    ],
)
def test_other_choices_have_other_words(places: Places, words: str, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching_plan, "_seconds_per_pair", lambda *_: 0.034)
    monkeypatch.setattr(matching_plan, "places_of", lambda _: places)
    chosen_matcher(photos(400), Path(), 30, FEATURES, progress)
    assert progress.notes == [f"400 photos have 79,800 pairs, about 45 min: {words}"]


def test_nothing_is_measured_where_it_could_change_nothing(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching_plan, "CHILD", ["-c", "raise SystemExit('measured')"])
    assert chosen_matcher(photos(60), Path(), 30, FEATURES, progress) == "exhaustive"
    with pytest.raises(StageError, match=r"could not measure what matching two photos takes: measured. Name the pairs"):
        chosen_matcher(photos(400), Path(), 30, FEATURES, progress)


def test_what_was_asked_for_stands(progress) -> None:
    for config in (sfm.Config(matcher="retrieval"), sfm.Config(cameras=Path("known.json"))):
        assert sfm.plan(config, {}, progress) == config


def test_a_pair_takes_time(synthetic_photos: SyntheticPhotos) -> None:
    entries = [{**vars(photo), "file": f"images/photo_{i:03d}.jpg"} for i, photo in enumerate(photos(3))]
    assert 0 < measure(str(synthetic_photos.folder), entries, 1600, 500) < 60


def test_places_are_needed_to_go_by_places() -> None:
    check_matcher("spatial", Places(position_m=np.zeros((3, 3))))
    check_matcher("retrieval", Places())
    with pytest.raises(StageError) as caught:
        check_matcher("spatial", Places())
    assert caught.value.what == "cannot choose pairs of photos by place"
    assert caught.value.why == "not all photos tell by EXIF where they were taken"
    assert "--sfm.matcher retrieval" in caught.value.hint


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.01, "1 s"), (40.2, "40 s"), (95.0, "2 min"), (2713.0, "45 min"), (7300.0, "2 h 2 min")]
)
def test_times_are_said_roughly(seconds: float, words: str) -> None:
    assert about(seconds) == words
