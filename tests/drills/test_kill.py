"""SIGKILL during every stage, then the same command again: the result equals that of a run nobody disturbed."""

import json
import os
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerf.fields.interface import Rendering
from pipeline.engine.manifest_file import Manifest
from pipeline.engine.stage_list import usual
from pipeline.engine.workspace import Workspace
from stages.render import video
from stages.sfm import worker_process
from stages.sfm.worker_process import FIRST_STRATEGY, PHASES, REFINING
from tests.drills.campaigns import RETRY, SFM_INSTANTS, Chain, reached
from tests.drills.drill import Prepare, Program, copy_workspace, results
from tests.synthetic_photos import SyntheticPhotos

FEATURES_FOUND = FIRST_STRATEGY * sum(PHASES["features"])  # how far stage sfm is once every photo's features are kept


def begun(stage: str, events: list[dict[str, Any]]) -> bool:
    """Whether ``stage`` has begun."""
    return any(e["event"] == "begin" and e["stage"] == stage for e in events)


def at_work(stage: str, events: list[dict[str, Any]]) -> bool:
    """Whether ``stage`` has said that it has done something. One that takes a tenth of a second never does."""
    return any(e["event"] == "progress" and e["stage"] == stage and e["done"] for e in events)


def kill_in(stage: str, program: Program, delay: float, there: Callable = begun) -> bool:
    """Kill it ``delay`` seconds after ``stage`` was ``there``; False if it had ended the stage by then."""
    program.wait_until(partial(there, stage))
    program.process.join(delay)
    program.strike(signal.SIGKILL)
    return not any(event["event"] == "end" and event["stage"] == stage for event in program.events())


def test_killed_in_every_stage(chain: Chain, tmp_path: Path):
    instants = random.Random(7)
    workspace, struck = tmp_path / "w.nerf", 0
    for stage in usual():
        there = at_work if stage == "train" else begun
        struck += kill_in(stage, chain.start(workspace), instants.uniform(0.0, 0.1), there)
    assert struck >= len(usual()) // 2, "most kills must land inside their stage"
    assert chain.lost(workspace) == []


def test_a_second_run_does_nothing_and_soon(chain: Chain):
    program = chain.start(chain.workspace).finish()
    assert all(event["cached"] for event in program.events() if event["event"] == "end")
    assert program.events()[-1]["message"].startswith("nothing to do")


def test_another_mesh_resolution_runs_mesh_viewer_and_report(chain: Chain, tmp_path: Path):
    program = chain.start(copy_workspace(chain.workspace, tmp_path / "w.nerf"), "--mesh.resolution", "20").finish()
    ran = [event["stage"] for event in program.events() if event["event"] == "end" and not event["cached"]]
    assert ran == ["mesh", "viewer", "report"]


def videos_plan(workspace: Path) -> dict[str, Any]:
    """What was chosen for stage render."""
    plans = json.loads((workspace / "run.json").read_text())["plans"]["render"].values()
    return next(plan for plan in plans if plan["depth"] is False)


def die_after_a_frame() -> None:
    """In the program: it is killed when the first frame of the video is rendered."""
    render_path = video.render_path

    def die(*arguments: Any) -> Iterator[Rendering]:
        yield next(render_path(*arguments))
        os.kill(os.getpid(), signal.SIGKILL)

    video.render_path = die


def test_a_killed_video_resumes_at_the_chosen_size(chain: Chain, tmp_path: Path):
    workspace = copy_workspace(chain.workspace, tmp_path / "w.nerf")
    open_again = "--render.frames None --render.width None --render.no-depth".split()
    struck = Program(["render", str(workspace), "--json", *open_again], tmp_path / "says", die_after_a_frame)
    assert struck.wait() == -signal.SIGKILL
    chosen = videos_plan(workspace)
    Program(["render", str(workspace), "--json"], tmp_path / "says").finish()
    assert videos_plan(workspace) == chosen
    path = json.loads((workspace / "output/path.json").read_text())
    assert (len(path["frames"]), path["w"], path["fps"]) == (chosen["frames"], chosen["width"], chosen["fps"])


@pytest.fixture
def photos_and_a_stranger(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> Path:
    """Seven photos that overlap and one of something else, which only a retry can look for."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for photo in sorted(synthetic_photos.folder.iterdir())[:7]:
        shutil.copyfile(photo, folder / photo.name)
    coarse = np.random.default_rng(0).integers(0, 256, (45, 60, 3), np.uint8)
    Image.fromarray(coarse).resize((240, 180), Image.Resampling.BICUBIC).save(folder / "stranger.png")
    return folder


ADJUSTING = (
    "import time, stages.sfm.worker as worker\n"
    "worker.final_bundle_adjustment = lambda *_: time.sleep(600)\n"
    "worker.main()"
)


def adjust_for_minutes() -> None:
    """In the program: no machine is done with the final bundle adjustment before the kill."""
    worker_process.COMMAND = ["-c", ADJUSTING]


def die_before_the_manifest() -> None:
    """In the program: it is killed with all results of a stage written, and no manifest."""

    def die(self: Workspace, partial: Path, folder: Path, manifest: Manifest) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    Workspace.finish = die


def test_killed_while_photos_are_matched(photos_and_a_stranger: Path, tmp_path: Path):
    def sfm(name: str, prepare: Prepare = None) -> Program:
        words = ["run", str(photos_and_a_stranger), "-o", str(tmp_path / name), "--json", "--until", "sfm"]
        return Program([*words, "--sfm.max-features", "800"], tmp_path / "says", prepare)

    assert reached(RETRY.name, sfm("undisturbed.nerf").finish().events())
    delays = random.Random(3)
    for instant in SFM_INSTANTS:
        program = sfm("killed.nerf", adjust_for_minutes)
        assert program.wait_until(partial(reached, instant)), f"no kill at: {instant}"
        program.process.join(delays.uniform(0.0, 0.1))
        program.strike(signal.SIGKILL)
        assert program.wait() == -signal.SIGKILL
    for prepare, ending in ((die_before_the_manifest, -signal.SIGKILL), (None, 0)):
        program = sfm("killed.nerf", prepare)
        assert program.wait() == ending
        events = program.events()
        done = {event["done"] for event in events if event["event"] == "progress" and event["stage"] == "sfm"}
        assert done <= {None, FEATURES_FOUND, REFINING}, "only the final bundle adjustment was left to do"
        assert not reached("matching", events) and not reached(RETRY.name, events)
    assert results(tmp_path / "killed.nerf") == results(tmp_path / "undisturbed.nerf")
