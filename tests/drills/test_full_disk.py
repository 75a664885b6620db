"""A disk that is full while a stage writes: the error is named, nothing finished is lost, with room the run goes on."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.engine import stage_list
from tests.drills.campaigns import Chain
from tests.drills.drill import MARK, Program, finished_folders, results
from tests.synthetic_photos import SyntheticPhotos

STAGES = stage_list.usual()
NO_ROOM = "No space left on device"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m", MARK, str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill_up(disk: Path, leave: int) -> Path:
    """Take all room but ``leave`` bytes."""
    ballast = disk / "ballast"
    with ballast.open("wb") as stream:
        stream.write(bytes(max(0, shutil.disk_usage(disk).free - leave)))
    return ballast


def error_of(program: Program) -> dict[str, str]:
    """The event that says what went wrong."""
    (error,) = [event for event in program.events() if event["event"] == "error"]
    assert program.complaints == "", program.complaints
    assert NO_ROOM in error["why"] or "no room" in error["what"] or "No space left" in str(error), error
    assert error["hint"]
    return error


@dataclass
class FullAt:
    """In the program: when ``stage`` begins to work, all room of ``disk`` but ``leave`` bytes is taken."""

    stage: str
    disk: Path
    leave: int

    def __call__(self) -> None:
        stage = stage_list.STAGES[self.stage]

        def run_on_a_full_disk(*arguments: Any) -> Any:
            fill_up(self.disk, self.leave)
            return stage.run(*arguments)

        stage_list.STAGES[self.stage] = replace(stage, run=run_on_a_full_disk)


LARGE = ("ingest", "train", "evaluate", "render", "mesh")  # stages that write more than a page or two


@pytest.mark.parametrize("stage, share", [*((stage, 0.0) for stage in STAGES), *((stage, 0.5) for stage in LARGE)])
def test_a_full_disk_at_every_stage(chain: Chain, small_disk: Path, stage: str, share: float):
    size = sum(path.stat().st_size for path in finished_folders(chain.workspace)[stage].rglob("*") if path.is_file())
    workspace, says = chain.before(stage, small_disk / "w.nerf"), small_disk.parent / "says"
    before = results(workspace)
    program = chain.start(workspace, says=says, prepare=FullAt(stage, small_disk, int(share * size)))
    code = program.wait()
    error = error_of(program)
    assert (error["stage"], code) == (stage, stage_list.STAGES[stage].exit_code)
    assert results(workspace) == before, "nothing finished is lost"
    (small_disk / "ballast").unlink()
    if share:
        assert chain.lost(workspace, until=stage, says=says) == []


@pytest.mark.parametrize("leave", [0, 1 << 16], ids=["at once", "soon"])
def test_a_disk_that_fills_up_somewhere(chain: Chain, small_disk: Path, leave: int):
    workspace = small_disk / "w.nerf"
    ballast = fill_up(small_disk, leave)
    program = chain.start(workspace, says=small_disk.parent / "says")
    code = program.wait()
    error = error_of(program)
    assert code == stage_list.STAGES[error["stage"]].exit_code if error["stage"] else code == 3
    ballast.unlink()
    assert chain.lost(workspace, says=small_disk.parent / "says") == []


@pytest.mark.slow
@pytest.mark.parametrize("leave", [200_000, 1_500_000], ids=["features", "matches"])
def test_a_full_disk_inside_colmap(synthetic_photos: SyntheticPhotos, small_disk: Path, leave: int):
    def sfm() -> Program:
        words = f"run {synthetic_photos.folder} -o {small_disk / 'w.nerf'} --json --until sfm --sfm.max-features 500"
        return Program(words.split(), small_disk.parent / "says")

    words = ["run", str(synthetic_photos.folder), "-o", str(small_disk / "w.nerf"), "--json", "--until", "ingest"]
    Program(words, small_disk.parent / "says").finish()
    ballast = fill_up(small_disk, leave)
    program = sfm()
    assert program.wait() == 11
    (error,) = [event for event in program.events() if event["event"] == "error"]
    assert error["stage"] == "sfm" and "the disk is full" in error["why"], error
    assert not list((small_disk / "w.nerf/sfm").glob("*/manifest.json"))
    ballast.unlink()
    sfm().finish()
    registered = json.loads(next((small_disk / "w.nerf/sfm").glob("*/registration.json")).read_text())["registered"]
    assert registered == 12
