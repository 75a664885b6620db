"""How a budget is shared out among scenes, and what is kept of them."""

from pathlib import Path

import pytest

from pipeline.batch import batch_file
from pipeline.batch.batch_file import BatchFile, SceneState
from tests.refusals import refused


def batch(**scenes: SceneState) -> BatchFile:
    return BatchFile(budget=90, scenes=scenes)


def waiting(spent: float = 0) -> SceneState:
    return SceneState(photos="p", spent=spent)


def done(spent: float) -> SceneState:
    return SceneState(photos="p", state="done", allocated=30, spent=spent)


def test_scenes_that_wait_share_what_the_others_leave():
    assert batch(a=waiting(), b=waiting(), c=waiting()).allocated("a") == pytest.approx(30)
    assert batch(a=done(10), b=waiting(), c=waiting()).allocated("b") == pytest.approx(40)
    assert batch(a=done(50), b=waiting(), c=waiting()).allocated("b") == pytest.approx(20)


def test_a_budget_that_is_spent_leaves_nothing():
    left = batch(a=done(200), b=waiting()).allocated("b")
    assert left is not None and left < 0


def test_an_interrupted_scene_keeps_its_share():
    stopped = SceneState(photos="p", state="running", allocated=30, spent=12)
    assert batch(a=stopped, b=waiting(), c=waiting()).allocated("a") == pytest.approx(30)
    assert batch(a=stopped, b=waiting(), c=waiting()).allocated("b") == pytest.approx(30)


def test_what_a_failed_attempt_took_is_spent():
    assert batch(a=done(40), b=waiting(spent=20), c=waiting()).allocated("b") == pytest.approx(15)


def test_scenes_at_the_same_time_share_the_machines_time():
    started = SceneState(photos="p", state="running", allocated=45)
    assert batch(a=waiting(), b=waiting(), c=waiting(), d=waiting()).allocated("a", 2) == pytest.approx(45)
    assert batch(a=started, b=waiting(), c=waiting(), d=waiting()).allocated("b", 2) == pytest.approx(45)
    assert batch(a=done(20), b=started, c=waiting(), d=waiting()).allocated("c", 2) == pytest.approx((180 - 65) / 2)
    assert batch(a=started, b=started, c=waiting()).allocated("c", 2) == pytest.approx(45), "not more than is left"


def test_without_a_budget_nothing_is_allocated():
    assert BatchFile(scenes={"a": done(5)}).allocated("a") is None


def test_what_is_written_is_read(tmp_path: Path):
    known = batch(a=done(1), b=waiting())
    batch_file.write(tmp_path, known)
    assert batch_file.read(tmp_path) == known
    assert batch_file.read(tmp_path / "new") == BatchFile()


@pytest.mark.parametrize("content", ["", "{", '{"version": 1, "more": 2}', '{"scenes": {"a": {}}}'])
def test_a_damaged_file_is_refused(tmp_path: Path, content: str):
    (tmp_path / batch_file.NAME).write_text(content)
    with refused("pipeline.batch-file", tmp_path / batch_file.NAME):
        batch_file.read(tmp_path)
