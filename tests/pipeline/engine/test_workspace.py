"""What a workspace does to files: its own are shown, replaced and removed; what others put there stays."""

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.failures import StageFailed, recorded
from pipeline.engine.manifest_file import Manifest, describe_outputs, outputs_digest
from pipeline.engine.run_file import RunFile
from pipeline.engine.stage_list import STAGES
from pipeline.engine.status import status_of
from pipeline.engine.workspace import COPIES, Workspace
from stages.contract import StageError
from stages.io.files import make_durable
from tests.refusals import refused

KEY = "0123456789abcdef"


def result(root: Path, number: int) -> Path:
    """A finished stage with a file and a folder to show."""
    folder = root / "mesh" / f"{number:016x}"
    (folder / "images").mkdir(parents=True)
    (folder / "images/a.png").write_text(f"picture {number}")
    (folder / "mesh.ply").write_text(f"mesh {number}")
    return folder


def test_photos_below_the_folder_for_the_results_are_safe(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    photos = tmp_path / "project/output/images"
    photos.mkdir(parents=True)
    for k in range(3):
        Image.new("RGB", (4, 4), (k, 0, 0)).save(photos / f"{k}.png")
    assert run_command(["run", str(photos), "-o", str(tmp_path / "project")]) == 3
    assert f"{photos} was not made by this program" in capsys.readouterr().err
    assert len([*photos.iterdir()]) == 3
    assert [path.name for path in (tmp_path / "project").iterdir()] == ["output"], "nothing has been written"


def test_what_others_put_into_output_stays(tmp_path: Path):
    names = ("images", "mesh.ply")
    with Workspace(tmp_path) as workspace:
        folder = result(tmp_path, 1)
        (tmp_path / "output").mkdir()
        (tmp_path / "output/mesh.ply").write_text("of another program")
        workspace.unlink_outputs(names)
        with refused("pipeline.not-a-result"):
            workspace.link_outputs(folder, names)
    with refused("pipeline.not-a-result"), Workspace(tmp_path):
        pass
    assert (tmp_path / "output/mesh.ply").read_text() == "of another program"


def not_allowed(*_: object, **__: object) -> None:
    raise OSError(22, "A required privilege is not held by the client")


def test_copies_make_way_where_links_are_not_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Path, "symlink_to", not_allowed)
    names, output = ("images", "mesh.ply"), tmp_path / "output"
    for number in (1, 2):
        with Workspace(tmp_path) as workspace:
            workspace.link_outputs(result(tmp_path, number), names)
        assert (output / "mesh.ply").read_text() == f"mesh {number}"
        assert (output / "images/a.png").read_text() == f"picture {number}"
    monkeypatch.undo()
    workspace.link_outputs(result(tmp_path, 3), names[:1])
    assert (output / "images").is_symlink() and not (output / "mesh.ply").is_symlink()
    assert (tmp_path / COPIES).read_text() == "mesh.ply\tmesh/0000000000000002/mesh.ply"
    workspace.unlink_outputs(names)
    assert not any(output.iterdir())
    (output / "mesh.ply").write_text("the user's own")
    workspace.unlink_outputs(names)
    with refused("pipeline.not-a-result"):
        workspace.link_outputs(result(tmp_path, 4), names)
    assert (output / "mesh.ply").read_text() == "the user's own"


def test_what_is_shown_already_is_not_copied_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Path, "symlink_to", not_allowed)
    copytree, copied = shutil.copytree, list[Path]()

    def noted(source: Path, place: Path) -> None:
        copied.append(source)
        copytree(source, place)

    monkeypatch.setattr(shutil, "copytree", noted)
    first, second, workspace = result(tmp_path, 1), result(tmp_path, 2), Workspace(tmp_path)
    for folder in (first, second, second, first):
        workspace.link_outputs(folder, ("images",))
    assert copied == [first / "images", second / "images", first / "images"]

    def killed(folder: Path) -> None:
        (folder / "a.png").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shutil, "rmtree", killed)
        workspace.unlink_outputs(("images",))
    workspace.link_outputs(first, ("images",))
    assert (tmp_path / "output/images/a.png").is_file(), "half of a copy shows nothing"


def test_folders_of_others_are_not_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "lost+found").mkdir()
    iterdir = Path.iterdir

    def locked(folder: Path) -> Iterator[Path]:
        """As for whoever is no administrator."""
        if folder.name == "lost+found":
            raise PermissionError(errno.EACCES, "Permission denied")
        return iterdir(folder)

    monkeypatch.setattr(Path, "iterdir", locked)
    with Workspace(tmp_path) as workspace:
        workspace.write_run(workspace.read_run())
    assert Workspace.existing(tmp_path)


def test_a_workspace_that_was_copied_without_its_links_is_one(tmp_path: Path):
    names, first, again = ("images", "mesh.ply"), tmp_path / "first", tmp_path / "again"
    with Workspace(first) as workspace:
        workspace.write_run(RunFile())
        workspace.link_outputs(result(first, 1), names)
    shutil.copytree(first, again)
    assert not (again / "output/images").is_symlink()
    with Workspace(again) as workspace:
        workspace.link_outputs(result(again, 2), names)
    assert (again / "output/images").is_symlink() and (again / "output/mesh.ply").read_text() == "mesh 2"


def test_a_running_stage_is_not_called_interrupted(tmp_path: Path):
    runner: Any = SimpleNamespace(run_file=RunFile(), resolve=lambda *_, **__: SimpleNamespace(key=KEY))
    asked = Workspace(tmp_path)
    asked.partial("mesh", KEY).mkdir(parents=True)
    with Workspace(tmp_path):
        found = status_of(asked, runner, "mesh")
    assert (found.state, found.text) == ("partial", f"process {os.getpid()} is running in this workspace")
    assert status_of(asked, runner, "mesh").text == f"interrupted; `pipeline resume {tmp_path}` resumes it"


