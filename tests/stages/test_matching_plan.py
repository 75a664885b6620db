from pathlib import Path

import numpy as np
import pytest

from stages import matching_plan, pairing, sfm
from stages.contract import StageError
from stages.matching_plan import (
    TIERS,
    Chosen,
    Cost,
    Open,
    Tier,
    _sample,
    check_matcher,
    chosen,
    measure,
    tiers_of,
)
from stages.pairing import Places
from stages.photos import Photo
from tests.synthetic_photos import SyntheticPhotos

ALL_OPEN = Open(None, None, None)
FULL = Open(1600, 4096, None)


def photos(count: int) -> list[Photo]:
    return [Photo(f"{i}.jpg", f"images/{i}.jpg", 240, 180, 0, None, None, False, 1.0) for i in range(count)]


def costing(monkeypatch: pytest.MonkeyPatch, *seconds: tuple[float, float]) -> list[Tier]:
    """Let tiers cost so much, one after the other; the answer grows by what is measured."""
    asked: list[Tier] = []

    def measured(_: list[Photo], __: Path, tier: Tier) -> Cost:
        asked.append(tier)
        return Cost(*seconds[len(asked) - 1])

    monkeypatch.setattr(matching_plan, "_measured", measured)
    return asked


SEARCHED = "400 photos searched at 1600 pixels for 4096 features and matched: about "


