"""How well a run's own curve tells what twice the steps would give, from the file of benchmarks.budget_runs.

python -m benchmarks.prediction runs.json

Every case is a run of T steps and one of 2 T with the same seed: from the curve of the first alone it is predicted by
how much the second ends higher, and the constants of the prediction are those of the other sets only. At the end: what
nerf/training/learning_curve.py holds, and how curves compare across budgets and schedules.
"""

import argparse
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import numpy as np

from benchmarks.record import Record, add_out
from nerf.training.learning_curve import MIN_STEPS, Curve, last_doubling_gain
from nerf.training.learning_rate import LR_HOLD_FRACTION

SHARE = 0.8  # of the truths that an interval is to hold
LEAST = 0.1  # dB: by as much two seeds differ
MEASURED = ("probe_psnr", "mean_10")
Run = dict[str, Any]


class Case(NamedTuple):
    """What the curve of a run of ``steps`` tells, and by how much the one of twice the steps ended higher."""

    name: str
    set: str
    steps: int
    last: float
    gap: float
    reached: float


Terms = Callable[[Case], list[float]]
"""What a case's prediction is linear in."""

MODELS: dict[str, Terms] = {
    "always the same": lambda case: [1.0],
    "share of the last": lambda case: [case.last],
    "share, falling": lambda case: [case.last * (1000 / case.steps) ** 0.45],
    "line in the last": lambda case: [1.0, case.last],
    "line, and the gap": lambda case: [1.0, case.last, case.gap],
}
IN_USE = "share of the last"


def curve_of(run: Run, measured: str = "probe_psnr") -> Curve:
    """(steps, dB): of a run on an idle machine steps and seconds differ by a factor."""
    return [(float(point["step"]), point[measured]) for point in run["points"]]


def final(run: Run) -> float:
    return run["points"][-1]["probe_psnr"]


def in_use(run: Run) -> bool:
    """Whether a run was made in one piece, under the schedule that is in use."""
    return run["schedule"] == "whole" and run["constant"] == LR_HOLD_FRACTION


def cases_of(runs: list[Run]) -> list[Case]:
    """Consecutive budgets of one set and seed, of those long enough to predict anything."""
    whole = sorted(filter(in_use, runs), key=lambda run: (run["set"], run["seed"], run["steps"]))
    cases = []
    for short, long in pairwise(whole):
        if short["steps"] < MIN_STEPS:
            continue
        if (short["set"], short["seed"], 2 * short["steps"]) != (long["set"], long["seed"], long["steps"]):
            continue
        last = last_doubling_gain(curve_of(short))
        assert last is not None, "runs are measured for more than a doubling"
        gap = short["points"][-1]["train_psnr"] - final(short)
        name = f"{short['set']} seed {short['seed']} {short['steps']} steps"
        cases.append(Case(name, short["set"], short["steps"], last, gap, final(long) - final(short)))
    return cases


def fitted(cases: list[Case], terms: Terms) -> np.ndarray:
    """The constants of least squares."""
    told = np.array([terms(case) for case in cases])
    return np.linalg.lstsq(told, np.array([case.reached for case in cases]), rcond=None)[0]


def predicted(case: Case, terms: Terms, constants: np.ndarray) -> float:
    return float(np.array(terms(case)) @ constants)


def others(cases: list[Case], case: Case) -> list[Case]:
    """Those of other sets."""
    return [other for other in cases if other.set != case.set]


def half_width(cases: list[Case], terms: Terms) -> float:
    """What holds SHARE of the truths, each judged by constants of other sets."""
    guesses = [predicted(case, terms, fitted(others(cases, case), terms)) for case in cases]
    off = [abs(case.reached - guess) for case, guess in zip(cases, guesses, strict=True)]
    return max(float(np.quantile(off, SHARE)), LEAST)


def score(cases: list[Case], terms: Terms) -> list[tuple[Case, float, float]]:
    """Each case with what is predicted of it and the half width, both without any run of its own set."""
    rows = []
    for case in cases:
        rest = others(cases, case)
        rows.append((case, predicted(case, terms, fitted(rest, terms)), half_width(rest, terms)))
    return rows


def print_scores(cases: list[Case], record: Record) -> None:
    for name, terms in MODELS.items():
        rows = score(cases, terms)
        covered = mean(abs(case.reached - guess) <= half for case, guess, half in rows)
        rms = mean((case.reached - guess) ** 2 for case, guess, _ in rows) ** 0.5
        width = round(mean(row[2] for row in rows), 2)
        holds = round(100 * covered)
        record.add(prediction=name, rms_db=round(rms, 2), interval_holds_percent=holds, half_width_db=width)
    terms = MODELS[IN_USE]
    print("\n| case | last doubling | predicted | reached | |\n|---|---|---|---|---|")
    for case, guess, half in score(cases, terms):
        inside = "" if abs(case.reached - guess) <= half else "outside"
        print(f"| {case.name} | {case.last:+.2f} | {guess:+.2f} ± {half:.2f} | {case.reached:+.2f} | {inside} |")
    constants = ", ".join(f"{value:.3f}" for value in fitted(cases, terms))
    print(f"\n{len(cases)} cases; of all: {constants}, ± {half_width(cases, terms):.2f}")


def print_schedules(runs: list[Run]) -> None:
    """What is measured on the way of a longer run, less what a run ended with that had so many steps only."""
    ended = {(run["set"], run["seed"], run["steps"]): final(run) for run in filter(in_use, runs)}
    for schedule, constant in dict.fromkeys((run["schedule"], run["constant"]) for run in runs):
        of = [run for run in runs if (run["schedule"], run["constant"]) == (schedule, constant)]
        for measured in MEASURED:
            for times in (2, 4, 8):
                off = [
                    dict(curve_of(run, measured))[run["steps"] / times] - short
                    for run in of
                    if (short := ended.get((run["set"], run["seed"], run["steps"] // times))) is not None
                ]
                if len(off) > 1:
                    told = f"{mean(off):+.2f} dB, spread {np.std(off):.2f} ({len(off)} runs)"
                    print(f"{schedule:<6} {constant:.0%} {measured:<12} at 1/{times}: {told}")
        alike = [final(run) - ended[key] for run in of if (key := (run["set"], run["seed"], run["steps"])) in ended]
        print(
            f"{schedule:<6} {constant:.0%} at the end, beside those in use: {mean(alike):+.2f} dB ({len(alike)} runs)\n"
        )
    gained = [run["points"][-1]["mean_10"] - final(run) for run in runs]
    print(f"the running mean at the end, beside the field: {mean(gained):+.2f} dB ({len(gained)} runs)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    add_out(parser)
    given = parser.parse_args()
    runs = json.loads(given.runs.read_text())
    print_scores(cases_of(runs), Record(given.out))
    print()
    print_schedules(runs)


if __name__ == "__main__":
    main()
