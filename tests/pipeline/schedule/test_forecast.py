"""What is said at the start of a run of how long it takes."""

import sqlite3
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import STAGES, usual
from pipeline.schedule import forecast
from pipeline.schedule.forecast import Left, expected_times, forecast_run, limited_seconds, time_behind_plan
from stages import sfm
from stages.contract import Photos, Workload
from stages.effects import STATISTICS_SECONDS
from stages.effects import Config as EffectsConfig
from stages.io.amounts import rough_duration
from stages.io.video import video_writer
from stages.sfm.registration import first_database
from stages.train import Config as TrainConfig
from tests.png_files import png


def photos_of(given: Settings) -> Photos | None:
    return forecast.photos_of(given.ingest)


def workload(given: Settings, photos: Photos, cores: int = 2) -> Workload:
    options = {name: getattr(given, name) for name in STAGES}
    return Workload(photos, cores, options, lambda stage, key: None)


def expected(given: Settings, photos: Photos, cores: int = 2) -> dict[str, float | None]:
    """Under a budget."""
    return expected_times(STAGES, workload(given, photos, cores), budgeted=True)


def sfm_seconds(photos: Photos, cores: int) -> float:
    return sfm.expected_seconds(sfm.Config(), workload(Settings(), photos, cores))


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for k in range(5):
        Image.new("RGB", (200, 150)).save(tmp_path / f"{k}.png")
    return tmp_path


def settings(photos: Path, **stages: dict[str, Any]) -> Settings:
    return Settings.model_validate(stages | {"ingest": {"photos": photos} | stages.get("ingest", {})})


def test_photos_are_counted_and_measured_without_decoding(photos: Path) -> None:
    assert photos_of(settings(photos)) == Photos(5, 0.03)
    (photos / "2.png").write_bytes(b"not an image")
    assert photos_of(settings(photos)) == Photos(5, 2.0)
    (photos / "2.png").write_bytes(png(20_000, 12_000, b""))  # Pillow's own limit is lower than ours
    assert photos_of(settings(photos)) == Photos(5, 240.0)
    assert photos_of(settings(photos / "gone")) is None


def test_masks_are_counted_and_take_time(photos: Path) -> None:
    (photos / "masks").mkdir()
    for name in ("0.png", "3.png.png", "stranger.png"):
        Image.new("L", (200, 150)).save(photos / "masks" / name)
    assert photos_of(settings(photos)) == Photos(5, 0.03, masked=2)

    def seconds(masked: int, masks: str | None = None, stage: str = "normalise") -> float:
        found = expected(settings(photos, normalise={"masks": masks}), Photos(145, 12.0, masked))[stage]
        assert found is not None
        return found

    assert seconds(0) == seconds(145, "ignore") < seconds(24) < 2 < seconds(145) < 8
    assert 1.2 * seconds(0, stage="ingest") < seconds(145, stage="ingest") < 1.8 * seconds(0, stage="ingest")
    (photos / "empty").mkdir()
    assert photos_of(settings(photos / "empty")) is None


def test_of_a_video_its_length_and_size_tell(tmp_path: Path) -> None:
    with video_writer(tmp_path / "a.mp4", 200, 160, 10) as write:
        for _ in range(150):
            write(np.zeros((160, 200, 3), np.uint8))
    assert photos_of(settings(tmp_path / "a.mp4")) == Photos(60, 0.032)
    assert photos_of(settings(tmp_path / "a.mp4", ingest={"frames": 30})) == Photos(30, 0.032)
    (tmp_path / "a.mp4").write_bytes(b"no video")
    assert photos_of(settings(tmp_path / "a.mp4")) is None


@pytest.mark.parametrize(
    ("set_of", "measured"), [(Photos(50, 2.1), 37.6), (Photos(11, 1.6), 17.1), (Photos(20, 0.76), 43)]
)
def test_expected_sfm_time_is_roughly_right(set_of: Photos, measured: float) -> None:
    """fox, fountain_p11 and fern on two idle cores."""
    assert measured / 2.5 < sfm_seconds(set_of, 2) < 2.5 * measured
    assert sfm_seconds(set_of, 16) < sfm_seconds(set_of, 2)


