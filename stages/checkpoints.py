"""Checkpoints of a training run: whole or not there, the last two kept.

A checkpoint is a pair of files, ``<step>.safetensors`` and ``<step>.json``; the second names the first's sha256
and is written last, so a kill at any instant leaves at worst a pair that is not one.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.files import write_durably

if TYPE_CHECKING:
    from torch import Tensor

KEPT = 2


class Checkpoint(NamedTuple):
    """A training state: tensors, and whatever else the run must know to go on, as JSON values."""

    step: int
    tensors: "dict[str, Tensor]"
    facts: dict[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write ``checkpoint`` and forget all but the last KEPT."""
    from safetensors.torch import save

    folder.mkdir(parents=True, exist_ok=True)
    tensors = save({name: tensor.contiguous() for name, tensor in checkpoint.tensors.items()})
    meta = {"facts": checkpoint.facts, "sha256": hashlib.sha256(tensors).hexdigest()}
    name = f"{checkpoint.step:09d}"
    write_durably(folder / f"{name}.safetensors", tensors)
    write_durably(folder / f"{name}.json", json.dumps(meta, allow_nan=False).encode())
    kept = {f"{step:09d}" for step in _steps(folder)[-KEPT:]}
    for path in folder.iterdir():  # older pairs, and what a kill left of unfinished ones
        if path.name.split(".")[0] not in kept:
            path.unlink()


def latest_checkpoint(folder: Path, note: Callable[[str], None]) -> Checkpoint | None:
    """The newest good checkpoint, or None; every damaged one met on the way is removed and named to ``note``."""
    for step in reversed(_steps(folder)):
        try:
            return _read(folder, step)
        except (OSError, ValueError, KeyError) as fault:
            note(f"the checkpoint of step {step} is damaged ({fault}); going back to the one before")
            (folder / f"{step:09d}.json").unlink()
            (folder / f"{step:09d}.safetensors").unlink(missing_ok=True)
    return None


def checkpoint_files(folder: Path, step: int) -> list[str]:
    """The two files of the checkpoint of ``step``, relative to the folder that holds ``folder``."""
    return [f"{folder.name}/{step:09d}.{suffix}" for suffix in ("safetensors", "json")]


def _steps(folder: Path) -> list[int]:
    return sorted(int(path.stem) for path in folder.glob("*.json") if path.stem.isdigit())


def _read(folder: Path, step: int) -> Checkpoint:
    from safetensors.torch import load

    meta = json.loads((folder / f"{step:09d}.json").read_bytes())
    tensors = (folder / f"{step:09d}.safetensors").read_bytes()
    if hashlib.sha256(tensors).hexdigest() != meta["sha256"]:
        raise ValueError("its tensors are not those that were written")
    return Checkpoint(step, load(tensors), meta["facts"])
