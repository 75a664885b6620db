"""What is promised at the start of a run."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline import forecast
from pipeline.budget import Budget
from pipeline.chain import usual
from pipeline.forecast import Photos, expected, photos_of, sfm_seconds
from pipeline.settings import Settings
from stages.video import video_writer
from tests.png_files import png


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
    (photos / "empty").mkdir()
    assert photos_of(settings(photos / "empty")) is None
    assert forecast.times(settings(photos / "gone")) == {}


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
def test_structure_from_motion_is_foretold_within_a_factor_of_two_and_a_half(set_of: Photos, measured: float) -> None:
    """fox, fountain_p11 and fern on two idle cores."""
    assert measured / 2.5 < sfm_seconds(set_of, 2) < 2.5 * measured
    assert sfm_seconds(set_of, 16) < sfm_seconds(set_of, 2)


def test_known_cameras_take_no_time() -> None:
    times = expected(Settings.model_validate({"sfm": {"cameras": Path("t.json")}}), Photos(50, 2.0))
    assert times["sfm"] == 0.2 and set(times) == set(usual())
    assert [stage for stage, seconds in times.items() if seconds is None] == ["train", "evaluate", "render", "mesh"]


Promise = Callable[..., list[str]]


@pytest.fixture
def promise(photos: Path) -> Promise:
    def words(budget: float | None = None, done: tuple[str, ...] = (), **stages: dict[str, Any]) -> list[str]:
        runner: Any = SimpleNamespace(
            settings=settings(photos, **stages),
            budget=budget and Budget(Budget.new(budget, "of")),
            is_done=lambda stage: stage in done,
            time_left=lambda budget: budget.left,
        )
        return forecast.promise(runner, usual(), frozenset(), expected(runner.settings, Photos(50, 2.0)))

    return words


def test_a_run_without_a_budget_is_foretold_in_minutes(promise: Promise) -> None:
    assert promise() == ["done in about 6 min"]  # fox: 5 min 42 s
    assert promise(train={"seconds": 900.0}) == ["done in about 24 min"]
    assert promise(train={"preset": "draft"}) == ["done in about 2 min"]
    assert promise(train={"steps": 500}) == []


def test_what_is_there_already_is_not_waited_for(promise: Promise) -> None:
    assert promise(done=("ingest", "sfm", "normalise", "effects", "train")) == ["done in about 2 min"]
    assert promise(done=tuple(usual())) == [] == promise(600.0, done=tuple(usual()))


def test_a_budget_is_promised_with_its_end_or_said_to_be_too_short(promise: Promise) -> None:
    (words,) = promise(600.0)
    assert words.startswith("budget 10 min, done at about ") and words[-3] == ":"
    (words,) = promise(30.0)
    assert words.startswith("budget 30 s, too short for these photos: about ")
    assert words.endswith(" is the least that would do; all is made as small as can be")
