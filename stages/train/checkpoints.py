"""Checkpoints of a training run: whole or not there, the last two kept.

A checkpoint is a pair of files, ``<step>.safetensors`` and ``<step>.json``; the second holds the sha256 of the first
and of its own facts and is written last, so a kill at any instant leaves at worst a pair that is not one, and a flipped
bit anywhere in either does not pass.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from safetensors.torch import load, save
from torch import Tensor

from stages.io.files import write_durably
from stages.train.health_check import TrainingFailure

KEPT = 2


class Checkpoint(NamedTuple):
    """A training state: its tensors, and the rest of the run state as JSON values."""

    step: int
    tensors: dict[str, Tensor]
    facts: dict[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write ``checkpoint`` and remove all but the last KEPT."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = save({name: tensor.contiguous() for name, tensor in checkpoint.tensors.items()})
    name = f"{checkpoint.step:09d}"
    meta = {"facts": checkpoint.facts, "sha256": _digest(name, checkpoint.facts, tensors)}
    write_durably(folder / f"{name}.safetensors", tensors)
    write_durably(folder / f"{name}.json", json.dumps(meta, allow_nan=False).encode())
    kept = {f"{step:09d}" for step in _steps(folder)[-KEPT:]}
    for path in folder.iterdir():  # older pairs, and what a kill left of unfinished ones
        if path.name.split(".")[0] not in kept:
            path.unlink()


def latest_checkpoint(
    folder: Path,
    note: Callable[[str, str], None],
    fits: Callable[[Checkpoint], None] = lambda _: None,
    remove: bool = True,
) -> Checkpoint | None:
    """The newest good checkpoint, or None. Newer ones that are damaged are named to ``note``, and removed unless the
    folder is a finished run's (``remove``).

    ``fits`` raises RuntimeError or TypeError for an intact checkpoint of something else, TrainingFailure for one of a
    field that has collapsed or diverged.
    """
    for step in reversed(_steps(folder)):
        try:
            checkpoint = _read(folder, step)
            fits(checkpoint)
            return checkpoint
        except (OSError, ValueError, KeyError) as error:
            problem = f"is damaged ({error})"
        except TrainingFailure as error:
            problem = f"holds a failed field ({error})"
        except (RuntimeError, TypeError) as error:
            problem = f"belongs to another training ({' '.join(str(error).split())})"
        note("train.checkpoint-skipped", f"the checkpoint of step {step} {problem}; using the one before")
        if remove:
            (folder / f"{step:09d}.json").unlink()
            (folder / f"{step:09d}.safetensors").unlink(missing_ok=True)
    return None


def checkpoint_files(folder: Path, step: int) -> list[str]:
    """The two files of the checkpoint of ``step``, relative to the folder that holds ``folder``."""
    return [f"{folder.name}/{step:09d}.{suffix}" for suffix in ("safetensors", "json")]


def _steps(folder: Path) -> list[int]:
    return sorted(int(path.stem) for path in folder.glob("*.json") if path.stem.isdigit())


def _digest(name: str, facts: dict[str, Any], tensors: bytes) -> str:
    digest = hashlib.sha256(tensors)
    digest.update(json.dumps([name, facts], sort_keys=True).encode())
    return digest.hexdigest()


def _read(folder: Path, step: int) -> Checkpoint:
    meta = json.loads((folder / f"{step:09d}.json").read_bytes())
    tensors = (folder / f"{step:09d}.safetensors").read_bytes()
    if _digest(f"{step:09d}", meta["facts"], tensors) != meta["sha256"]:
        raise ValueError("its content does not match its sha256")
    return Checkpoint(step, load(tensors), meta["facts"])
