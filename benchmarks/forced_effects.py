"""Does any effect forced the other way beat what stage effects decided? Trains real sets with each choice.

    python -m benchmarks.forced_effects ../shared/data fox fern --workspaces /tmp/forced [--seeds 0 1 2] [--steps 800]

For every set: `pipeline run SET --until effects`, then for every seed a training with what was decided and one more for
each modelled effect, decided the other way round, the rest as it was; all with as many steps, scored on all held-out
photos at the size that the first of them trained (what is forced may change what stage train makes of the photos). A
line is a choice forced, and what the decision gains over it: the mean over seeds of the differences, ± two standard
errors. "raw": nothing fitted; "fitted": right halves with the exposure fitted on the left ones; "posed": with the pose
fitted there, too, which is what pose refinement is judged by. Bold: forced, it is better by more than 0.3 dB beyond two
standard errors, so the decision was wrong. Nothing is timed, so two of them can run side by side. What is in
FOLDER/SET.json already is not trained again.
"""

import argparse
import json
import math
import shutil
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from benchmarks.nerfacto import pipeline, stage_folder
from benchmarks.record import Record, add_out
from stages.io.files import read_json

EFFECTS = ("exposure", "view_dependence", "background", "pose_refinement", "vignetting")
FIGURES = {"raw": "psnr", "fitted": "psnr_exposure_fitted", "posed": "psnr_pose_fitted"}
JUDGED_BY = {"pose_refinement": "posed"}  # the others: raw
TOLERATED = 0.3  # dB
Scores = dict[str, dict[str, float | None]]
"""By the effect that is forced, "" for none, and the seed: the figures."""


def decided(photos: Path, workspace: Path) -> dict[str, bool]:
    """Which of the modelled effects stage effects has on."""
    if not (workspace / "output" / "effects.json").exists():
        pipeline("run", photos, "-o", workspace, "--until", "effects")
    table = read_json(stage_folder(workspace, "effects.json") / "effects.json")
    return {name: table[name]["on"] for name in EFFECTS}


def scored(
    workspace: Path, effects: dict[str, bool], seed: int, steps: int, downscale: float | None
) -> tuple[dict[str, float | None], float]:
    """The figures of a training with these effects at photos / ``downscale``, None for the size that it trained, and
    which that was; its field is removed again."""
    choices = [f"--effect={name}={'on' if on else 'off'}" for name, on in effects.items()]
    pipeline("effects", workspace, *choices)
    pipeline("train", workspace, "--train.steps", str(steps), "--train.seed", str(seed))
    trained = read_json(stage_folder(workspace, "curve.json") / "field.json")["downscale"]
    size = ("--evaluate.downscale", str(downscale or trained))
    pipeline("evaluate", workspace, "--evaluate.fraction", "1", "--evaluate.fit-poses", "on", *size)
    metrics = read_json(stage_folder(workspace, "metrics.json") / "metrics.json")
    for output in ("metrics.json", "curve.json"):
        shutil.rmtree(stage_folder(workspace, output))
    return {name: metrics[key] for name, key in FIGURES.items()}, trained


def gain(scores: Scores, forced: str, figure: str, seeds: list[int]) -> tuple[float, float] | None:
    """What the decision gains over a forced choice, and two standard errors; None where it has no such figure."""
    pairs = [(scores[f" {seed}"][figure], scores[f"{forced} {seed}"][figure]) for seed in seeds]
    gains = [kept - other for kept, other in pairs if kept is not None and other is not None]
    if len(gains) < len(seeds):
        return None
    return mean(gains), 2 * stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf


def cells(forced: str, on: bool, scores: Scores, seeds: list[int]) -> dict[str, str]:
    """What the table says of one effect."""
    told = {}
    for figure in FIGURES:
        found = gain(scores, forced, figure, seeds)
        words = "" if found is None else f"{'off' if on else 'on'} {found[0]:+.2f} ± {found[1]:.2f}"
        wrong = found is not None and figure == JUDGED_BY.get(forced, "raw") and found[0] + found[1] < -TOLERATED
        told[forced if figure == "raw" else f"{forced}_{figure}"] = f"**{words}**" if wrong else words
    return told


def main() -> None:
    """Train what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the folder of the sets")
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--workspaces", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS), help="those that are forced")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for name in given.sets:
        workspace, scores = given.workspaces / f"{name}.nerf", given.workspaces / f"{name}.json"
        made: dict[str, Any] = json.loads(scores.read_text()) if scores.exists() else {"scores": {}}
        if "decided" not in made:
            made["decided"] = decided(given.data / name, workspace)
        for seed in given.seeds:
            for forced in ("", *given.effects):
                effects = {effect: on != (effect == forced) for effect, on in made["decided"].items()}
                if f"{forced} {seed}" not in made["scores"]:
                    found, trained = scored(workspace, effects, seed, given.steps, made.get("downscale"))
                    made["scores"][f"{forced} {seed}"] = found
                    made.setdefault("downscale", trained)
                    scores.write_text(json.dumps(made, indent=1))
        raw = [made["scores"][f" {seed}"]["raw"] for seed in given.seeds]
        told = {"set": name, "decided_db": round(mean(raw), 2)}
        for effect in given.effects:
            told |= cells(effect, made["decided"][effect], made["scores"], given.seeds)
        record.add(**told)


if __name__ == "__main__":
    main()
