"""The field that a workspace has already, as one more point of a study: scored like every other, trained for nothing.

It answers whether the run that there is could have been had for less. Its training seconds are those that it took, so
they are of this machine only where it was trained here.
"""

from pathlib import Path
from typing import Any

from stages.contract import Inputs, Progress
from stages.files import read_json, write_json
from stages.tradeoff_arms import OWN, THINNED
from stages.tradeoff_front import Point
from stages.tradeoff_trial import Exam, score


def own_point(exam: Exam, inputs: Inputs, folder: Path, progress: Progress) -> Point | None:
    """Score what stage train left, or read the score of an earlier attempt; None where it has left nothing. A field of
    the paper's networks is scored on fewer pixels: it may be the published ones, which are slow to draw."""
    train = inputs.get("train")
    if train is None:
        return None
    kept, manifest = folder / f"own_{train.resolve().name}.json", read_json(train / "manifest.json")
    if not kept.exists():
        progress.update(f"scoring {OWN}")
        write_json(kept, score(train, exam, progress, 1 if manifest["facts"]["field"] == "grid" else THINNED))
    return _point(manifest["facts"], read_json(kept))


def _point(facts: dict[str, Any], figures: dict[str, Any]) -> Point:
    taken = {name: facts[name] for name in ("downscale", "steps", "train_seconds", "field")}
    alone: dict[str, Any] = {"seeds": 1, "deviation": None, "ssim_deviation": None, "peak_memory_mb": None}
    return Point(variant=OWN, **alone, **taken, **figures)
