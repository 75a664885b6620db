"""Three tiny stages for testing the runner: a number is written, doubled, and doubled again with an offset."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from stages.contract import Inputs, Progress, Stage, StageConfig, StageError, StageResult
from stages.io.files import read_json, write_json

calls: list[str] = []


class IngestConfig(StageConfig):
    photos: Path = Path()
    cameras: Path | None = None
    photo_list: Path | None = None
    number: int = 1


class SfmConfig(StageConfig):
    offset: int | None = None
    fail: bool = False


class TrainConfig(StageConfig):
    steps: int = 3
    die_at: int | None = None


def _run_ingest(config: IngestConfig, inputs: Inputs, folder: Path, progress: Any) -> StageResult:
    calls.append("ingest")
    write_json(
        folder / "number.json", config.number // 10
    )  # numbers that differ only in the last digit give equal bytes
    (folder / "leftover.tmp").write_text("undeclared")
    return StageResult(outputs=("number.json",), line=f"number {config.number}")


def _plan_sfm(config: SfmConfig, inputs: Inputs, progress: Progress) -> SfmConfig:
    calls.append("plan sfm")
    return config if config.offset is not None else config.model_copy(update={"offset": 5})


def _run_sfm(config: SfmConfig, inputs: Inputs, folder: Path, progress: Any) -> StageResult:
    calls.append("sfm")
    if config.fail:
        raise StageError("sfm.fake", "it failed", "it was told to", "Do not tell it to.")
    (folder / "deep").mkdir()
    write_json(folder / "deep" / "number.json", 2 * read_json(inputs["ingest"] / "number.json") + (config.offset or 0))
    (folder / "log.txt").write_text("a record")
    return StageResult(outputs=("deep",), records=("log.txt",), line="doubled", facts={"offset": config.offset})


def _run_train(config: TrainConfig, inputs: Inputs, folder: Path, progress: Any) -> StageResult:
    calls.append("train")
    checkpoint = folder / "checkpoint.json"
    start = read_json(checkpoint) if checkpoint.exists() else 0
    for step in range(start, config.steps):
        if step == config.die_at and start == 0:
            raise KeyboardInterrupt
        write_json(checkpoint, step + 1)
    write_json(folder / "result.json", {"steps": config.steps})
    return StageResult(outputs=("result.json",), line=f"{config.steps - start} steps taken")


STAGES: dict[str, Stage] = {
    "ingest": Stage(
        name="ingest",
        inputs=(),
        version=1,
        exit_code=10,
        published=(),
        config=IngestConfig,
        run=_run_ingest,
    ),
    "sfm": Stage(
        name="sfm",
        inputs=("ingest",),
        version=1,
        exit_code=11,
        published=("deep", "log.txt"),
        config=SfmConfig,
        plan=_plan_sfm,
        run=_run_sfm,
    ),
    "train": Stage(
        name="train",
        inputs=("sfm",),
        version=1,
        exit_code=14,
        resumes=True,
        published=("result.json",),
        config=TrainConfig,
        run=_run_train,
    ),
}


def declare(monkeypatch: pytest.MonkeyPatch, stage: str, **declarations: Any) -> None:
    """Let ``stage`` declare something else."""
    monkeypatch.setitem(STAGES, stage, replace(STAGES[stage], **declarations))


class FakeSettings(BaseModel):
    """Settings of the three stages."""

    ingest: IngestConfig = IngestConfig()
    sfm: SfmConfig = SfmConfig()
    train: TrainConfig = TrainConfig()
