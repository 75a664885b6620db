"""How well vignetting is learnt on synthetic scenes, and what it gains.

    python -m benchmarks.vignetting [--ev 0.3 1] [--exposure 0 1] [--seeds 5] [--steps 1500]

Photos of tests/effect_scenes.py, darker by --ev at the corner and exposed differently by up to --exposure EV. A
training without the effect and one with it, as A/B runs train. "measured": the corner as the tracks tell it, where
training begins; "learnt": where it ends; "error": the largest one of the learnt curve, as a share of the corner's EV;
"gain_db": right halves of validation photos, with the effect less without.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from benchmarks.record import Record, add_out
from nerf.effects.statistics.exposure import EV
from nerf.effects.statistics.vignetting import log_falloff
from nerf.runtime.parallel import take_over_cores
from stages.contract import SilentProgress
from stages.effects import ab_runs
from stages.effects.decisions import Decisions
from stages.effects.scene_statistics import measured_gains, measured_vignetting, observed
from stages.io.files import read_scene, read_tensors
from tests.effect_scenes import FOCAL, HEIGHT, WIDTH, Effects, effect_scene

U = np.linspace(0, 1, 101)


def true_curve(corner_ev: float) -> np.ndarray:
    """EV at each of U, 1 at the centre of the last pixel. Photos have it in proportion to the squared radius, tan²θ."""
    last_pixel = math.atan(math.hypot(WIDTH - 1, HEIGHT - 1) / 2 / FOCAL)
    angle = 2 * np.arcsin(np.sqrt(U) * math.sin(last_pixel / 2))
    return corner_ev * (2 * FOCAL * np.tan(angle)) ** 2 / (WIDTH**2 + HEIGHT**2)


def figures(made: Effects, seed: int, steps: int, folder: Path) -> dict[str, Any]:
    """A row of the table."""
    inputs = effect_scene(folder, made, seed)
    scene, points = read_scene(inputs["normalise"]), read_tensors(inputs["normalise"] / "points.safetensors")
    seen = observed(inputs["ingest"], scene, points, {}, SilentProgress())
    trial = ab_runs.pilot_scene(inputs, scene, SilentProgress())
    assert not isinstance(trial, str), trial
    names = [view.name for view in scene.of_split("train")]
    gains, falloff = (dict(zip(names, of(seen).tolist(), strict=True)) for of in (measured_gains, measured_vignetting))
    off = Decisions({"view_dependence": {}, "background": {}} | ({"exposure": gains} if made.exposure_ev else {}))
    began, scores = time.process_time(), []
    for decisions in (off, off.having("vignetting", falloff)):
        trained = ab_runs._trained(trial, decisions, steps, 0)
        scores.append(mean(ab_runs._score(trained, trial.scene, photo, False, 0) for photo in trial.validation))
    learnt = log_falloff(U, np.array(trained.learnt["effects"]["vignetting"][names[-1]][1:])) / EV
    truth = true_curve(made.vignetting_ev)
    return {
        "corner": made.vignetting_ev,
        "exposure": made.exposure_ev,
        "seed": seed,
        "measured": round(sum(falloff[names[-1]]) / EV, 3),
        "learnt": round(float(learnt[-1]), 3),
        "error": round(float(np.abs(learnt - truth).max() / (made.vignetting_ev or 1)), 3),
        "without": round(scores[0], 2),
        "gain_db": round(scores[1] - scores[0], 2),
        "cpu_seconds": round(time.process_time() - began),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ev", type=float, nargs="+", default=[0.3, 1.0])
    parser.add_argument("--exposure", type=float, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1500)
    add_out(parser)
    given = parser.parse_args()
    take_over_cores()  # torch's threads wait for each other: photos are drawn ten times as slowly
    record = Record(given.out)
    for seed in range(given.seeds):  # all of a seed together: its photos are drawn once
        for exposure in given.exposure:
            for ev in given.ev:
                with tempfile.TemporaryDirectory() as folder:
                    made = Effects(exposure_ev=exposure, vignetting_ev=ev)
                    record.add(**figures(made, seed, given.steps, Path(folder) / "scene"))


if __name__ == "__main__":
    main()
