"""Workspaces and photos that are moved, gone or read-only, and two programs at once."""

import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.engine.stage_list import usual
from tests.drills.campaigns import Chain
from tests.drills.drill import Program, copy_workspace, results, run_words


def working(stage: str):
    """Reached once ``stage`` has said that it is at work."""
    return lambda events: any(event["event"] == "progress" and event["stage"] == stage for event in events)


def test_moved_half_way_through_training(chain: Chain, tmp_path: Path):
    program = chain.start(chain.before("train", tmp_path / "here.nerf"))
    program.wait_until(lambda events: any("step" in event.get("message", "") for event in events))
    program.strike(signal.SIGKILL)
    assert list((tmp_path / "here.nerf/train").glob("*.partial"))
    (tmp_path / "elsewhere").mkdir()
    moved = (tmp_path / "here.nerf").rename(tmp_path / "elsewhere/other name.nerf")
    assert chain.lost(moved) == []
    assert all(link.exists() for link in (moved / "output").iterdir()), "output/ points at what is there"


def test_photos_moved_and_gone(chain: Chain, tmp_path: Path):
    photos = tmp_path / "photos"
    shutil.copytree(chain.photos, photos)
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    moved = photos.rename(tmp_path / "moved")
    program = Program(run_words(moved, workspace), tmp_path / "says").finish()
    assert program.events()[-1]["message"].startswith("nothing to do")
    away = moved.rename(tmp_path / "away")
    program = Program(["resume", str(workspace), "--json"], tmp_path / "says")
    # The photos were ingested and are not missed; the cameras lay among them, and cameras given as files must stay.
    assert program.wait() == 11
    (error,) = [event for event in program.events() if event["event"] == "error"]
    assert error["what"] == f"{moved} does not exist"
    assert results(workspace) == chain.expected
    away.rename(moved)
    program = Program(["resume", str(workspace), "--json"], tmp_path / "says").finish()
    assert program.events()[-1]["message"].startswith("nothing to do")


def test_photos_gone_before_they_were_ingested(tmp_path: Path):
    program = Program(["run", str(tmp_path / "none"), "-o", str(tmp_path / "w.nerf"), "--json"], tmp_path / "says")
    assert program.wait() == 10
    (error,) = program.events()
    assert error["event"] == "error" and error["hint"]


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    """A folder that is made read-only by being mounted so: permissions do not bind an administrator."""
    folder = tmp_path / "read-only"
    folder.mkdir()
    mounted = subprocess.run(["mount", "--bind", str(folder), str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"nothing can be mounted read-only here: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def lock_up(folder: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)


def test_a_read_only_folder(chain: Chain, read_only: Path, tmp_path: Path):
    workspace = copy_workspace(chain.workspace, read_only / "w.nerf")
    photos = read_only / "photos"
    shutil.copytree(chain.photos, photos)
    lock_up(read_only)
    # Photos may lie in it, a workspace can be looked at, but nothing can be run there.
    program = Program(["status", str(workspace)], tmp_path / "says")
    assert program.wait() == 0 and program.said.count(" cached ") == len(usual())
    for at in (workspace, read_only / "new.nerf"):
        program = chain.start(at, says=tmp_path / "says")
        assert program.wait() == 3 and not program.complaints
        assert program.events()[-1]["why"] == "Read-only file system"
    Program(run_words(photos, tmp_path / "w.nerf", "--until", "sfm"), tmp_path / "says").finish()
    assert results(tmp_path / "w.nerf") == {stage: chain.expected[stage] for stage in ("ingest", "sfm")}


def test_two_runs_on_one_workspace(chain: Chain, tmp_path: Path):
    first = chain.start(chain.before("train", tmp_path / "w.nerf"))
    first.wait_until(working("train"))
    second = chain.start(tmp_path / "w.nerf", says=tmp_path / "second")
    assert second.wait() == 3
    (error,) = second.events()
    assert error["what"].endswith("w.nerf is in use") and str(first.process.pid) in error["why"]
    first.finish()
    assert results(tmp_path / "w.nerf") == chain.expected


def test_two_workspaces_share_photos(chain: Chain, tmp_path: Path):
    programs = [chain.start(tmp_path / name, "--until", "train") for name in ("a.nerf", "b.nerf")]
    for program in programs:
        program.finish()
    for name in ("a.nerf", "b.nerf"):
        found = results(tmp_path / name)
        assert found == {stage: chain.expected[stage] for stage in found} and "train" in found
