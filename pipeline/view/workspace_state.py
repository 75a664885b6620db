"""What a workspace has to show: nothing yet, a running training, one that was stopped, one that is finished.

All of it comes from files, read anew each time, so it does not matter which side is started, ended or killed first.
"""

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pipeline.engine import manifest_file
from pipeline.engine.manifest_file import BadManifest, Manifest
from pipeline.engine.workspace import Workspace
from stages.contract import StageError
from stages.scale import metres_per_unit
from stages.train.live import FIELD, LIVE, SCENE, STATE, ask_to_finish, touch

if TYPE_CHECKING:
    from nerf.fields.interface import RadianceModel
    from stages.viewer.live import LiveContents

Phase = Literal["waiting", "training", "stopped", "finished"]
FINISHED = "finished"  # the name of a finished training's field; others are those of snapshots


@dataclass(frozen=True)
class Training:
    """Where a training stands: its key, its folder, and what it last said of itself."""

    phase: Phase
    key: str | None
    folder: Path | None
    told: dict[str, Any]

    @property
    def field(self) -> str | None:
        """The name of its latest field; None before the first."""
        return FINISHED if self.phase == "finished" else self.told.get("field")

    def live_file(self, *at: str) -> bytes | None:
        """What lies there in ``live/``; None where nothing does any more."""
        if self.folder is None:
            return None
        with suppress(FileNotFoundError):  # the training has gone on meanwhile: the page asks again
            return self.folder.joinpath(LIVE, *at).read_bytes()
        return None


class WorkspaceState:
    """Answers the server's questions about one workspace. Its calls may come from any thread."""

    def __init__(self, root: Path) -> None:
        self.workspace = Workspace(root)

    def prepare(self) -> None:
        """Load what packs the field of a finished training, which takes seconds."""
        import stages.viewer.live  # noqa: F401

    def training(self) -> Training:
        """The training that the workspace's recorded run has, or is to have."""
        running = self.workspace.running() is not None
        keys = self._keys()
        key = keys.get("train")
        if key is None:
            return Training("waiting" if running else "stopped", None, None, {})
        partial, finished = self.workspace.partial("train", key), self.workspace.folder("train", key)
        told = _told(partial)
        if partial.is_dir() and (running or told):
            return Training("training" if running else "stopped", key, partial, told)
        manifest, scene = self._finished("train", keys), self._finished("normalise", keys)
        # A run that has not come to stage train yet may have another scene already.
        if manifest is None or scene is None or manifest.inputs.get("normalise") != scene.outputs_digest:
            return Training("waiting" if running else "stopped", key, None, {})
        return Training("finished", key, finished, _told_by(manifest.facts, finished))

    def watched(self) -> dict[str, Any]:
        """What a page is told, which from now on counts as one that watches."""
        training = self.training()
        if training.phase == "training" and training.folder is not None:
            touch(training.folder)
        told = {name: value for name, value in training.told.items() if name != "field"}
        now = {"phase": training.phase, "key": training.key, "field": training.field, "metres_per_unit": self._metres()}
        return told | now

    def _metres(self) -> float | None:
        """Per unit of the sfm frame; None where that is unknown, or not yet."""
        with suppress(KeyError, StageError):
            return metres_per_unit(self.workspace.folder("scale", self._keys()["scale"]))
        return None

    def finish(self) -> bool:
        """Ask the training to end early; False where none runs."""
        training = self.training()
        return training.phase == "training" and training.folder is not None and ask_to_finish(training.folder)

    def finished_page(self) -> Path | None:
        """viewer.html of the finished training; None while a run may make another, which a page is to follow."""
        if self.workspace.running() is not None or self.training().phase != "finished":
            return None
        keys = self._keys()
        train, viewer = self._finished("train", keys), self._finished("viewer", keys)
        if train is None or viewer is None or viewer.inputs.get("train") != train.outputs_digest:
            return None
        page = self.workspace.folder("viewer", viewer.key) / "viewer.html"
        return page if page.is_file() else None

    def scene(self) -> bytes | None:
        """Cameras, points and what else does not change; None before there is a field."""
        training = self.training()
        if training.phase != "finished":
            return training.live_file(SCENE)
        return self._of_finished(training, lambda contents, _, info: contents.scene_contents(info))

    def field(self, name: str) -> bytes | None:
        """The field of that name; None where it is not the latest."""
        training = self.training()
        if name != training.field:
            return None
        if name != FINISHED:
            return training.live_file(name, FIELD)
        return self._of_finished(training, lambda contents, model, info: contents.field_contents(model, info))

    def _of_finished(
        self, training: Training, packed: "Callable[[LiveContents, RadianceModel, dict[str, Any]], bytes]"
    ) -> bytes | None:
        """What is packed of a finished training, whose page is not there yet; None where it cannot be read."""
        from stages.io.field_files import load_field
        from stages.viewer.live import LiveContents

        assert training.folder is not None
        try:
            contents = LiveContents(self.workspace.folder("normalise", self._keys()["normalise"]))
            return packed(contents, *load_field(training.folder, renders=False))
        except (FileNotFoundError, KeyError, StageError):  # another run has begun meanwhile: the page asks again
            return None

    def _finished(self, stage: str, keys: dict[str, str]) -> Manifest | None:
        """What the finished ``stage`` of these keys says of itself; None where there is none."""
        try:
            return manifest_file.read(self.workspace.folder(stage, keys[stage]))
        except (KeyError, FileNotFoundError, BadManifest):
            return None

    def _keys(self) -> dict[str, str]:
        try:
            return self.workspace.read_run().keys
        except StageError:  # the next run says so
            return {}


def _told(partial: Path) -> dict[str, Any]:
    try:
        return json.loads((partial / LIVE / STATE).read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def _told_by(facts: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What a finished training says of itself, as a running one does."""
    curve: list[dict[str, Any]] = []
    with suppress(OSError, ValueError, KeyError):  # a record, which nothing needs
        curve = json.loads((folder / "curve.json").read_text("utf-8"))["points"]
    return {
        "step": facts["steps"],
        "total_steps": facts["steps"],
        "progress": 1.0,
        "seconds": facts["train_seconds"],
        "train_psnr": facts["train_psnr"],
        "curve": [[point["seconds"], point["probe_psnr"], point["train_psnr"]] for point in curve],
    }
