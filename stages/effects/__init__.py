"""Stage effects: which optional effects the scene calls for, with the evidence; the others are not simulated at all."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import Field
from tyro.conf import Suppress

from stages.amounts import duration
from stages.contract import Inputs, Progress, StageConfig, StageResult
from stages.effects.decisions import Decisions, write_decisions
from stages.io.files import read_json, read_scene, read_tensors, write_json

if TYPE_CHECKING:
    from nerf.effects.statistics.statistic import Evidence
    from nerf.geometry.scene import Scene
    from stages.effects.pilots import Pilot, PilotScene

INPUTS = ("ingest", "sfm", "normalise")
VERSION = 12
RESUMES = False
PUBLISHED = ("effects.json",)
NOT_HASHED = ("seconds",)  # it decides how many pilots, and that enters the key

Switch = Literal["auto", "on", "off"]
ORDER = (
    *("exposure", "view_dependence", "background", "pose_refinement", "lens"),  # modelled
    *("tone", "vignetting", "transients", "scale", "blur", "rolling_shutter", "participating_media"),  # seen
)
# What the published method has is left out only where that gains; the rest is added only where that does.
PART_OF_THE_METHOD = ("view_dependence",)
MOST_PILOTS = 2
PILOT_STEPS = 100
WORTH_TIMING = 3.0  # seconds: in less no pilot is made, and to find out takes one or two


class Config(StageConfig):
    """Which effects to model. auto decides by evidence, and says which."""

    exposure: Switch = Field(default="auto", description="a gain per photo and colour channel")
    view_dependence: Switch = Field(default="auto", description="colour that depends on the viewing direction")
    background: Switch = Field(default="auto", description="space beyond the region of interest, folded in")
    pose_refinement: Switch = Field(default="auto", description="a rigid correction of each photo's camera")
    pilot_steps: int = Field(
        default=PILOT_STEPS,
        ge=0,
        description="steps of each pilot training, where the evidence is not clear; 0: no pilots",
    )
    pilots: int | None = Field(
        default=None, ge=0, description=f"how many at most; none: {MOST_PILOTS}, fewer where there is no time for them"
    )
    fitting_pilots: Annotated[int | None, Suppress] = Field(
        default=None, ge=0, description="of these, how many may fit poses; none: all"
    )
    seconds: float | None = Field(
        default=None,
        ge=0,
        description="that pilots may take; none: by the run, where it counts steps as long as they take",
    )
    seed: int = Field(default=0, description="of the pilots")


class Verdict(NamedTuple):
    """Whether an effect is on, and why, and the ``seconds`` that it took to come to that, the statistic apart."""

    on: bool
    reason: str
    pilot: "Pilot | None" = None
    seconds: float = 0.0


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """How many pilots there may be: as many as fit into the time, by what a step takes on this machine. And how many of
    these may fit poses, which takes longer."""
    if config.pilots is not None:
        return config
    if config.seconds is None or not config.pilot_steps:
        return config.model_copy(update={"pilots": MOST_PILOTS})
    if config.seconds < WORTH_TIMING:
        return config.model_copy(update={"pilots": 0})
    from stages.effects.pilots import expected_seconds

    progress.update("trying how long a pilot would take")
    took, fitting = expected_seconds(read_scene(inputs["normalise"]), config.pilot_steps)
    pilots = min(MOST_PILOTS, int(config.seconds / took))
    more = (config.seconds - pilots * took) / (fitting - took)
    if pilots < MOST_PILOTS:
        count = "none" if not pilots else "one at most"
        progress.note(f"a pilot takes about {duration(took)} here, {duration(config.seconds)} are given: {count}")
    return config.model_copy(update={"pilots": pilots, "fitting_pilots": min(pilots, int(more))})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Gather the evidence, decide, and write decisions.json and, for people and the report, effects.json."""
    from stages.effects.evidence import lens_evidence, scene_evidence

    started, config = time.perf_counter(), plan(config, inputs, progress)
    scene, registration = read_scene(inputs["normalise"]), read_json(inputs["sfm"] / "registration.json")
    uncertainty = {f"images/{image['file']}": image.get("uncertainty_px") for image in registration["images"]}
    points = read_tensors(inputs["normalise"] / "points.safetensors")
    found = scene_evidence(inputs["ingest"], scene, points, uncertainty, progress)
    statistics_seconds = time.perf_counter() - started
    names = [view.name for view in scene.of_split("train")]
    gains = dict(zip(names, found.exposure.log_gain.tolist(), strict=True))
    decisions, verdicts = _Study(config, scene, inputs, gains, found.of, progress).decide()
    write_decisions(folder, decisions)
    lens = lens_evidence(registration)
    evidence, verdicts["lens"] = found.of | {"lens": lens}, Verdict(bool(lens.called_for), lens.words)
    seconds = found.seconds | {"lens": 0.0}  # which stage sfm chose
    table = {name: _entry(verdicts.get(name), evidence[name], seconds[name]) for name in ORDER if name in evidence}
    write_json(folder / "effects.json", table)
    facts = {"on": [name for name, entry in table.items() if entry["on"]], "statistics_seconds": statistics_seconds}
    return StageResult(("decisions.json",), _line(table), ("effects.json",), facts)


