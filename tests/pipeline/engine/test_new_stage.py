"""A new stage is its package and one line in the list of stages: everything else follows from what it declares."""

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from pipeline.engine.stage_list import STAGES
from pipeline.schedule.budget import allocated_seconds
from stages.io.files import read_json
from tests.pipeline.engine import new_stage

ROOT = Path(__file__).parents[3]
WITH_IT = """
import sys
from pipeline.engine import stage_list
from tests.pipeline.engine import new_stage
stage_list.STAGES["count"] = new_stage.STAGE
from pipeline.cli.commands import run_command
sys.exit(run_command(sys.argv[1:]))
"""


def pipeline(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITH_IT, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    (folder / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 64), 50 + 50 * k).convert("RGB").save(folder / "photos" / f"{k}.png")
    done = pipeline("run", folder / "photos", "-o", folder / "w.nerf", "--until", "ingest")
    assert done.returncode == 0, done.stderr
    return folder / "w.nerf"


def test_it_has_a_command_options_output_and_status(workspace: Path):
    done = pipeline("count", workspace, "--count.most", 2)
    assert done.returncode == 0 and "2 photos" in done.stdout, done.stderr
    assert read_json(workspace / "output/count.json") == 2
    assert "count      cached   2 photos" in pipeline("status", workspace).stdout
    assert "count" in pipeline("--help").stdout


def test_its_errors_have_its_exit_code(workspace: Path):
    failed = pipeline("count", workspace, "--count.most", 0)
    assert failed.returncode == 42 and "count failed: nothing is counted" in failed.stderr


def test_it_has_its_part_of_a_budget():
    stages = STAGES | {"count": new_stage.STAGE}
    alone = allocated_seconds(stages, "count", 60.0, {}, 300.0, 0.0)
    beside = allocated_seconds(stages, "count", 60.0, {"mesh": None}, 300.0, 0.0)
    assert alone == 60.0 and 1.0 < beside < alone
