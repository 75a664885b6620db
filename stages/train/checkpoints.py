"""Checkpoints of a training run: whole or not there, the last two kept.

A checkpoint is a pair of files, ``<step>.safetensors`` and ``<step>.json``; the second holds the sha256 of the first
and of its own facts and is written last, so a kill at any instant leaves at worst a pair that is not one, and a flipped
bit anywhere in either does not pass.

Before one is kept the field is checked, on training photos alone: has it collapsed or diverged? The full check runs
once after the first steps and at the end. In between the batch PSNR, which costs nothing, tells when it is due:
whenever it is near that of a flat colour.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from safetensors.torch import load, save
from torch import Tensor

from nerf.training.evaluation_pixels import EvaluationPixels, evaluate
from nerf.training.trainer import FieldTrainer
from stages.io.files import write_durably

KEPT = 2
MIN_OPACITY = 1e-3  # a field of less mean opacity shows nothing but background
FULL_CHECK_MARGIN_DB = 3.0  # above a flat colour: batches that are no better may come from a collapsed field


class TrainingFailure(Exception):
    """The field in training has collapsed or diverged, for the reason given. Training rolls back or restarts."""


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


# --- the health check


def failure_reason(trainer: FieldTrainer, pixels: EvaluationPixels) -> str | None:
    """Why the field, as the training photos see it, has collapsed or diverged; None if it has not."""
    if name := non_finite_tensor(trainer):
        return f"its {name} is not finite"
    try:
        rendered = evaluate(trainer.model, pixels, trainer.effects)
    except ValueError as error:  # the PSNR is not finite
        return f"its rendering is not finite: {error}"
    if not rendered.opacity >= MIN_OPACITY:  # nor is NaN
        return f"it is empty (mean opacity {rendered.opacity:.0e})"
    if not rendered.psnr > pixels.mean_colour_psnr:
        return f"it is no better than a flat colour ({rendered.psnr:.1f} of {pixels.mean_colour_psnr:.1f} dB)"
    return None


def needs_full_check(batch_psnr: float, pixels: EvaluationPixels) -> bool:
    """Whether batches as bad as this call for :func:`failure_reason`."""
    return not batch_psnr > pixels.mean_colour_psnr + FULL_CHECK_MARGIN_DB


def non_finite_tensor(trainer: FieldTrainer) -> str | None:
    """The name of a state tensor that is not finite, which the update after a finite loss can cause; None if there is
    none."""
    state = trainer.state().items()
    return next((name for name, one in state if one.is_floating_point() and not bool(one.isfinite().all())), None)