def test_of_a_resumed_stage_only_the_rest_counts(tmp_path: Path) -> None:
    set_of, given = Photos(100, 2.0), Settings.model_validate({"train": {"seconds": 100.0}})

    def done(features: int, pairs: int) -> tuple[float, float]:
        """The seconds until the end of stage sfm, and those that it is expected to take in all."""
        with closing(sqlite3.connect(first_database(tmp_path))) as db, db:
            for table, count in {"descriptors": features, "two_view_geometries": pairs}.items():
                db.execute(f"DROP TABLE IF EXISTS {table}")
                db.execute(f"CREATE TABLE {table} (id)")
                db.executemany(f"INSERT INTO {table} VALUES (?)", [(k,) for k in range(count)])
        resumed = workload(given, set_of)._replace(partial={"sfm": tmp_path}.get)
        found = forecast_run(STAGES, ["sfm"], resumed, None)
        left = sfm.expected_seconds(given.sfm, resumed)
        assert rough_duration(left) in found.messages[0]
        return left, found.times["sfm"] or 0.0

    whole = sfm_seconds(set_of, 2)
    assert done(0, 0) == (whole, whole)
    assert whole > 10 + done(50, 0)[0] > 20 + done(100, 0)[0]
    assert done(100, 1650)[0] < done(100, 800)[0] < done(100, 0)[0] and done(100, 800)[1] == whole
    assert done(100, 9999) == done(100, 1650)
    first_database(tmp_path).write_bytes(b"no database at all")
    assert sfm.expected_seconds(given.sfm, workload(given, set_of)._replace(partial={"sfm": tmp_path}.get)) == whole


def test_imported_poses_take_seconds() -> None:
    times = expected(Settings.model_validate({"sfm": {"cameras": Path("t.json")}}), Photos(50, 2.0))
    assert 10 < (times["sfm"] or 0) < 60 and set(times) == set(usual())
    assert [stage for stage, seconds in times.items() if seconds is None] == ["train", "evaluate", "render", "mesh"]


SaidOf = Callable[..., list[str]]
BEFORE_TRAINING = ("ingest", "sfm", "normalise", "effects")
NOW = 1e9
TRAINED = 180.0  # seconds of the finished training that the workspace of ``said_of`` has


@pytest.fixture
def said_of(photos: Path, monkeypatch: pytest.MonkeyPatch) -> SaidOf:
    monkeypatch.setattr(forecast.time, "time", lambda: NOW)

    def words(
        budget: float | None = None,
        done: tuple[str, ...] = (),
        before: float = 0.0,
        names: Sequence[str] = tuple(usual()),
        **stages: dict[str, Any],
    ) -> list[str]:
        given = settings(photos, **stages)
        options = {name: getattr(given, name) for name in STAGES}

        def facts(stage: str, key: str | None) -> dict[str, Any] | None:
            known = key == "there" if key else stage in done
            return {"train_seconds": TRAINED} if known else None

        to_run = [name for name in names if name not in done]
        left = None if budget is None else Left(budget, budget - before)
        found = forecast_run(STAGES, to_run, Workload(Photos(50, 2.0), 2, options, facts), left)
        waits = {**found.times, "tradeoff": given.tradeoff.seconds}
        known = [waits[name] for name in names if name not in done]
        for said in found.messages:
            if said.startswith("done in"):  # and until when, which is the sum of the stages' times
                finish = time.localtime(NOW + sum(seconds or 0.0 for seconds in known))
                assert None not in known and said.endswith(f", about {time.strftime('%H:%M', finish)}")
        return [said.split(", about ")[0] if said.startswith("done in") else said for said in found.messages]

    return words


def test_a_run_without_a_budget_is_expected_in_minutes(said_of: SaidOf) -> None:
    assert said_of() == ["done in about 7 min"]
    assert said_of(train={"seconds": 900.0}) == ["done in about 25 min"]
    assert said_of(train={"preset": "draft"}) == ["done in about 3 min"]
    assert said_of(train={"steps": 500}) == []


def pilots_seconds(given: Settings, times: dict[str, float | None], reading: float) -> float | None:
    return limited_seconds(STAGES["effects"], {name: getattr(given, name) for name in STAGES}, times, reading)


