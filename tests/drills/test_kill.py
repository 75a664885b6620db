"""SIGKILL during every stage, then the same command again: the result equals that of a run nobody disturbed."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.chain import STAGES
from tests.small_scenes import write_blender_scene

SMALL = (
    "--train.steps 400 --train.levels 2 --train.log2-rows 10 --train.finest 32 --train.batch-samples 2048"
    " --train.checkpoint-seconds 0.2 --train.downscale 1 --render.frames 24 --render.width 64 --mesh.resolution 64"
).split()
AT_WORK = ("train", "evaluate", "render", "mesh")  # stages that say how far they are: killed in the middle of it


def command(photos: Path, workspace: Path) -> list[str]:
    return [sys.executable, "-m", "pipeline", "run", str(photos), "-o", str(workspace), "--json", *SMALL]


def digests(workspace: Path) -> dict[str, str]:
    """Stage → digest of its outputs."""
    keys = json.loads((workspace / "run.json").read_text())["keys"]
    found = {}
    for stage, key in keys.items():
        manifest = json.loads((workspace / stage / key[:16] / "manifest.json").read_text())
        found[stage] = manifest["outputs_digest"]
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Photos, and the digests of a run from start to end."""
    folder = tmp_path_factory.mktemp("undisturbed")
    photos = write_blender_scene(folder / "photos")
    answer = subprocess.run(command(photos, folder / "w.nerf"), capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return photos, digests(folder / "w.nerf")


def kill_in(stage: str, process: subprocess.Popen, delay: float) -> bool:
    """Kill the process ``delay`` seconds after ``stage`` got to work; False if it had ended the stage by then."""
    assert process.stdout is not None
    for line in process.stdout:
        event = json.loads(line)
        begun = event["event"] == "begin" and stage not in AT_WORK
        if event.get("stage") == stage and (begun or (event["event"] == "progress" and event["done"])):
            break
    time.sleep(delay)
    process.kill()
    rest = process.communicate()[0]
    return not any(json.loads(line)["event"] == "end" for line in rest.splitlines() if line.endswith("}"))


def test_killed_in_every_stage(undisturbed: tuple[Path, dict[str, str]], tmp_path: Path):
    photos, expected = undisturbed
    instants = random.Random(7)
    struck = 0
    for stage in STAGES:
        process = subprocess.Popen(command(photos, tmp_path / "w.nerf"), stdout=subprocess.PIPE, text=True)
        struck += kill_in(stage, process, instants.uniform(0.0, 0.2))
        assert process.returncode == -signal.SIGKILL or stage == "report"
    assert struck >= len(STAGES) // 2, "most kills must land inside their stage"
    answer = subprocess.run(command(photos, tmp_path / "w.nerf"), capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    found = digests(tmp_path / "w.nerf")
    # The report shows how long everything took, so it alone may differ.
    assert found.keys() == expected.keys()
    assert {s: d for s, d in found.items() if s != "report"} == {s: d for s, d in expected.items() if s != "report"}


def test_a_second_run_does_nothing_and_soon(undisturbed: tuple[Path, dict[str, str]]):
    photos, _ = undisturbed
    answer = subprocess.run(command(photos, photos.parent / "w.nerf"), capture_output=True, text=True)
    events = [json.loads(line) for line in answer.stdout.splitlines()]
    assert all(event["cached"] for event in events if event["event"] == "end")
    assert events[-1]["message"].startswith("nothing to do")


def test_another_mesh_resolution_runs_only_mesh_and_report(undisturbed: tuple[Path, dict[str, str]]):
    photos, _ = undisturbed
    words = [*command(photos, photos.parent / "w.nerf")[:-1], "24"]
    answer = subprocess.run(words, capture_output=True, text=True)
    events = [json.loads(line) for line in answer.stdout.splitlines()]
    ran = [event["stage"] for event in events if event["event"] == "end" and not event["cached"]]
    assert ran == ["mesh", "report"]
