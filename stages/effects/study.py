"""Decides effect after effect: by what was asked for, by its statistic, or by an A/B training run."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nerf.effects.statistics.statistic import Statistic
from nerf.geometry.scene import Scene
from nerf.training.trainer import NonFinite
from stages.contract import Inputs, Progress, StageResult
from stages.effects import ab_runs
from stages.effects.ab_runs import Pilot, PilotScene, fits_poses
from stages.effects.decisions import Decisions, write_decisions
from stages.effects.effect_list import EFFECTS, Effect
from stages.effects.scene_statistics import WARNINGS, camera_model_statistic, observed
from stages.io.files import read_tensors, write_json

if TYPE_CHECKING:
    from stages.effects import Config


class SceneStatistics(NamedTuple):
    """The evidence by effect and warning, what effects begin with (training photos in order, numbers), and the
    ``seconds`` that the evidence took."""

    of: dict[str, Statistic]
    measured: dict[str, np.ndarray]
    seconds: dict[str, float]


class Clock:
    """Seconds by effect; of what serves several, each has an equal part."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def runs_for(self, *names: str) -> Iterator[None]:
        """While the block lasts."""
        started = time.perf_counter()
        yield
        part = (time.perf_counter() - started) / len(names)
        for name in names:
            self.seconds[name] = self.seconds.get(name, 0.0) + part

    def timed(self, statistics: Mapping[str, Callable[[], Statistic]]) -> dict[str, Statistic]:
        """What each of them says; each counts for its own name."""
        said = {}
        for name, statistic in statistics.items():
            with self.runs_for(name):
                said[name] = statistic()
        return said


def scene_statistics(
    ingest: Path,
    scene: Scene,
    points: Mapping[str, np.ndarray],
    uncertainty_px: Mapping[str, float | None],
    progress: Progress,
) -> SceneStatistics:
    """Everything that can be told without training. ``points`` is points.safetensors, ``uncertainty_px`` what
    registration.json says of each photo by its file (``images/…``)."""
    clock, parts = Clock(), {effect.name: effect.load() for effect in EFFECTS}
    with clock.runs_for(*parts, *WARNINGS):
        seen = observed(ingest, scene, points, uncertainty_px, progress)
    statistics = {name: each.statistic for name, each in parts.items()} | WARNINGS
    of = clock.timed({name: partial(statistic, seen) for name, statistic in statistics.items()})
    measured = {name: each.measured(seen) for name, each in parts.items() if each.measured}
    return SceneStatistics(of, measured, clock.seconds)


class Verdict(NamedTuple):
    """Whether an effect is on, and why, and the ``seconds`` that it took to come to that, the statistic apart."""

    on: bool
    reason: str
    pilot: Pilot | None = None
    seconds: float = 0.0


def study(
    config: "Config", scene: Scene, registration: dict[str, Any], inputs: Inputs, folder: Path, progress: Progress
) -> StageResult:
    """The stage's work, once it knows how many A/B runs there may be."""
    started = time.perf_counter()
    uncertainty = {f"images/{image['file']}": image.get("uncertainty_px") for image in registration["images"]}
    points = read_tensors(inputs["normalise"] / "points.safetensors")
    found = scene_statistics(inputs["ingest"], scene, points, uncertainty, progress)
    statistics_seconds = time.perf_counter() - started
    decisions, verdicts = _Study(config, scene, inputs, found, progress).decide()
    write_decisions(folder, decisions)
    camera_model = camera_model_statistic(registration)
    of = found.of | {"camera_model": camera_model}
    seconds = found.seconds | {"camera_model": 0.0}  # stage sfm chose it
    verdicts["camera_model"] = Verdict(bool(camera_model.called_for), camera_model.words)
    order = [*verdicts, *(name for name in of if name not in verdicts)]
    table = {name: _entry(verdicts.get(name), of[name], seconds[name]) for name in order}
    write_json(folder / "effects.json", table)
    facts = {"on": [name for name, entry in table.items() if entry["on"]], "statistics_seconds": statistics_seconds}
    return StageResult(("decisions.json",), _line(table), ("effects.json",), facts)


