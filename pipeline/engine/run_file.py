"""run.json: the options of the last run, what was chosen for its stages, the key of each stage, and the budget."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.engine import manifest_file
from pipeline.schedule.budget import Account
from stages.contract import StageError
from stages.io.files import first_fault, write_durably

NAME = "run.json"
VERSION = 2
PATHS = {  # options that are paths
    "ingest": ("photos", "cameras", "photo_list"),
    "sfm": ("photos", "cameras"),
    "render": ("cameras",),
}

Options = dict[str, dict[str, Any]]


class RunFile(BaseModel):
    """Of each stage its options, what was chosen for it by what was asked, and its key. Paths in its options are
    absolute here, and where they lie in the workspace relative to it in the file, so that they go with it."""

    model_config = ConfigDict(extra="forbid")

    version: int = VERSION
    options: Options = {}
    plans: dict[str, dict[str, dict[str, Any]]] = {}
    keys: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = {}
    stages: list[str] | None = None
    photos_digest: str | None = None
    budget: Account | None = None


def read(root: Path) -> RunFile:
    """run.json of the workspace ``root``; an empty run for a new one. Raises StageError where it cannot be used."""
    try:
        value = json.loads((root / NAME).read_text("utf-8"))
        if manifest_file.SEAL in value:  # one that a user has edited may do without
            value = manifest_file.unsealed(value)
        if value["version"] == VERSION:
            run = RunFile.model_validate(value, strict=True)
            run.options = _with_paths(run.options, lambda path: str(root.absolute() / path))
            return run
        reason = f"it has version {value['version']}, this program reads {VERSION}"
    except FileNotFoundError:
        return RunFile()
    except ValidationError as error:
        reason = first_fault(error)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = f"it cannot be used ({error})"
    hint = f"Delete {root / NAME} and repeat the same `pipeline run`: finished stages are kept."
    raise StageError("pipeline.run-file", f"cannot read {root / NAME}", reason, hint)


def write(root: Path, run: RunFile) -> None:
    """Write run.json durably. Raises OSError."""
    value = run.model_dump(mode="json") | {"options": portable(run.options, root)}
    text = json.dumps(manifest_file.sealed(value), indent=1, sort_keys=True, allow_nan=False)
    write_durably(root / NAME, (text + "\n").encode())


def portable(options: Options, root: Path) -> Options:
    """Options by stage, with paths that lie in the workspace ``root`` relative to it."""

    def relative(path: str) -> str:
        for real in (os.path.abspath, os.path.realpath):
            if (place := Path(real(path))).is_relative_to(base := real(root)):
                return place.relative_to(base).as_posix()
        return path

    return _with_paths(options, relative)


def _with_paths(options: Mapping[str, dict[str, Any]], change: Callable[[str], str]) -> Options:
    """Options by stage, with their paths changed."""
    return {
        stage: values
        | {name: change(path) for name in PATHS.get(stage, ()) if isinstance(path := values.get(name), str)}
        for stage, values in options.items()
    }
