"""SIGKILL during every stage, then the same command again: the result equals that of a run nobody disturbed."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.chain import usual
from tests.small_scenes import write_blender_scene
from tests.synthetic_photos import SyntheticPhotos

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
    for stage in usual():
        process = subprocess.Popen(command(photos, tmp_path / "w.nerf"), stdout=subprocess.PIPE, text=True)
        struck += kill_in(stage, process, instants.uniform(0.0, 0.2))
        assert process.returncode == -signal.SIGKILL or stage == "report"
    assert struck >= len(usual()) // 2, "most kills must land inside their stage"
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


def videos_plan(workspace: Path) -> dict[str, object]:
    """What was chosen for stage render."""
    plans = json.loads((workspace / "run.json").read_text())["plans"]["render"].values()
    return next(plan for plan in plans if plan["depth"] is False)


def test_a_killed_video_goes_on_with_the_size_that_was_chosen_for_it(
    undisturbed: tuple[Path, dict[str, str]], tmp_path: Path
):
    workspace = tmp_path / "w.nerf"
    shutil.copytree(undisturbed[0].parent / "w.nerf", workspace, symlinks=True)
    open_again = "--render.frames None --render.width None --render.no-depth --json".split()
    words = [sys.executable, "-m", "pipeline", "render", str(workspace), *open_again]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert kill_in("render", process, 0.0)
    chosen = videos_plan(workspace)
    answer = subprocess.run([*words[:5], "--json"], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert videos_plan(workspace) == chosen
    path = json.loads((workspace / "output/path.json").read_text())
    assert (len(path["frames"]), path["w"], path["fps"]) == (chosen["frames"], chosen["width"], chosen["fps"])


# What is said when sfm reaches the instants to be killed at: finding features, matching, and matching once more.
SFM_INSTANTS = ("features of", "matched", "has no place yet: matching them again", "adjusting all cameras")


@pytest.fixture
def photos_and_a_stranger(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> Path:
    """Seven photos that overlap and one of something else, which only a second, less strict matching can look for."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for photo in sorted(synthetic_photos.folder.iterdir())[:7]:
        shutil.copyfile(photo, folder / photo.name)
    coarse = np.random.default_rng(0).integers(0, 256, (45, 60, 3), np.uint8)
    Image.fromarray(coarse).resize((240, 180), Image.Resampling.BICUBIC).save(folder / "stranger.png")
    return folder


def kill_when_said(words: str, process: subprocess.Popen, delay: float) -> bool:
    """Kill the process ``delay`` seconds after it said ``words``; False if it never did or had finished by then."""
    assert process.stdout is not None
    said = any(words in json.loads(line).get("message", "") for line in process.stdout)
    time.sleep(delay)
    process.kill()
    rest = process.communicate()[0]
    return said and '"event": "finished"' not in rest


def test_killed_while_photos_are_matched(photos_and_a_stranger: Path, tmp_path: Path):
    def sfm(name: str) -> list[str]:
        few = "--until sfm --sfm.max-features 800 --json".split()
        return [sys.executable, "-m", "pipeline", "run", str(photos_and_a_stranger), "-o", str(tmp_path / name), *few]

    answer = subprocess.run(sfm("undisturbed.nerf"), capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert SFM_INSTANTS[2] in answer.stdout
    instants = random.Random(3)
    for words in SFM_INSTANTS:
        process = subprocess.Popen(sfm("killed.nerf"), stdout=subprocess.PIPE, text=True)
        assert kill_when_said(words, process, instants.uniform(0.0, 0.1)), f"no kill at: {words}"
        assert process.returncode == -signal.SIGKILL
    answer = subprocess.run(sfm("killed.nerf"), capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "going on with the features of 8 photos" in answer.stdout
    assert digests(tmp_path / "killed.nerf") == digests(tmp_path / "undisturbed.nerf")