def test_status_tells_a_failure_from_an_interruption(tmp_path: Path):
    runner: Any = SimpleNamespace(run_file=RunFile(), resolve=lambda *_, **__: SimpleNamespace(key=KEY))
    workspace = Workspace(tmp_path)
    partial = workspace.partial("mesh", KEY)
    partial.mkdir(parents=True)
    with pytest.raises(StageFailed), recorded(STAGES["mesh"], partial):
        raise StageError("mesh.empty", "there is no surface", "the field is empty", "Train longer.")
    found = status_of(workspace, runner, "mesh")
    assert (found.state, found.text) == ("failed", f"there is no surface; `pipeline resume {tmp_path}` tries again")
    with pytest.raises(StageFailed), recorded(STAGES["mesh"], partial):
        raise OSError(28, "No space left on device")
    assert status_of(workspace, runner, "mesh").state == "failed"
    with suppress(KeyboardInterrupt), recorded(STAGES["mesh"], partial):
        raise KeyboardInterrupt
    assert status_of(workspace, runner, "mesh").state == "partial"


@pytest.mark.parametrize(
    "stage, recorded, command",
    [
        ("mesh", None, "resume"),
        ("mesh", ["ingest", "sfm", "normalise", "effects", "train", "mesh"], "resume"),
        ("mesh", ["ingest", "sfm"], "mesh"),
        ("tradeoff", None, "tradeoff"),
    ],
)
def test_the_command_named_is_one_that_makes_the_stage(
    tmp_path: Path, stage: str, recorded: list[str] | None, command: str
):
    job = SimpleNamespace(key=KEY)
    runner: Any = SimpleNamespace(run_file=RunFile(stages=recorded), resolve=lambda *_, **__: job)
    workspace = Workspace(tmp_path)
    workspace.partial(stage, KEY).mkdir(parents=True)
    assert status_of(workspace, runner, stage).text == f"interrupted; `pipeline {command} {tmp_path}` resumes it"
    workspace.folder(stage, KEY).mkdir(parents=True)
    (workspace.folder(stage, KEY) / "manifest.json").write_text("{")
    damaged = status_of(workspace, runner, stage)
    assert damaged.state == "damaged" and damaged.text.endswith(f"`pipeline {command} {tmp_path} --verify` rebuilds it")


def test_a_killed_process_is_not_running(tmp_path: Path):
    asked = Workspace(tmp_path)
    assert asked.running() is None
    with Workspace(tmp_path):
        assert asked.running() == str(os.getpid())
    (tmp_path / ".lock.pid").write_text("1\n")
    assert asked.running() is None
    with Workspace(tmp_path):  # the question did not take the lock
        pass


def test_threads_that_ask_at_once_see_no_run(tmp_path: Path):
    asked, told = Workspace(tmp_path), list[str | None]()
    (tmp_path / ".lock.pid").write_text("1\n")  # as a killed process leaves it
    threads = [Thread(target=lambda: told.extend(asked.running() for _ in range(300))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert told == [None] * 1200


def test_clean_takes_only_what_is_named_by_a_key(tmp_path: Path):
    for name in ("train/images", f"train/{KEY}", f"train/{KEY}.partial", f"train/{KEY}.bad"):
        (tmp_path / name).mkdir(parents=True)
    stale = Workspace(tmp_path).stale_folders({}, ["train"])
    assert [path.name for path in stale] == [KEY, f"{KEY}.bad", f"{KEY}.partial"]


def test_clean_takes_an_abandoned_second_attempt_at_what_is_finished(tmp_path: Path):
    workspace = Workspace(tmp_path)
    workspace.partial("mesh", KEY).mkdir(parents=True)
    assert workspace.stale_folders({"mesh": KEY}, ["mesh"]) == []
    outputs = describe_outputs(tmp_path, ())
    made = Manifest("mesh", 1, KEY, {}, {}, outputs, outputs_digest(outputs), {}, {}, "", 1.0, "now")
    workspace.finish(workspace.partial("mesh", KEY), workspace.folder("mesh", KEY), made)
    workspace.partial("mesh", KEY).mkdir()
    assert workspace.stale_folders({"mesh": KEY}, ["mesh"]) == [workspace.partial("mesh", KEY)]


def test_photos_in_place_of_their_workspace_are_told_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "photos.nerf"):
        (tmp_path / folder).mkdir()
    (tmp_path / "photos.nerf/run.json").write_text("{}")
    assert run_command(["status", "photos/"]) == 3
    assert "try: The workspace with its name is photos.nerf." in capsys.readouterr().err


def test_files_are_synced_where_that_takes_the_right_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fcntl = pytest.importorskip("fcntl", reason="the system itself asks for that right")

    def fsync(descriptor: int) -> None:
        """As on Windows."""
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
                raise OSError(errno.EBADF, "Bad file descriptor")
            synced.append(descriptor)

    synced = list[int]()
    monkeypatch.setattr(os, "fsync", fsync)
    workspace = Workspace(tmp_path)
    partial, folder = workspace.partial("mesh", KEY), workspace.folder("mesh", KEY)
    partial.mkdir(parents=True)
    (partial / "mesh.ply").write_text("a mesh")
    make_durable(partial)
    outputs = describe_outputs(partial, ("mesh.ply",))
    digest = outputs_digest(outputs)
    workspace.finish(partial, folder, Manifest("mesh", 1, KEY, {}, {}, outputs, digest, {}, {}, "", 1.0, "now"))
    assert len(synced) == 3, "the mesh twice, and the manifest"
    assert workspace.finished("mesh", KEY, deep=True)