def test_pilots_have_a_limit_where_time_is_known() -> None:
    times, reading = expected_times(STAGES, workload(Settings(), Photos(50, 2.0)), budgeted=False), 2.0
    total = sum(seconds or 0.0 for seconds in times.values())
    seconds = pilots_seconds(Settings(), times, reading)
    assert seconds is not None and seconds + reading + STATISTICS_SECONDS == pytest.approx(0.15 * total)
    assert pilots_seconds(Settings(), {}, reading) is None, "nothing is known of the run"
    assert pilots_seconds(Settings(train=TrainConfig(steps=500)), times, reading) is None
    assert pilots_seconds(Settings(), times, 300.0) == 0.0, "reading alone takes longer"


def behind_plan(stage: str, given: Settings, total: float | None) -> dict[str, float]:
    return time_behind_plan(STAGES[stage], {name: getattr(given, name) for name in STAGES}, total)


def test_only_pilots_are_planned_again_with_another_training() -> None:
    draft, counted = Settings(train=TrainConfig(preset="draft")), Settings(train=TrainConfig(steps=500))
    assert behind_plan("effects", Settings(), None) == {"limit": 180.0}
    assert behind_plan("effects", draft, None) == {"limit": 30.0}
    assert behind_plan("effects", counted, None) == {}
    assert behind_plan("render", draft, None) == {}
    assert behind_plan("effects", draft, 60.0) == {"budget": 60.0} == behind_plan("render", draft, 60.0)
    given = Settings(effects=EffectsConfig(seconds=7.0))
    assert behind_plan("effects", given, None) == {"seconds": 7.0} == behind_plan("effects", given, 60.0)


def test_what_is_there_already_is_not_waited_for(said_of: SaidOf) -> None:
    assert said_of(done=(*BEFORE_TRAINING, "train")) == ["done in about 2 min"]