@pytest.mark.parametrize(
    ("seconds", "matcher", "notes"),
    [
        (
            0.034,
            "retrieval",
            [
                "400 photos have 79,800 pairs, about 45 min: retrieval of 30 neighbours each, about 5 min",
                SEARCHED + "5 min",
            ],
        ),
        (
            1.0,
            "retrieval",
            [
                "400 photos have 79,800 pairs, about 22 h 10 min: retrieval of 30 neighbours each, about 2 h 30 min",
                SEARCHED + "2 h 30 min",
            ],
        ),
        (0.002, "exhaustive", [SEARCHED + "3 min"]),
    ],
)
def test_the_choice_of_pairs_follows_the_measurement_and_is_said(
    seconds: float, matcher: str, notes: list[str], progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    costing(monkeypatch, (0.05, seconds))
    assert chosen(FULL, photos(400), Path(), 30, progress, None) == Chosen(1600, 4096, matcher)  # type: ignore[arg-type]
    assert progress.notes == notes


@pytest.mark.parametrize(
    ("places", "words"),
    [
        (Places(time_s=np.arange(400.0)), "neighbours in time, 30 each, about 5 min"),
        (Places(position_m=9.0 * np.indices((400, 3))[0]), "neighbours by place and looks, 30 each, about 5 min"),
    ],
)
def test_other_choices_have_other_words(places: Places, words: str, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    costing(monkeypatch, (0.05, 0.034))
    monkeypatch.setattr(pairing, "places_of", lambda _: places)
    chosen(FULL, photos(400), Path(), 30, progress, None)
    assert progress.notes[0] == f"400 photos have 79,800 pairs, about 45 min: {words}"


@pytest.mark.parametrize(
    ("count", "costs", "tier", "note"),
    [
        (
            400,
            [(0.36, 0.034)],
            Tier(1600, 4096),
            "400 photos searched at 1600 pixels for 4096 features and matched: about 8 min",
        ),
        (
            1000,
            [(0.36, 0.034), (0.18, 0.009)],
            Tier(1131, 2048),
            "1000 photos searched at 1600 pixels for 4096 features and matched take about 19 min: "
            "at 1131 pixels for 2048 features instead, about 6 min",
        ),
        (
            5000,
            [(0.36, 0.034), (0.18, 0.009), (0.12, 0.002)],
            Tier(1131, 1024),
            "5000 photos searched at 1600 pixels for 4096 features and matched take about 1 h 34 min: "
            "at 1131 pixels for 1024 features instead, about 14 min",
        ),
        (  # with few features a step down saves too little, and two steps enough
            1000,
            [(0.36, 0.046), (0.36, 0.044), (0.36, 0.009)],
            Tier(1131, 1024),
            "1000 photos searched at 1600 pixels for 4096 features and matched take about 23 min: "
            "at 1131 pixels for 1024 features instead, about 9 min",
        ),
        (
            1000,
            [(0.53, 0.046), (0.70, 0.044), (0.70, 0.033)],
            Tier(1600, 4096),
            "1000 photos searched at 1600 pixels for 4096 features and matched: about 26 min",
        ),
    ],
)
def test_large_sets_are_searched_as_far_as_is_bearable(
    count: int,
    costs: list[tuple[float, float]],
    tier: Tier,
    note: str,
    progress,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = costing(monkeypatch, *costs)
    assert chosen(ALL_OPEN, photos(count), Path(), 30, progress, None) == Chosen(*tier, "retrieval")
    assert progress.notes[1:] == [note]
    assert asked == list(TIERS[: len(costs)])


def test_what_is_given_stays_in_every_tier(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tiers_of(Open(None, 8192, None)) == [Tier(1600, 8192), Tier(1131, 8192)]
    assert tiers_of(Open(2400, None, None)) == [Tier(2400, 4096), Tier(2400, 2048), Tier(2400, 1024)]
    asked = costing(monkeypatch, (0.36, 0.034), (0.18, 0.009))
    every_pair = chosen(Open(None, None, "exhaustive"), photos(200), Path(), 30, progress, None)
    assert every_pair == Chosen(1131, 2048, "exhaustive") and len(asked) == 2
    assert len(progress.notes) == 1


@pytest.mark.parametrize("count", [3, 91, 100])
def test_sets_of_ordinary_size_are_searched_in_full(count: int, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    costing(monkeypatch, (100.0, 100.0))
    assert chosen(ALL_OPEN, photos(count), Path(), 30, progress, None)[:2] == (1600, 4096)


def test_nothing_is_measured_where_it_could_change_nothing(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching_plan, "CHILD", ["-c", "raise SystemExit('measured')"])
    assert chosen(ALL_OPEN, photos(60), Path(), 30, progress, None) == Chosen(1600, 4096, "exhaustive")
    with pytest.raises(StageError) as caught:
        chosen(ALL_OPEN, photos(400), Path(), 30, progress, None)
    assert (caught.value.what, caught.value.why) == ("could not measure what features and matches take", "measured")
    assert caught.value.hint == (
        "Say how, and nothing is measured: --sfm.matcher exhaustive --sfm.max-image-size 1600 --sfm.max-features 4096."
    )


def test_what_was_asked_for_stands(progress) -> None:
    asked = sfm.Config(matcher="retrieval", max_image_size=800, max_features=500)
    for config in (asked, sfm.Config(cameras=Path("known.json"))):
        assert sfm.plan(config, {}, progress) == config


def test_measured_are_neighbours_from_all_over_the_set_enough_for_all_cores() -> None:
    def numbers(count: int, cores: int) -> list[int]:
        return [int(photo.name.removesuffix(".jpg")) for photo in _sample(photos(count), cores)]

    assert numbers(400, 2) == [100, 101, 300, 301]
    assert numbers(400, 8) == [50, 51, 150, 151, 250, 251, 350, 351]
    assert numbers(3, 64) == [0, 1, 2]


def test_features_and_pairs_take_time(synthetic_photos: SyntheticPhotos) -> None:
    entries = [{**vars(photo), "file": f"images/photo_{i:03d}.jpg"} for i, photo in enumerate(photos(3))]
    cost = measure(str(synthetic_photos.folder), entries, 1600, 500)
    assert 0 < cost.per_photo < 60 and 0 < cost.per_pair < 60
    assert cost.of(10, 45) == 10 * cost.per_photo + 45 * cost.per_pair


def test_places_are_needed_to_go_by_places() -> None:
    check_matcher("spatial", Places(position_m=np.zeros((3, 3))))
    check_matcher("retrieval", Places())
    with pytest.raises(StageError) as caught:
        check_matcher("spatial", Places())
    assert caught.value.what == "cannot choose pairs of photos by place"
    assert caught.value.why == "not all photos tell by EXIF where they were taken"
    assert "--sfm.matcher retrieval" in caught.value.hint


def test_where_time_is_given_sets_of_ordinary_size_give_way_too(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = costing(monkeypatch, (0.5, 0.05), (0.2, 0.01))
    assert chosen(ALL_OPEN, photos(50), Path(), 30, progress, 60.0) == Chosen(1131, 2048, "exhaustive")
    assert asked == list(TIERS[:2]) and "50 photos searched at 1600 pixels" in progress.notes[0]


def test_time_enough_is_found_by_measuring_or_beyond_doubt_without(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = costing(monkeypatch, (0.13, 0.012))
    assert chosen(ALL_OPEN, photos(50), Path(), 30, progress, 60.0) == Chosen(1600, 4096, "exhaustive")
    assert len(asked) == 1
    assert chosen(ALL_OPEN, photos(11), Path(), 30, progress, 90.0) == Chosen(1600, 4096, "exhaustive")
    assert len(asked) == 1
