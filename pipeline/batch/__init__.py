"""`pipeline batch`: every scene of a folder by a `pipeline run` of its own, and one page that ranks the results.

Scenes run one after another, or one on each machine of a cluster. What is known of them is in batch.json, written
before and after each run; the same command goes on from there.
"""

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.batch import batch_file
from pipeline.batch.batch_file import BatchFile, SceneFailure, SceneState
from pipeline.batch.page import PAGE, write_page
from pipeline.batch.scene_run import Ending, SceneRun, figures_of, run_scene
from pipeline.batch.scenes import Scene, printable
from pipeline.engine.display import Display
from stages.contract import StageError
from stages.hardware import cluster
from stages.io.amounts import counted, duration

MIN_SECONDS = 1.0  # of the budget, for a scene to be begun


@dataclass(frozen=True)
class Batch:
    """Scenes of the folder ``of``, and where their workspaces go: ``folder``/NAME.nerf, NAME.log beside it. Each run is
    given the ``options``; ``budget`` is seconds for all runs, None without a limit. ``cluster`` is the address of the
    one that runs them, None: this machine."""

    of: Path
    scenes: Sequence[Scene]
    folder: Path
    options: Sequence[str]
    budget: float | None
    cluster: str | None = None

    def workspace(self, name: str) -> Path:
        return self.folder / f"{name}.nerf"

    def log(self, name: str) -> Path:
        return self.folder / f"{name}.log"


def other_folder(folder: Path, scenes: Path) -> str | None:
    """The other folder of scenes, still there, that the batch in ``folder`` was made from; None where there is none."""
    before = batch_file.read(folder).folder
    same = not before or not os.path.isdir(before) or os.path.realpath(before) == os.path.realpath(scenes)
    return None if same else before


def run_batch(batch: Batch, display: Display) -> int:
    """Run every scene; the number of those that failed. Raises StageError where another batch works in its folder, or
    nothing can be written there."""
    try:
        batch.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(batch.folder / ".lock").acquire(timeout=0)
    except Timeout:
        hint = "Wait for it to end, or give another folder with -o."
        what, why = f"{batch.folder} is in use", "another batch runs there"
        raise StageError("pipeline.batch-in-use", what, why, hint) from None
    except OSError as error:
        raise _cannot_write(batch, error) from error
    with lock, cluster.joined(batch.cluster, [batch.folder, batch.of, Path.cwd()]):
        return _run_all(batch, display)


def _cannot_write(batch: Batch, error: OSError) -> StageError:
    hint = "Make room there, or give a writable folder with -o."
    why = error.strerror or str(error)
    return StageError("pipeline.batch-cannot-write", f"cannot write to {batch.folder}", why, hint)


def _run_all(batch: Batch, display: Display) -> int:
    state = _continued(batch, batch_file.read(batch.folder))
    limit = "" if batch.budget is None else f" · {duration(batch.budget)} for all"
    words = [counted(len(state.scenes), "scene"), f"results in {batch.folder}{limit}", *cluster.described()]
    display.headline(" · ".join(words))
    here = partial(_run_here, batch, state, display)
    for ending in cluster.fan_out(run_scene, _begun(batch, state, display), here, "machine"):
        if batch.cluster is not None:
            display.begin(ending.name)  # several run at a time, which a live line has no room for
        _end(batch, state, ending, display)
    failed = [name for name, scene in state.scenes.items() if scene.state == "failed"]
    done = len(state.scenes) - len(failed)
    text = f"{done} of {len(state.scenes)} scenes are done" + (f"; failed: {', '.join(failed)}" if failed else "")
    display.finished(f"{text} → {batch.folder / PAGE}", {PAGE: batch.folder / PAGE})
    return len(failed)


def _continued(batch: Batch, before: BatchFile) -> BatchFile:
    """How the scenes stand at the start: as they were left, but that failed ones wait, and that a first budget does not
    pay for what was spent before."""
    scenes = dict[str, SceneState]()
    for scene in batch.scenes:
        known, photos = before.scenes.get(scene.name), printable(os.path.abspath(scene.photos))
        if known is None or known.photos != photos:
            scenes[scene.name] = SceneState(photos=photos)
        elif known.state == "failed":
            scenes[scene.name] = SceneState(photos=photos, spent=known.spent)
        else:
            scenes[scene.name] = known
        if before.budget is None and batch.budget is not None:
            scenes[scene.name].spent = 0.0
    return BatchFile(folder=printable(os.path.abspath(batch.of)), budget=batch.budget, scenes=scenes)


def _begun(batch: Batch, state: BatchFile, display: Display) -> Iterator[SceneRun]:
    """Each scene as it begins; those that no time is left for have failed."""
    at_once = cluster.at_once("machine")
    for scene in batch.scenes:
        own = state.scenes[scene.name]
        own.allocated, own.state = state.allocated(scene.name, at_once), "running"
        if own.allocated is not None and own.allocated < MIN_SECONDS:
            what, why = "not begun", "the other scenes have used up the budget"
            hint = "Give the same command with a larger --budget: finished scenes are kept."
            failure = SceneFailure(stage=None, code="pipeline.no-time-left", what=what, why=why, hint=hint)
            own.allocated = None
            display.begin(scene.name)
            _end(batch, state, Ending(scene.name, "", failure, 0.0), display)
            continue
        _write(batch, state)
        limit = () if own.allocated is None else ("--budget", f"{own.allocated:.0f}s")
        photos = str(scene.photos.absolute())  # of `batch .` the name alone might look like an option
        arguments = (photos, *batch.options, *limit, "-o", str(batch.workspace(scene.name)))
        yield SceneRun(scene.name, arguments, batch.log(scene.name), Path.cwd())


def _run_here(
    batch: Batch, state: BatchFile, display: Display, work: object, runs: Iterable[SceneRun]
) -> Iterator[Ending]:
    for run in runs:
        display.begin(run.name)
        began = time.monotonic()
        try:
            ending = run_scene(run, display.update)
        except BaseException:
            state.scenes[run.name].spent += round(time.monotonic() - began, 1)
            _write(batch, state)
            raise
        yield ending


def _end(batch: Batch, state: BatchFile, ending: Ending, display: Display) -> None:
    own = state.scenes[ending.name]
    own.spent = round(own.spent + ending.seconds, 1)
    own.failure, own.state = ending.failure, "failed" if ending.failure else "done"
    if ending.failure:
        display.failed(ending.name, _as_error(ending.failure))
    else:
        own.figures = figures_of(batch.workspace(ending.name))
        own.line = _line(own) or ending.line
        display.end(ending.name, own.line, ending.seconds, cached=False)
    _write(batch, state)


def _write(batch: Batch, state: BatchFile) -> None:
    try:
        batch_file.write(batch.folder, state)
        write_page(batch.folder, state)
    except OSError as error:
        raise _cannot_write(batch, error) from error


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