def test_what_follows_a_finished_training_goes_by_its_seconds(said_of: SaidOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the options would train for now, steps included."""
    monkeypatch.setattr(f"{__name__}.TRAINED", 1800.0)
    done = (*BEFORE_TRAINING, "train")
    for options in ({}, {"steps": 500}, {"after": "there", "more_steps": 500}):
        assert said_of(done=done, train=options) == ["done in about 16 min"]


# --- going on from a finished training


@pytest.mark.parametrize(
    ("names", "train", "words"),
    [
        # 600 s and what beside them; then shares of 780 s.
        (usual(), {"more_seconds": 600.0}, ["done in about 18 min"]),
        (usual(), {"more_seconds": 600.0, "seconds": 30.0}, ["done in about 18 min"]),
        (usual(), {"more_seconds": 20.0, "preset": "high"}, ["done in about 3 min"]),
        (("train", "report"), {"more_seconds": 600.0}, ["done in about 10 min"]),
        (usual(), {"more_steps": 500}, []),
        (("train", "report"), {"more_steps": 500, "seconds": 30.0}, []),
        (usual(), {"more_seconds": 600.0, "after": "gone"}, []),
    ],
)
def test_more_is_expected_by_what_comes_on_top(
    said_of: SaidOf, names: Sequence[str], train: dict[str, Any], words: list[str]
) -> None:
    assert said_of(done=BEFORE_TRAINING, names=names, train={"after": "there"} | train) == words


@pytest.mark.parametrize(
    ("train", "words"),
    [
        ({"after": "there", "more_seconds": 600.0}, ["done in about 10 min"]),
        ({"after": "there", "more_steps": 500}, []),
        ({"steps": 500}, []),
    ],
)
def test_a_training_that_ends_itself_is_not_budgeted(said_of: SaidOf, train: dict[str, Any], words: list[str]) -> None:
    names = (*BEFORE_TRAINING, "train", "report")
    assert said_of(120.0, done=BEFORE_TRAINING, names=names, train=train) == words


def test_what_follows_more_is_budgeted_and_more_is_not(said_of: SaidOf) -> None:
    given: dict[str, Any] = {"train": {"after": "there", "more_seconds": 600.0}, "done": BEFORE_TRAINING}
    end = time.strftime("%H:%M", time.localtime(NOW + 606 + 300))
    assert said_of(300.0, **given) == [f"budget 5 min and 10 min on top, done at {end} at the latest"]


def test_a_study_is_expected_with_what_it_needs(said_of: SaidOf) -> None:
    study: dict[str, Any] = {"names": (*BEFORE_TRAINING, "tradeoff", "report"), "tradeoff": {"seconds": 1800.0}}
    assert said_of(done=(*BEFORE_TRAINING, "report"), **study) == ["done in about 30 min"]
    assert said_of(300.0, done=(*BEFORE_TRAINING, "report"), **study) == ["done in about 30 min"]
    assert said_of(done=(), **study) == ["done in about 31 min"]
    (words,) = said_of(300.0, done=BEFORE_TRAINING[:3], **study)
    assert words.startswith("budget 5 min and 30 min on top, done at ")


def test_more_takes_what_it_needs() -> None:
    given: dict[str, Any] = {"train": {"after": "there", "more_seconds": 600.0, "seconds": 30.0}}
    assert expected(Settings.model_validate(given), Photos(50, 0.75))["train"] == pytest.approx(604.75)
    given["train"] |= {"more_seconds": None, "more_steps": 9}
    assert expected(Settings.model_validate(given), Photos(50, 0.75))["train"] is None


def test_a_budget_tells_its_end_or_its_lack(said_of: SaidOf) -> None:
    (words,) = said_of(600.0)
    assert words.startswith("budget 10 min, done at about ") and words[-3] == ":"
    (words,) = said_of(30.0)
    assert words.startswith("budget 30 s, too short for these photos: ") and " at least about " in words


def test_earlier_attempts_are_told_apart_from_small_budgets(said_of: SaidOf) -> None:
    (words,) = said_of(300.0, before=240.0)
    assert words.startswith("budget 5 min, of which 1 min are left; ") and "give a larger --budget" in words
    assert "of which 0 s are left" in said_of(300.0, before=400.0)[0]


def test_no_end_is_given_that_only_a_training_would_need(said_of: SaidOf) -> None:
    done = ("ingest", "sfm", "normalise", "effects", "train", "evaluate", "render")
    most = time.strftime("%H:%M", time.localtime(NOW + 0.35 * 3600))
    assert said_of(3600.0, done=done) == [f"budget 1 h, done at {most} at the latest"]
    left = time.strftime("%H:%M", time.localtime(NOW + 600))
    assert said_of(3600.0, done=done, before=3000.0) == [f"budget 1 h, done at {left} at the latest"]
    assert said_of(3600.0)[0].startswith("budget 1 h, done at about ")


# --- reading the photos


def test_large_photos_cost_each_stage_that_reads_all() -> None:
    small, large, given = Photos(200, 1.7), Photos(200, 24.0), Settings.model_validate({"train": {"seconds": 60.0}})
    before, after = expected(given, small), expected(given, large)
    more = {stage: (after[stage] or 0) - (before[stage] or 0) for stage in before}
    once = large.reading_seconds(2) - small.reading_seconds(2)
    assert once == pytest.approx(89.2)
    assert more == pytest.approx(
        dict.fromkeys(more, 0.0)
        | dict.fromkeys(("ingest", "sfm", "effects", "train"), once)
        | {"report": 13.38, "viewer": 11.15}
    )
    assert expected(given, large)["ingest"] == pytest.approx(0.5 + large.reading_seconds(2))
    assert expected(given, large, cores=64)["ingest"] == pytest.approx(0.5 + large.reading_seconds(8))


def test_small_sets_are_expected_to_take_as_long_as_measured() -> None:
    assert Photos(50, 0.75).reading_seconds(2) == pytest.approx(0.75)
    times = expected(Settings(), Photos(50, 0.75))
    known = {stage: seconds for stage, seconds in times.items() if seconds is not None}
    before = {"ingest": 1.1, "sfm": 57.9, "normalise": 0.3, "scale": 0.3, "effects": 10.0, "viewer": 3.1, "report": 2.0}
    assert known == pytest.approx(before, abs=1.0)


def test_a_budget_too_short_for_reading_is_said_to_be(said_of: SaidOf) -> None:
    times: dict[str, float | None] = {"train": None, "report": 2.0}
    assert "done at about" in forecast.budget_message(STAGES, Left(60.0, 60.0), times, 1.0)
    assert "too short for these photos: it takes at least about 1 min 20 s" in forecast.budget_message(
        STAGES, Left(60.0, 60.0), times, 40.0
    )
