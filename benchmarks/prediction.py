"""How well a run's own curve tells what twice the steps would give, from the file of benchmarks.budget_runs.

python -m benchmarks.prediction runs.json

Every case is a run of T steps and one of 2 T with the same seed: from the curve of the first alone it is predicted by
how much the second ends higher, and the constants of the prediction are those of the other sets only. At the end: what
nerf/learning_curve.py holds, and how curves compare across budgets and schedules.
"""

import argparse
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import numpy as np

from nerf.grid_training import CONSTANT_SHARE
from nerf.learning_curve import FEWEST_STEPS, TYPICAL_STEPS, Curve, last_doubling

SHARE = 0.8  # of the truths that an interval is to hold
LEAST = 0.1  # dB: by as much two seeds differ
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)  # of what is predicted, for the interval
MEASURED = ("heldout_psnr", "mean_10")
Run = dict[str, Any]


class Case(NamedTuple):
    """What the curve of a run of ``steps`` tells, and by how much the one of twice the steps ended higher."""

    name: str
    set: str
    steps: int
    last: float
    gap: float
    reached: float


Terms = Callable[[Case, float], list[float]]
"""What a case's prediction is linear in, for an exponent that is fitted, too."""

MODELS: dict[str, Terms] = {
    "always the same": lambda case, _: [1.0],
    "share of the last": lambda case, _: [case.last],
    "line in the last": lambda case, _: [1.0, case.last],
    "line, and the gap": lambda case, _: [1.0, case.last, case.gap],
    "share, falling": lambda case, exponent: [case.last * (TYPICAL_STEPS / case.steps) ** exponent],
}
IN_USE = "share, falling"
EXPONENTS = tuple(np.arange(0.0, 1.05, 0.05))


class Fit(NamedTuple):
    exponent: float
    constants: np.ndarray

    def of(self, case: Case, terms: Terms) -> float:
        return float(np.array(terms(case, self.exponent)) @ self.constants)


def curve_of(run: Run, measured: str = "heldout_psnr") -> Curve:
    """(steps, dB): of a run on an idle machine steps and seconds differ by a factor."""
    return [(float(point["step"]), point[measured]) for point in run["points"]]


def final(run: Run) -> float:
    return run["points"][-1]["heldout_psnr"]


def in_use(run: Run) -> bool:
    """Whether a run was made in one piece, under the schedule that is in use."""
    return run["schedule"] == "whole" and run["constant"] == CONSTANT_SHARE


def cases_of(runs: list[Run]) -> list[Case]:
    """Consecutive budgets of one set and seed, of those long enough to predict anything."""
    whole = sorted(filter(in_use, runs), key=lambda run: (run["set"], run["seed"], run["steps"]))
    cases = []
    for short, long in pairwise(whole):
        if short["steps"] < FEWEST_STEPS:
            continue
        if (short["set"], short["seed"], 2 * short["steps"]) != (long["set"], long["seed"], long["steps"]):
            continue
        last = last_doubling(curve_of(short))
        assert last is not None, "runs are measured for more than a doubling"
        gap = short["points"][-1]["train_psnr"] - final(short)
        name = f"{short['set']} seed {short['seed']} {short['steps']} steps"
        cases.append(Case(name, short["set"], short["steps"], last, gap, final(long) - final(short)))
    return cases


def fitted(cases: list[Case], terms: Terms) -> Fit:
    """Least squares, for the exponent that leaves least."""

    def squares(fit: Fit) -> float:
        return sum((case.reached - fit.of(case, terms)) ** 2 for case in cases)

    reached = np.array([case.reached for case in cases])
    fits = []
    for exponent in EXPONENTS:
        told = np.array([terms(case, exponent) for case in cases])
        fits.append(Fit(float(exponent), np.linalg.lstsq(told, reached, rcond=None)[0]))
    return min(fits, key=squares)


def left_out(cases: list[Case], terms: Terms) -> list[float]:
    """Reached less predicted, of each case, by the constants of all other sets."""
    fits = {one: fitted([case for case in cases if case.set != one], terms) for one in {case.set for case in cases}}
    return [case.reached - fits[case.set].of(case, terms) for case in cases]


class Width(NamedTuple):
    """Half the interval around a prediction: ``least``, and a share of what is predicted."""

    least: float
    share: float

    def of(self, guess: float) -> float:
        return self.least + self.share * max(guess, 0.0)


def width(cases: list[Case], terms: Terms) -> Width:
    """The narrowest on average that holds SHARE of the truths, judged by sets that the constants do not come from."""
    off = np.abs(left_out(cases, terms))
    fit = fitted(cases, terms)
    gains = np.array([max(fit.of(case, terms), 0.0) for case in cases])
    tried = [Width(max(float(np.quantile(off - share * gains, SHARE)), LEAST), share) for share in SHARES]
    return min(tried, key=lambda found: found.least + found.share * gains.mean())


def score(cases: list[Case], terms: Terms) -> list[tuple[Case, float, float]]:
    """Each case with what is predicted of it and the half width, both without any run of its own set."""
    rows = []
    for case in cases:
        others = [other for other in cases if other.set != case.set]
        guess = fitted(others, terms).of(case, terms)
        rows.append((case, guess, width(others, terms).of(guess)))
    return rows


def print_scores(cases: list[Case]) -> None:
    for name, terms in MODELS.items():
        rows = score(cases, terms)
        covered = mean(abs(case.reached - guess) <= half for case, guess, half in rows)
        rms = mean((case.reached - guess) ** 2 for case, guess, _ in rows) ** 0.5
        print(f"{name:<18} rms {rms:.2f} dB, covered {covered:.0%}, half width {mean(r[2] for r in rows):.2f}")
    terms = MODELS[IN_USE]
    print("\n| case | last doubling | predicted | reached | |\n|---|---|---|---|---|")
    for case, guess, half in score(cases, terms):
        inside = "" if abs(case.reached - guess) <= half else "outside"
        print(f"| {case.name} | {case.last:+.2f} | {guess:+.2f} ± {half:.2f} | {case.reached:+.2f} | {inside} |")
    fit = fitted(cases, terms)
    found = width(cases, terms)
    constants = ", ".join(f"{value:.3f}" for value in fit.constants)
    print(f"\n{len(cases)} cases; of all: {constants} at an exponent of {fit.exponent:.2f},")
    print(f"± {found.least:.2f} and {found.share:.2f} of what is predicted")


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
    runs = json.loads(parser.parse_args().runs.read_text())
    print_scores(cases_of(runs))
    print()
    print_schedules(runs)


if __name__ == "__main__":
    main()
