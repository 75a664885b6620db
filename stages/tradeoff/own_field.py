"""The field that a workspace has already, as one more point of a study: scored like every other, trained for nothing.

It answers whether the run that there is could have been had for less. Its training seconds are those that it took, so
they are of this machine only where it was trained here.
"""

from pathlib import Path
from typing import Any, NamedTuple

from stages.contract import Inputs, Progress
from stages.io.files import read_json, write_json_durably
from stages.tradeoff.pareto_front import Point
from stages.tradeoff.runs import OWN, scored_every
from stages.tradeoff.trial import Exam, drawing_seconds, kept, score


class Own(NamedTuple):
    """The field's point; of ``every`` so many pixels of the windows, along both axes, it was scored on one; ``key`` is
    the name of its training's folder."""

    point: Point
    every: int
    key: str


def own_field(exam: Exam, inputs: Inputs, folder: Path, seconds: float, progress: Progress) -> Own | None:
    """Score what stage train left, or read the score of an earlier attempt; None where it has left nothing. It may be
    the published networks, which are slow to draw: a trial tells on how many pixels a study of ``seconds`` can score
    it."""
    train = inputs.get("train")
    if train is None:
        return None
    key, facts = train.resolve().name, read_json(train / "manifest.json")["facts"]
    file = folder / f"own_{key}.json"
    if (found := kept(file)) is None:
        progress.update(f"scoring {OWN}")
        every = scored_every(drawing_seconds(train, exam), seconds)
        found = {"every": every, "figures": score(train, exam, progress, every)}
        write_json_durably(file, found)
    return Own(_point(facts, found["figures"]), found["every"], key)


def _point(facts: dict[str, Any], figures: dict[str, Any]) -> Point:
    taken = {name: facts[name] for name in ("downscale", "steps", "train_seconds", "field")}
    alone: dict[str, Any] = {"seeds": 1, "deviation": None, "ssim_deviation": None, "peak_memory_mb": None}
    return Point(variant=OWN, **alone, **taken, **figures)