class _Study:
    """Decides effect after effect; each pilot builds on what was decided before it."""

    def __init__(
        self,
        config: Config,
        scene: "Scene",
        inputs: Inputs,
        gains: dict[str, list[float]],
        evidence: "dict[str, Evidence]",
        progress: Progress,
    ) -> None:
        self.config, self.scene, self.inputs, self.gains = config, scene, inputs, gains
        self.evidence, self.progress = evidence, progress
        self.pilots = self.fitting_pilots = 0
        self.trial: PilotScene | str | None = None

    def decide(self) -> tuple[Decisions, dict[str, Verdict]]:
        """What to model, and the reasons by effect."""
        decisions = Decisions()
        verdicts: dict[str, Verdict] = {}
        # Poses before view dependence: there are two pilots, and wrong poses cost more.
        settings: dict[str, tuple[str, Any, Any]] = {  # of Decisions: its name, off, on
            "background": ("unbounded", False, True),
            "exposure": ("exposure", None, self.gains),
            "pose_refinement": ("pose_refinement", False, True),
            "view_dependence": ("view_dependence", False, True),
        }
        for name, (setting, *values) in settings.items():
            off, on = (replace(decisions, **{setting: value}) for value in values)
            began = time.perf_counter()
            verdict = self._verdict(name, off, on)
            verdicts[name] = verdict._replace(seconds=time.perf_counter() - began)
            decisions = on if verdicts[name].on else off
        return decisions, verdicts

    def _verdict(self, name: str, off: Decisions, on: Decisions) -> Verdict:
        asked: Switch = getattr(self.config, name)
        evidence = self.evidence[name]
        if asked != "auto":
            return Verdict(asked == "on", f"asked for; {evidence.words}")
        # Highlights have no tracks: what is seen of view dependence is a lower bound, and too little of it no proof.
        unproven = name in PART_OF_THE_METHOD and evidence.called_for is False
        if evidence.called_for is not None and not unproven:
            return Verdict(evidence.called_for, evidence.words)
        default = name in PART_OF_THE_METHOD
        if math.isinf(evidence.noise):
            return Verdict(default, evidence.words)
        if why := self._why_no_pilot(off, on):
            return Verdict(default, f"{evidence.words}; not clear, and no pilot: {why}")
        return self._piloted(name, off, on, default)

    def _why_no_pilot(self, off: Decisions, on: Decisions) -> str | None:
        from stages.effects.pilots import fits_poses, pilot_scene

        if not self.config.pilot_steps:
            return "none was wanted"
        if self.pilots == self.config.pilots:
            return f"{self.pilots} were made already" if self.pilots else "there is no time for one"
        if fits_poses(off, on) and self.fitting_pilots == self.config.fitting_pilots:
            return "there is no time for one that fits poses"
        if self.trial is None:
            self.trial = pilot_scene(self.inputs, self.scene, self.progress)
        return self.trial if isinstance(self.trial, str) else None

    def _piloted(self, name: str, off: Decisions, on: Decisions, default: bool) -> Verdict:
        from nerf.training.trainer import NonFinite
        from stages.effects.pilots import fits_poses, run_pilot

        assert self.trial is not None and not isinstance(self.trial, str), "a reason against pilots is heard before"
        self.pilots += 1
        self.fitting_pilots += fits_poses(off, on)
        words = self.evidence[name].words
        try:
            pilot = run_pilot(self.trial, off, on, self.config.pilot_steps, self.config.seed, self.progress)
        except NonFinite as fault:
            return Verdict(default, f"{words}; not clear, and the pilot diverged: {fault}")
        gain = f"a pilot gained {pilot.gain_db:+.2f} ± {pilot.noise_db:.2f} dB"
        stays = not pilot.hurts if name in PART_OF_THE_METHOD else pilot.pays
        return Verdict(stays, f"{words}; {gain}", pilot)


def _entry(verdict: Verdict | None, evidence: "Evidence", seconds: float) -> dict[str, Any]:
    """One effect in effects.json, whose statistic took ``seconds``; without a verdict it is only seen."""
    pilot = verdict.pilot if verdict else None
    return {
        "on": verdict.on if verdict else bool(evidence.called_for),
        "modelled": verdict is not None,
        "statistic": _finite(evidence.statistic),
        "unit": evidence.unit,
        "threshold": _finite(evidence.threshold),
        "noise": _finite(evidence.noise),
        "pilot_gain_db": pilot.gain_db if pilot else None,
        "pilot_noise_db": pilot.noise_db if pilot else None,
        "cost": pilot.cost if pilot else None,
        "seconds": round(seconds + (verdict.seconds if verdict else 0.0), 3),
        "reason": verdict.reason if verdict else evidence.words,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _line(table: dict[str, dict[str, Any]]) -> str:
    """exposure on (…) · view dependence on (…) · 2 off · seen, not modelled: vignetting (…)."""
    modelled = {name.replace("_", " "): entry for name, entry in table.items() if entry["modelled"]}
    on = [f"{name} on ({entry['reason']})" for name, entry in modelled.items() if entry["on"]]
    seen = [f"{n.replace('_', ' ')} ({e['reason']})" for n, e in table.items() if not e["modelled"] and e["on"]]
    line = " · ".join([*on, f"{len(modelled) - len(on)} off"])
    return line + (f" · seen, not modelled: {', '.join(seen)}" if seen else "")
