"""batch.json: what a batch was asked for and how each of its scenes stands."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from stages.contract import StageError
from stages.io.files import first_fault, write_durably

NAME = "batch.json"


class SceneFailure(BaseModel):
    """Why a scene ended without a result: the error of its run, and the stage it came from (None: from none)."""

    model_config = ConfigDict(extra="forbid")

    stage: str | None
    code: str
    what: str
    why: str
    hint: str


class SceneState(BaseModel):
    """How one scene stands. ``allocated`` of the batch's budget and ``spent`` by all its runs are seconds; ``line``
    tells the result in short; ``figures`` are those of its summary.json that rank it."""

    model_config = ConfigDict(extra="forbid")

    photos: str
    state: Literal["waiting", "running", "done", "failed"] = "waiting"
    allocated: float | None = None
    spent: float = 0.0
    line: str = ""
    figures: dict[str, float | int | bool | None] = {}
    failure: SceneFailure | None = None


class BatchFile(BaseModel):
    """``folder``: of the scenes; ``budget``: seconds for all of them, None without a limit."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    folder: str = ""
    budget: float | None = None
    scenes: dict[str, SceneState] = {}

    def allocated(self, name: str, at_once: int = 1) -> float | None:
        """Seconds of the budget for a scene, ``at_once`` of which run at a time; None without one.

        Scenes that wait share what the others leave, which may be nothing. One that was interrupted or is done keeps
        what it was given, for with another budget it would choose other settings."""
        if self.budget is None:
            return None
        if (given := self.scenes[name].allocated) is not None:
            return given
        others = self.scenes.values()
        used = sum(max(one.allocated or 0.0, one.spent) if one.state == "running" else one.spent for one in others)
        return (self.budget - used / at_once) * min(1.0, at_once / sum(one.allocated is None for one in others))


def read(folder: Path) -> BatchFile:
    """batch.json of a batch's folder; an empty one where there is none. Raises StageError where it cannot be used."""
    path = folder / NAME
    try:
        return BatchFile.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return BatchFile()
    except ValidationError as error:
        why = first_fault(error)
    except OSError as error:
        why = (error.strerror or str(error)).lower()
    hint = f"Delete it and give the same command: finished scenes are kept. {path}"
    raise StageError("pipeline.batch-file", f"cannot read {path}", why, hint)


def write(folder: Path, batch: BatchFile) -> None:
    """Write batch.json durably. Raises OSError."""
    write_durably(folder / NAME, (batch.model_dump_json(indent=1) + "\n").encode())
