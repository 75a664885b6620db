"""Stage effects: which optional effects are modelled, with the evidence; the others are not simulated at all.

An effect is on only where the photos call for it. View dependence, which the published method has, is on unless an A/B
run shows that it does harm.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator
from tyro.conf import Suppress

from stages.contract import Auto, BudgetLeft, Inputs, Progress, Stage, StageConfig, StageResult, Workload
from stages.effects.effect_list import EFFECTS
from stages.io.amounts import duration
from stages.io.files import read_json, read_scene

# Of the run: what the stage may take, and of what is free no more than FREE_SHARE. Of that, beside reading the photos,
# statistics take one or two seconds, timing a pilot as much.
BUDGET_SHARE, FREE_SHARE, STATISTICS_SECONDS = 0.15, 0.25, 4.0

Switch = Literal["on", "off"]
MAX_PILOTS = 2
PILOT_STEPS = 100
MIN_TIMED_SECONDS = 3.0  # in less no A/B run is made, and to find out takes one or two


class Config(StageConfig):
    """How it is decided which effects to model."""

    # --effect NAME=on|off|auto gives it.
    force: Annotated[dict[str, Switch], Suppress] = Field(
        default={}, description="by the name of an effect: on or off; those that are not named are decided by evidence"
    )
    pilot_steps: int = Field(
        default=PILOT_STEPS,
        ge=0,
        description=(
            "Steps of each training of an A/B run: short trainings with an effect and without, which decide where the "
            "statistics are unclear; 0: no A/B runs."
        ),
    )
    pilots: Auto[int] = Field(
        default=None, ge=0, description="Maximum number of A/B runs (default: 2, fewer if there is too little time)."
    )
    fitting_pilots: Annotated[int | None, Suppress] = Field(
        default=None, ge=0, description="of these, how many may fit poses; none: all"
    )
    seconds: Auto[float] = Field(
        default=None,
        ge=0,
        description="Time limit of all A/B runs (default: from the budget; none for a run of --train.steps).",
    )
    seed: int = Field(default=0, description="Seed of the A/B runs.")

    @field_validator("force")
    @classmethod
    def _known(cls, force: dict[str, Switch]) -> dict[str, Switch]:
        names = [effect.name for effect in EFFECTS]
        if unknown := [name for name in force if name not in names]:
            raise ValueError(f"there is no effect {unknown[0]!r}; there are: {', '.join(names)}")
        return force


def expected_seconds(config: Config, workload: Workload) -> float:
    """Reading the photos, three seconds, and a quarter of a minute for a pilot, of which every second set has one."""
    return 10.0 + workload.photos.reading_seconds(workload.cores)


def budget_seconds(left: BudgetLeft) -> float:
    """What pilots may take: BUDGET_SHARE of the run, less what the stage takes without any; and of what is free no more
    than leaves a training that is worth it."""
    share = min(BUDGET_SHARE * left.total, FREE_SHARE * left.free)
    return max(0.0, share - STATISTICS_SECONDS - left.reading)


def limiting_seconds(options: Mapping[str, Any]) -> float | None:
    """Without a budget a training in seconds limits its pilots; a run that counts steps must not depend on how fast the
    machine is. What ``--more`` adds changes no pilot: the continued field stands on their decisions."""
    return options["train"].planned_seconds


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """How many pilots there may be: as many as fit into the time, by what a step takes on this machine. And how many of
    these may fit poses, which takes longer."""
    if config.pilots is not None:
        return config
    if config.seconds is None or not config.pilot_steps:
        return config.model_copy(update={"pilots": MAX_PILOTS})
    if config.seconds < MIN_TIMED_SECONDS:
        return config.model_copy(update={"pilots": 0})
    from stages.effects.ab_runs import expected_seconds

    progress.update("timing an A/B run")
    took, fitting = expected_seconds(read_scene(inputs["normalise"]), config.pilot_steps)
    pilots = min(MAX_PILOTS, int(config.seconds / took))
    more = (config.seconds - pilots * took) / (fitting - took)
    if pilots < MAX_PILOTS:
        progress.note(
            "effects.few-pilots",
            f"time allows {pilots} of up to {MAX_PILOTS} A/B runs: one takes up to {duration(took)} "
            f"here, and {duration(config.seconds)} are available",
        )
    return config.model_copy(update={"pilots": pilots, "fitting_pilots": min(pilots, int(more))})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Gather the evidence, decide, and write decisions.json and, for people and the report, effects.json."""
    from stages.effects.study import study

    scene, registration = read_scene(inputs["normalise"]), read_json(inputs["sfm"] / "registration.json")
    return study(config, scene, registration, inputs, folder, progress)


STAGE = Stage(
    name="effects",
    inputs=("ingest", "sfm", "normalise"),
    version=22,
    exit_code=13,
    published=("effects.json",),
    config=Config,
    not_hashed=("seconds",),  # it decides how many A/B runs, and that enters the key
    plan=plan,
    run=run,
    expected_seconds=expected_seconds,
    budget_seconds=budget_seconds,
    limiting_seconds=limiting_seconds,
)
