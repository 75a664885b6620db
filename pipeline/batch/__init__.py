"""`pipeline batch`: every scene of a folder by a `pipeline run` of its own, and one page that ranks the results.

What is known of the scenes is in batch.json, written before and after each run; the same command goes on from there.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.batch import batch_file
from pipeline.batch.batch_file import BatchFile, SceneFailure, SceneState
from pipeline.batch.page import PAGE, write_page
from pipeline.batch.scene_run import figures_of, run_scene
from pipeline.batch.scenes import Scene
from pipeline.engine.display import Display
from stages.contract import StageError
from stages.io.amounts import duration


@dataclass(frozen=True)
class Batch:
    """Scenes and where their workspaces go: ``folder``/NAME.nerf, NAME.log beside it. ``words`` are the options of each
    run; ``budget`` is seconds for all runs, None without a limit."""

    scenes: Sequence[Scene]
    folder: Path
    words: Sequence[str]
    budget: float | None

    def workspace(self, name: str) -> Path:
        return self.folder / f"{name}.nerf"

    def log(self, name: str) -> Path:
        return self.folder / f"{name}.log"


def run_batch(batch: Batch, display: Display) -> int:
    """Run every scene; the number of those that failed. Raises StageError where another batch works in its folder, or
    nothing can be written there."""
    try:
        batch.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(batch.folder / ".lock", timeout=0):
            return _run_all(batch, display)
    except Timeout:
        hint = "Wait for it to end, or give another folder with -o."
        raise StageError(
            "pipeline.batch-in-use", f"{batch.folder} is in use", "another batch runs there", hint
        ) from None
    except OSError as error:
        hint = "Make room there, or give a writable folder with -o."
        why = error.strerror or str(error)
        raise StageError("pipeline.batch-cannot-write", f"cannot write to {batch.folder}", why, hint) from error


def _run_all(batch: Batch, display: Display) -> int:
    state = _continued(batch, batch_file.read(batch.folder))
    limit = "" if batch.budget is None else f" · {duration(batch.budget)} for all"
    display.headline(f"{len(state.scenes)} scenes · results in {batch.folder}{limit}")
    for scene in batch.scenes:
        _run_one(batch, state, scene, display)
    failed = [name for name, scene in state.scenes.items() if scene.state == "failed"]
    done = len(state.scenes) - len(failed)
    words = f"{done} of {len(state.scenes)} scenes are done" + (f"; failed: {', '.join(failed)}" if failed else "")
    display.finished(f"{words} → {batch.folder / PAGE}", {PAGE: batch.folder / PAGE})
    return len(failed)


def _continued(batch: Batch, before: BatchFile) -> BatchFile:
    """How the scenes stand at the start: as they were left where the same was asked for, but that failed ones wait."""
    same = (before.words, before.budget) == (list(batch.words), batch.budget)
    scenes = dict[str, SceneState]()
    for scene in batch.scenes:
        known, photos = before.scenes.get(scene.name) if same else None, str(scene.photos.absolute())
        scenes[scene.name] = known if known is not None and known.photos == photos else SceneState(photos=photos)
        if scenes[scene.name].state == "failed":
            scenes[scene.name] = SceneState(photos=photos, spent=scenes[scene.name].spent)
    return BatchFile(words=list(batch.words), budget=batch.budget, scenes=scenes)


def _run_one(batch: Batch, state: BatchFile, scene: Scene, display: Display) -> None:
    own = state.scenes[scene.name]
    own.share, own.state = state.share(scene.name), "running"
    _write(batch, state)
    limit = () if own.share is None else ("--budget", f"{own.share:.0f}s")
    words = (str(scene.photos), "-o", str(batch.workspace(scene.name)), *batch.words, *limit)
    began, spent = time.monotonic(), own.spent
    display.begin(scene.name)
    try:
        last, own.failure = run_scene(words, batch.log(scene.name), display.update)
    finally:
        seconds = time.monotonic() - began
        own.spent = round(spent + seconds, 1)
        _write(batch, state)
    own.state = "failed" if own.failure else "done"
    if own.failure:
        display.failed(scene.name, _as_error(own.failure))
    else:
        own.figures = figures_of(batch.workspace(scene.name))
        own.line = _line(own) or last
        display.end(scene.name, own.line, seconds, cached=False)
    _write(batch, state)


def _write(batch: Batch, state: BatchFile) -> None:
    batch_file.write(batch.folder, state)
    write_page(batch.folder, state)


def _as_error(failure: SceneFailure) -> StageError:
    where = f"{failure.stage}: " if failure.stage else ""
    return StageError("pipeline.scene-failed", f"{where}{failure.what}", failure.why, failure.hint)


def _line(scene: SceneState) -> str:
    """The result in short; empty where no report was made."""
    figures = scene.figures
    if figures.get("psnr") is None:
        return ""
    registered = f"{figures['registered']}/{figures['photos']} photos"
    doubt = " · its cameras are doubtful" if figures["cameras_doubtful"] else ""
    return f"{figures['psnr']:.1f} dB, SSIM {figures['ssim']:.2f} · {registered}{doubt}"