class _Study:
    """Decides effect after effect; each pilot builds on what was decided before it."""

    def __init__(
        self,
        config: "Config",
        scene: Scene,
        inputs: Inputs,
        found: SceneStatistics,
        progress: Progress,
    ) -> None:
        self.config, self.scene, self.inputs, self.found, self.progress = config, scene, inputs, found, progress
        self.pilots = self.fitting_pilots = 0
        self.trial: PilotScene | str | None = None

    def decide(self) -> tuple[Decisions, dict[str, Verdict]]:
        """What to model, and the reasons by effect. What the published method has is on until it is decided."""
        decisions = Decisions({effect.name: {} for effect in EFFECTS if effect.part_of_the_method})
        verdicts: dict[str, Verdict] = {}
        for effect in EFFECTS:
            off, on = decisions.without(effect.name), decisions.having(effect.name, self._measured(effect.name))
            began = time.perf_counter()
            verdict = self._verdict(effect, off, on)
            verdicts[effect.name] = verdict._replace(seconds=time.perf_counter() - began)
            decisions = on if verdict.on else off
        return decisions, verdicts

    def _measured(self, name: str) -> dict[str, list[float]]:
        """What an effect begins with, by the names of the training photos."""
        if name not in self.found.measured:
            return {}
        names = [view.name for view in self.scene.of_split("train")]
        return dict(zip(names, self.found.measured[name].tolist(), strict=True))

    def _verdict(self, effect: Effect, off: Decisions, on: Decisions) -> Verdict:
        asked = self.config.force.get(effect.name)
        statistic = self.found.of[effect.name]
        if asked is not None:
            return Verdict(asked == "on", f"asked for; {statistic.words}")
        clear, words = statistic.called_for, statistic.words
        default = effect.part_of_the_method or (effect.has_lookalike and clear is True)
        # Highlights have no tracks: what is seen of view dependence is a lower bound, and too little of it no proof.
        proves_nothing = (effect.has_lookalike and clear is True) or (effect.part_of_the_method and clear is False)
        if clear is not None and not proves_nothing:
            return Verdict(clear, words)
        if math.isinf(statistic.noise):
            return Verdict(default, words)
        if why := self._why_no_pilot(off, on):
            return Verdict(default, f"{words}; {'unclear, and ' if clear is None else ''}no A/B run: {why}")
        return self._piloted(effect, off, on, default)

    def _why_no_pilot(self, off: Decisions, on: Decisions) -> str | None:
        if not self.config.pilot_steps:
            return "--effects.pilot-steps 0"
        if self.pilots == self.config.pilots:
            return f"{self.pilots} already made" if self.pilots else "there is no time for one"
        if fits_poses(off, on) and self.fitting_pilots == self.config.fitting_pilots:
            return "there is no time for one that fits poses"
        if self.trial is None:
            self.trial = ab_runs.pilot_scene(self.inputs, self.scene, self.progress)
        return self.trial if isinstance(self.trial, str) else None

    def _piloted(self, effect: Effect, off: Decisions, on: Decisions, default: bool) -> Verdict:
        assert self.trial is not None and not isinstance(self.trial, str), "a reason against pilots is heard before"
        self.pilots += 1
        self.fitting_pilots += fits_poses(off, on)
        words = self.found.of[effect.name].words
        try:
            steps, seed = self.config.pilot_steps, self.config.seed
            pilot = ab_runs.run_pilot(self.trial, off, on, steps, seed, self.progress, default)
        except NonFinite as fault:
            return Verdict(default, f"{words}; the A/B run diverged: {fault}")
        seeds = "" if pilot.seeds == ab_runs.SEEDS else f" with {pilot.seeds} of {ab_runs.SEEDS} seeds"
        gain = f"an A/B run gained {pilot.gain_db:+.2f} ± {pilot.noise_db:.2f} dB{seeds}"
        stays = not pilot.hurts if default else pilot.pays
        return Verdict(stays, f"{words}; {gain}", pilot)


def _entry(verdict: Verdict | None, statistic: Statistic, seconds: float) -> dict[str, Any]:
    """One effect in effects.json, whose statistic took ``seconds``; without a verdict it is only seen."""
    pilot = verdict.pilot if verdict else None
    return {
        "on": verdict.on if verdict else bool(statistic.called_for),
        "modelled": verdict is not None,
        "statistic": _finite(statistic.value),
        "unit": statistic.unit,
        "threshold": _finite(statistic.threshold),
        "noise": _finite(statistic.noise),
        "pilot_gain_db": pilot.gain_db if pilot else None,
        "pilot_noise_db": pilot.noise_db if pilot else None,
        "cost": pilot.cost if pilot else None,
        "seconds": round(seconds + (verdict.seconds if verdict else 0.0), 3),
        "reason": verdict.reason if verdict else statistic.words,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _line(table: dict[str, dict[str, Any]]) -> str:
    """exposure on (…) · view dependence on (…) · 2 off · seen, not modelled: tone (…)."""
    modelled = {name.replace("_", " "): entry for name, entry in table.items() if entry["modelled"]}
    on = [f"{name} on ({entry['reason']})" for name, entry in modelled.items() if entry["on"]]
    seen = [f"{n.replace('_', ' ')} ({e['reason']})" for n, e in table.items() if not e["modelled"] and e["on"]]
    line = " · ".join([*on, f"{len(modelled) - len(on)} off"])
    return line + (f" · seen, not modelled: {', '.join(seen)}" if seen else "")
