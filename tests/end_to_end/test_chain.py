"""The whole chain as a user runs it, on photos small enough for seconds: every promised file is there and sound."""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipeline.cli.commands import run_command
from pipeline.engine.stage_list import STAGES
from stages.contract import Stage, StageConfig, plan_stage
from tests.small_scenes import write_blender_scene
from tests.test_vocabulary import RETIRED, offenders
from tests.video_files import read_video

SUMMARY_KEYS = {
    "photos", "registered", "camera_model", "reprojection_px", "field", "train_seconds", "total_seconds", "psnr",
    "ssim", "psnr_mean_image", "psnr_nearest_view", "mesh", "verdict",
}  # fmt: skip
SMALL = "--train.steps 150 --train.downscale 1 --render.frames 4 --render.width 48 --mesh.resolution 40".split()


@pytest.fixture(scope="module")
def planned() -> Iterator[Counter[str]]:
    """How often each stage was planned."""
    calls = Counter[str]()

    def counted(stage: Stage) -> Stage:
        def plan(*given: Any) -> StageConfig:
            calls.update([stage.name])
            return plan_stage(stage, *given)

        return stage if stage.plan is None else replace(stage, plan=plan)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.engine.runner.STAGES", {name: counted(stage) for name, stage in STAGES.items()})
        yield calls


@pytest.fixture(scope="module")
def output(planned: Counter[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a run on a small set with known cameras."""
    folder = tmp_path_factory.mktemp("chain")
    photos = write_blender_scene(folder / "photos", train=14, test=3)
    with redirect_stdout(StringIO()) as said:
        assert run_command(["run", str(photos), "-o", str(folder / "w.nerf"), *SMALL]) == 0
        assert run_command(["status", str(folder / "w.nerf")]) == 0
    (folder / "said.txt").write_text(said.getvalue(), "utf-8")
    return folder / "w.nerf/output"


def test_every_stage_is_planned_once(output: Path, planned: Counter[str]):
    assert planned == dict.fromkeys(["sfm", "effects", "train", "evaluate", "render", "mesh"], 1)
    assert run_command(["resume", str(output.parent)]) == 0
    assert set(planned.values()) == {1}


def written(workspace: Path) -> dict[str, str]:
    """Path and text of everything that a run wrote in words, without the pictures in its page."""
    kinds = (".json", ".jsonl", ".html", ".log")
    files = [file for file in sorted(workspace.rglob("*")) if file.suffix in kinds]
    texts = {file.relative_to(workspace).as_posix(): file.read_text("utf-8", "replace") for file in files}
    return {name: re.sub(r"data:[\w/+;=,-]+", "", text) for name, text in texts.items()}


def test_no_retired_word_is_written_or_said(output: Path):
    texts = written(output.parent) | {"said": (output.parent.parent / "said.txt").read_text("utf-8")}
    assert {"run.json", "output/report.html", "output/summary.json"} <= texts.keys()
    assert "ingest" in texts["said"] and "cached" in texts["said"]
    assert {old: places for old in RETIRED if (places := offenders(old, texts))} == {}


def numbers_in(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [n for v in value.values() for n in numbers_in(v)]
    if isinstance(value, list):
        return [n for v in value for n in numbers_in(v)]
    return [value] if isinstance(value, float) else []


def test_the_summary_has_every_key_and_only_finite_numbers(output: Path):
    summary = json.loads((output / "summary.json").read_text())
    assert set(summary) >= SUMMARY_KEYS
    assert set(summary["mesh"]) >= {"vertices", "faces", "watertight"}
    assert all(math.isfinite(n) for n in numbers_in(summary))
    assert (summary["photos"], summary["registered"]) == (17, 17)
    assert summary["psnr"] > summary["psnr_mean_image"] > 5


def test_the_mesh_opens_and_is_not_degenerate(output: Path):
    mesh = trimesh.load_mesh(output / "mesh.ply")
    assert len(mesh.faces) > 500
    assert np.isfinite(mesh.vertices).all()
    # The table has radius 1 about the origin of the sfm frame, which for known cameras is their own.
    assert 0.7 < np.abs(mesh.vertices[:, :2]).max() < 1.6
    scene = trimesh.load_scene(output / "mesh.glb")
    assert sum(len(g.faces) for g in scene.geometry.values()) == len(mesh.faces)


def test_the_videos_hold_their_frames(output: Path):
    for name in ("video.mp4", "depth.mp4"):
        frames, _ = read_video(output / name)
        assert frames.shape[0] == 4
        assert frames.shape[2] == 48
        assert frames.std() > 1, f"{name} shows nothing"


def test_the_report_stands_alone(output: Path):
    page = (output / "report.html").read_text()
    assert "<video" in page and "data:image/" in page
    assert 'src="http' not in page and 'href="http' not in page


def test_cameras_are_exported(output: Path):
    exported = json.loads((output / "transforms.json").read_text())
    assert len(exported["frames"]) == 17
    assert all((output / frame["file_path"]).is_file() for frame in exported["frames"])
    assert (output / "sparse/cameras.bin").is_file()


def test_exported_cameras_go_in_again(output: Path, tmp_path: Path):
    photos = output.parents[1] / "photos"
    words = ["run", str(photos), "--cameras", str(output / "transforms.json"), "-o", str(tmp_path / "again.nerf")]
    assert run_command([*words, "--until", "normalise"]) == 0
    again = json.loads((tmp_path / "again.nerf/output/transforms.json").read_text())
    first = json.loads((output / "transforms.json").read_text())
    poses = {f["file_path"]: np.array(f["transform_matrix"]) for f in first["frames"]}
    for frame in again["frames"]:
        np.testing.assert_allclose(frame["transform_matrix"], poses[frame["file_path"]], atol=1e-9)
