"""Files of every stage that were cut, deleted or changed by a bit: found, named, quarantined, rebuilt, equal."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.engine import manifest_file
from pipeline.engine.manifest_file import BadManifest
from pipeline.engine.stage_list import usual
from tests.drills.campaigns import Chain
from tests.drills.drill import Program, copy_workspace, finished_folders, results

STAGES = usual()


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def cut(file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


DAMAGES: dict[str, Callable[[Path], None]] = {"flipped": flip, "cut": cut, "deleted": Path.unlink}


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def status(workspace: Path, *more: str) -> tuple[int, str]:
    program = Program(["status", str(workspace), *more], workspace.parent / "says")
    return program.wait(), program.said


def test_a_flipped_bit_in_any_file_is_found(chain: Chain, tmp_path: Path):
    # Every file of every stage in turn, manifests and records included.
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    count = 0
    for folder in finished_folders(workspace).values():
        for file in files_of(folder):
            sound = file.read_bytes()
            flip(file)
            with pytest.raises((BadManifest, UnicodeDecodeError), match=r"changed|cannot be used|decode"):
                manifest_file.check_outputs(folder, manifest_file.read(folder), deep=True)
            file.write_bytes(sound)
            count += 1
    assert count > 45


def test_every_stage_damaged_at_once(chain: Chain, tmp_path: Path):
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    chance = random.Random(7)
    for folder in finished_folders(workspace).values():
        files = [file for file in files_of(folder) if file.name != "manifest.json"]
        chance.choice(list(DAMAGES.values()))(chance.choice(files))
    code, said = status(workspace, "--verify")
    assert code == 1 and said.count(" damaged ") == len(STAGES), said
    program = chain.start(workspace, "--verify").finish()
    # The report is keyed by the times of the others, too: after them it has another key and needs no repair.
    assert program.said.count("quarantined as .bad and rebuilt") == len(STAGES) - 1
    assert results(workspace) == chain.expected
    assert len(list(workspace.glob("*/*.bad"))) == len(STAGES) - 1
    assert status(workspace, "--verify")[0] == 0


@pytest.mark.parametrize("upstream, stage", [("ingest", "train"), ("train", "render"), ("sfm", "normalise")])
def test_a_flipped_bit_does_not_reach_the_next_stage(chain: Chain, tmp_path: Path, upstream: str, stage: str):
    # Without being asked to verify: what is read is checked, and what was damaged is rebuilt beforehand.
    workspace = chain.before(stage, tmp_path / "w.nerf")
    folder = finished_folders(workspace)[upstream]
    flip(max(files_of(folder), key=lambda file: file.stat().st_size))
    program = chain.start(workspace, "--until", stage).finish()
    assert f"quarantined as .bad and rebuilt: {folder}" in program.said
    found = results(workspace)
    assert found == {name: digest for name, digest in chain.expected.items() if name in found} and stage in found


@pytest.mark.parametrize("kind", ["flipped", "deleted"])
@pytest.mark.parametrize("file", ["run.json", ".content.json", "manifest.json"])
def test_the_books_damaged(chain: Chain, tmp_path: Path, file: str, kind: str):
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    (path,) = (finished_folders(workspace)["mesh"] / file,) if file == "manifest.json" else (workspace / file,)
    DAMAGES[kind](path)
    if file == "run.json" and kind != "deleted":
        program = chain.start(workspace)
        assert program.wait() == 3
        assert "cannot read" in program.said and "Delete" in program.said
        path.unlink()
    assert chain.lost(workspace) == []


def test_bare_pixels_damaged(chain: Chain, tmp_path: Path):
    workspace = chain.before("train", tmp_path / "w.nerf")
    chain.start(workspace, "--until", "train").finish()
    for store in workspace.glob("ingest/*.pixels/t*-*"):
        if store.suffix != ".lock":
            flip(store)
    for stage in ("train", "evaluate", "render", "mesh", "report"):
        shutil.rmtree(workspace / stage, ignore_errors=True)
    program = chain.start(workspace, "--until", "evaluate").finish()
    assert "rebuilding the pixel store" in program.said
    found = results(workspace)
    assert found == {name: chain.expected[name] for name in found} and "evaluate" in found
