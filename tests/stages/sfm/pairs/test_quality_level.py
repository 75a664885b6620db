from pathlib import Path

import numpy as np
import pytest

from stages import sfm
from stages.io.photos import Photo
from stages.sfm.pairs import quality_level
from stages.sfm.pairs.pair_selection import CapturePriors
from stages.sfm.pairs.quality_level import (
    QUALITY_LEVELS,
    ChosenOptions,
    Cost,
    GivenOptions,
    QualityLevel,
    _sample,
    check_matcher,
    chosen,
    measure,
    quality_levels,
)
from tests.refusals import refused
from tests.synthetic_photos import SyntheticPhotos

ALL_OPEN = GivenOptions(None, None, None)


def photos(count: int) -> list[Photo]:
    return [Photo(f"{i}.jpg", f"images/{i}.jpg", 240, 180, 0, None, None, False, 1.0) for i in range(count)]


def costing(monkeypatch: pytest.MonkeyPatch, *seconds: tuple[float, float]) -> list[QualityLevel]:
    """Let tiers cost so much, one after the other; the answer grows by what is measured."""
    asked: list[QualityLevel] = []

    def measured(_: list[Photo], __: Path, tier: QualityLevel, ___: str) -> Cost:
        asked.append(tier)
        return Cost(*seconds[len(asked) - 1])

    monkeypatch.setattr(quality_level, "_measured", measured)
    return asked


@pytest.mark.parametrize(
    ("priors", "matcher"),
    [
        (CapturePriors(), "retrieval"),
        (CapturePriors(time_s=np.arange(400.0)), "sequential"),
        (CapturePriors(position_m=9.0 * np.indices((400, 3))[0]), "spatial"),
    ],
)
def test_pairs_of_many_photos_are_chosen_by_what_is_known(
    priors: CapturePriors, matcher: str, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = costing(monkeypatch)
    monkeypatch.setattr(quality_level, "capture_priors", lambda _: priors)
    assert chosen(ALL_OPEN, photos(400), Path(), 30, progress, None) == (1600, 4096, matcher)
    assert not asked and len(progress.notes) == 1


@pytest.mark.parametrize(
    ("costs", "tier"),
    [
        ([(0.36, 0.034)], QualityLevel(1600, 4096)),
        ([(0.72, 0.068), (0.18, 0.009)], QualityLevel(1131, 2048)),
        ([(0.72, 0.068), (0.54, 0.05), (0.12, 0.002)], QualityLevel(1131, 1024)),
        ([(0.72, 0.068), (0.70, 0.067), (0.70, 0.066)], QualityLevel(1600, 4096)),  # a step down saves too little
    ],
)
def test_features_give_way_only_to_a_time_that_is_given(
    costs: list[tuple[float, float]], tier: QualityLevel, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = costing(monkeypatch, *costs)
    assert chosen(ALL_OPEN, photos(400), Path(), 30, progress, 900.0) == ChosenOptions(*tier, "retrieval")
    assert asked == list(QUALITY_LEVELS[: len(costs)])
    assert chosen(ALL_OPEN, photos(400), Path(), 30, progress, None) == ChosenOptions(1600, 4096, "retrieval")


def test_what_is_given_stays_in_every_tier(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    assert quality_levels(GivenOptions(None, 8192, None)) == [QualityLevel(1600, 8192), QualityLevel(1131, 8192)]
    assert quality_levels(GivenOptions(2400, None, None)) == [
        QualityLevel(2400, 4096),
        QualityLevel(2400, 2048),
        QualityLevel(2400, 1024),
    ]
    asked = costing(monkeypatch, (0.36, 0.034), (0.18, 0.009))
    every_pair = chosen(GivenOptions(None, None, "exhaustive"), photos(200), Path(), 30, progress, 900.0)
    assert every_pair == ChosenOptions(1131, 2048, "exhaustive") and len(asked) == 2
    assert len(progress.notes) == 1


def test_nothing_is_measured_without_a_time(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality_level, "COMMAND", ["-c", "raise SystemExit('measured')"])
    assert chosen(ALL_OPEN, photos(50), Path(), 30, progress, None) == ChosenOptions(1600, 4096, "exhaustive")
    options = "--sfm.matcher exhaustive --sfm.max-image-size 1600 --sfm.max-features 4096"
    with refused("sfm.not-measured", "measured", options):
        chosen(ALL_OPEN, photos(400), Path(), 30, progress, 60.0)


def test_what_was_asked_for_stands(progress) -> None:
    asked = sfm.Config(matcher="retrieval", max_image_size=800, max_features=500)
    for config in (asked, sfm.Config(cameras=Path("known.json"))):
        assert sfm.plan(config, {}, progress) == config


def test_timed_pairs_are_neighbours_from_everywhere() -> None:
    def numbers(count: int, cores: int) -> list[int]:
        return [int(photo.name.removesuffix(".jpg")) for photo in _sample(photos(count), cores)]

    assert numbers(400, 2) == [100, 101, 300, 301]
    assert numbers(400, 8) == [50, 51, 150, 151, 250, 251, 350, 351]
    assert numbers(3, 64) == [0, 1, 2]


@pytest.mark.parametrize("indexed", [False, True])
def test_features_and_pairs_take_time(synthetic_photos: SyntheticPhotos, indexed: bool) -> None:
    entries = [{**vars(photo), "file": f"images/photo_{i:03d}.jpg"} for i, photo in enumerate(photos(3))]
    cost = measure(str(synthetic_photos.folder), entries, 1600, 500, indexed)
    assert 0 < cost.per_photo < 60 and 0 < cost.per_pair < 60
    assert cost.of(10, 45) == 10 * cost.per_photo + 45 * cost.per_pair


def test_spatial_matching_needs_gps_positions() -> None:
    check_matcher("spatial", CapturePriors(position_m=np.zeros((3, 3))))
    check_matcher("retrieval", CapturePriors())
    with refused("sfm.no-positions", "--sfm.matcher retrieval"):
        check_matcher("spatial", CapturePriors())


def test_with_time_given_ordinary_sets_reduce_too(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = costing(monkeypatch, (0.5, 0.05), (0.2, 0.01))
    assert chosen(ALL_OPEN, photos(50), Path(), 30, progress, 60.0) == ChosenOptions(1131, 2048, "exhaustive")
    assert asked == list(QUALITY_LEVELS[:2])
    assert progress.names("sfm.quality-level", "4096 features a photo at 1600 pixels", "2048 features")


def test_time_enough_is_found_by_measuring_or_beyond_doubt_without(progress, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = costing(monkeypatch, (0.13, 0.012))
    assert chosen(ALL_OPEN, photos(50), Path(), 30, progress, 60.0) == ChosenOptions(1600, 4096, "exhaustive")
    assert len(asked) == 1
    assert chosen(ALL_OPEN, photos(11), Path(), 30, progress, 90.0) == ChosenOptions(1600, 4096, "exhaustive")
    assert len(asked) == 1
