"""Stage tradeoff: a study of what quality costs on this scene and this machine.

Fields of several kinds and sizes are trained for several times, at several photo sizes, with several seeds; each is
scored on the same pixels of the held-out photos, and so is the field that the workspace has already. What nothing beats
is drawn as a front, and one point of it is recommended. The stage is no part of the usual chain: it runs when it is
asked for.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import Field
from tyro.conf import Suppress

from stages.contract import Inputs, Progress, StageConfig, StageError, StageResult
from stages.effects.decisions import Space, read_decisions
from stages.io.amounts import duration
from stages.io.files import read_scene, write_json
from stages.tradeoff.runs import (
    OWN,
    THINNED,
    VARIANTS,
    Arm,
    Reading,
    Selection,
    Speed,
    drawn_per_second,
    in_words,
    meanings,
    resolution_words,
)

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from stages.tradeoff.own_field import Own
    from stages.tradeoff.trial import Exam

INPUTS = ("ingest", "normalise", "effects")
OPTIONAL_INPUTS = ("train",)
VERSION = 12
RESUMES = True
PUBLISHED = ("tradeoff.svg", "tradeoff.png", "tradeoff.md", "tradeoff.json", "ablation.png")

FEWEST_WINDOWS, MOST_WINDOWS = 6, 32
SCORING_SHARE = 0.003  # of the study's time: for drawing all windows once, whatever the field; but the published one
COLUMNS = ("", "field", "photos", "steps", "training", "a frame", "peak memory", "model", "PSNR (dB)", "SSIM", "seeds")
LATE = 0.1  # of the study's time by which it may end late before arms are left out


class Config(StageConfig):
    """How large a study. None is chosen for you."""

    seconds: float = Field(default=1800.0, gt=0, description="for all trainings and scores; --budget 30m says the same")
    seeds: int = Field(default=3, ge=1, le=9, description="trainings of one setting at most, as far as the time goes")
    downscale: float | None = Field(
        default=None, ge=1, description="photo width / width that all are scored at; none: the finest of the study"
    )
    # Measured or chosen by plan(); no flag is offered for them.
    speeds: Annotated[dict[str, tuple[float, float]] | None, Suppress] = Field(
        default=None, description="steps and rays a second of training, by variant"
    )
    space: Annotated[Space | None, Suppress] = Field(default=None, description="that the scene lies in")
    sizes: Annotated[tuple[float, ...] | None, Suppress] = Field(default=None, description="photo sizes trained at")
    windows: Annotated[int | None, Suppress] = Field(default=None, description="of the held-out photos, scored on")
    reading: Annotated[tuple[float, float], Suppress] = Field(
        default=(0.0, 0.0), description="seconds to read the photos at one size, and those of the windows"
    )


class Trial(NamedTuple):
    """An arm that was run and its figures."""

    arm: Arm
    figures: dict[str, Any]


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Measure how fast this machine trains each kind of field and reads photos; choose photo sizes and windows."""
    from stages.tradeoff.speeds import measured_reading, measured_speeds, study_sizes
    from stages.tradeoff.trial import WINDOW

    scene = _scene_with_test_photos(inputs)
    speeds = measured_speeds(scene, inputs, config.seconds, progress)
    sizes = config.sizes or study_sizes(scene, speeds, config.seconds)
    quick = [name for name in speeds if VARIANTS[name].family != "published"]
    drawn = min(drawn_per_second(name, speeds[name]) for name in quick)
    affordable = SCORING_SHARE * config.seconds * drawn / WINDOW**2
    windows = min(max(FEWEST_WINDOWS, int(affordable)), MOST_WINDOWS)
    reading = measured_reading(scene, inputs["ingest"], windows)
    chosen = {
        "speeds": {name: (round(speed.steps, 4), round(speed.rays, 2)) for name, speed in speeds.items()},
        "space": read_decisions(inputs["effects"]).space,
        "sizes": sizes,
        "windows": windows,
        "reading": (round(reading.photos, 5), round(reading.windows, 5)),
        "downscale": config.downscale or sizes[0],
    }
    return config.model_copy(update=chosen)


def _scene_with_test_photos(inputs: Inputs) -> "Scene":
    scene = read_scene(inputs["normalise"])
    if not scene.of_split("test"):
        why = "no photo of this scene was kept for testing"
        raise StageError(
            "tradeoff.no-test-photos",
            "nothing to score a study by",
            why,
            "Lower --normalise.test-every, or add photos.",
        )
    return scene


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Train and score arm by arm, then write tables, plot, pictures and the recommendation.

    Raises:
        StageError: without held-out photos, where not one arm could be scored, or where one could not be trained for
            want of memory or disk.
    """
    from stages.io.stopwatch import counted
    from stages.tradeoff.own_field import own_field
    from stages.tradeoff.trial import make_exam

    config = config if config.speeds else plan(config, inputs, progress)
    assert config.windows and config.downscale and config.sizes, "plan() chooses them"
    scene, selection = _scene_with_test_photos(inputs), selection_of(config)
    for line in (promise(selection, folder / "arms"), *plan_words(selection, config.seconds)):
        progress.note(line)
    with counted(folder / "clock.json") as spent:
        exam = make_exam(inputs["ingest"], scene, config.downscale, config.windows, config.sizes[-1])
        trials, late = _run_all(config, selection, exam, inputs, folder, progress, spent)
        own = own_field(exam, inputs, folder / "arms", config.seconds, progress)
    if all(trial.figures["failed"] for trial in trials):
        why = "; ".join(dict.fromkeys(str(trial.figures["failed"]) for trial in trials))
        why = why or f"{duration(config.seconds)} are too short here even for {selection.left_out[0]}"
        raise StageError("tradeoff.no-result", "the study has no result", why, "Give it more time, as in --budget 30m.")
    workspace = inputs["normalise"].resolve().parents[1].name
    failed = [f"{trial.arm.words} ({trial.figures['failed']})" for trial in trials if trial.figures["failed"]]
    return _written(config, trials, own, (*selection.left_out, *late, *failed), exam, folder, workspace)


def selection_of(config: Config) -> Selection:
    """The arms of a planned study."""
    from stages.tradeoff.runs import SMALL_SIDE, select
    from stages.tradeoff.trial import SHOWN, WINDOW

    assert config.speeds and config.space and config.sizes and config.windows, "plan() chooses them"
    speeds = {name: Speed(*speed) for name, speed in config.speeds.items()}
    rays, reading = config.windows * WINDOW**2 + SHOWN * SMALL_SIDE**2, Reading(*config.reading)
    return select(config.seconds, config.seeds, config.space, config.sizes, speeds, rays, reading)


def promise(selection: Selection, arms: Path) -> str:
    """How many trainings there are to do, some of which an earlier attempt has left in the folder ``arms``, and when
    they are expected to be done."""
    from stages.tradeoff.trial import figures_file, kept

    to_do = [arm for arm in selection.arms if kept(figures_file(arm, arms)) is None]
    seconds = sum(arm.seconds for arm in to_do)
    there = f", {len(selection.arms) - len(to_do)} of them there" if len(to_do) < len(selection.arms) else ""
    finish = time.strftime("%H:%M", time.localtime(time.time() + seconds))
    return f"{len(selection.arms)} trainings{there}: done at about {finish}, in {duration(seconds)}"


def plan_words(selection: Selection, seconds: float) -> list[str]:
    """What will be trained, a line for each variant with its share of the time, and what is left out."""
    lines = [f"about {duration(selection.seconds)} of {duration(seconds)} in all"]
    for variant in VARIANTS:
        arms = [arm for arm in selection.arms if arm.variant == variant]
        if arms:
            share = sum(arm.seconds for arm in arms) / selection.seconds
            settings = len({(arm.downscale, arm.steps) for arm in arms})
            sizes = ", ".join(resolution_words(size) for size in sorted({arm.downscale for arm in arms}))
            steps = [arm.steps for arm in arms]
            span = f"{min(steps):,}" if min(steps) == max(steps) else f"{min(steps):,} to {max(steps):,}"
            seeds = f"{len(arms)} trainings" if len(arms) > settings else "one seed each"
            lines.append(f"{variant}: {settings} × {span} steps at {sizes}, {seeds}, {share:.0%} of the time")
    if selection.left_out:
        lines.append(f"left out for want of time: {'; '.join(selection.left_out)}")
    return lines


def _run_all(
    config: Config,
    selection: Selection,
    exam: "Exam",
    inputs: Inputs,
    folder: Path,
    progress: Progress,
    spent: Callable[[], float],
) -> tuple[list[Trial], tuple[str, ...]]:
    """Every arm that the time allows, the first one in any case: whatever killed attempts took, asking again helps. And
    those that it does not. ``spent`` tells the seconds that the study has taken so far, such attempts included."""
    from stages.tradeoff.trial import figures_file, kept, run_arm

    trials, late, worked, expected, arms = list[Trial](), list[Arm](), 0.0, 0.0, folder / "arms"
    slowness = 1.0
    for number, arm in enumerate(selection.arms, 1):
        too_late = spent() + arm.seconds * slowness > (1 + LATE) * config.seconds
        if trials and too_late and kept(figures_file(arm, arms)) is None:
            late.append(arm)
            continue
        inner = _ArmProgress(progress, f"{number}/{len(selection.arms)} {arm.variant}", spent() / config.seconds)
        figures = run_arm(arm, exam, inputs, arms, inner)
        trials.append(Trial(arm, figures))
        worked, expected = worked + figures["wall_seconds"], expected + arm.seconds
        slowness = worked / expected
        progress.note(f"{number}/{len(selection.arms)} {_trial_words(arm, figures)}")
    named = in_words(late)
    if late:
        why = "the machine is slower than when it was measured" if slowness > 1 else "no time left"
        progress.note(f"{why}; not trained: {'; '.join(named)}")
    return trials, named


def _trial_words(arm: Arm, figures: dict[str, Any]) -> str:
    if figures["failed"]:
        return f"{arm.words}: no result ({figures['failed']})"
    again = f", started again {figures['restarts']} times" if figures["restarts"] else ""
    return f"{arm.words}: {figures['psnr']:.2f} dB in {duration(figures['train_seconds'])}{again}"


class _ArmProgress:
    """A Progress for one arm: live lines under its name and the study's share of the time; its notes are kept back, for
    the study says in one line what became of it."""

    def __init__(self, progress: Progress, name: str, done: float) -> None:
        self.progress, self.name, self.done = progress, name, min(1.0, done)

    def update(self, message: str, done: float | None = None) -> None:
        """As the arm's, under its name; the share is the study's."""
        del done
        self.progress.update(f"{self.name} · {message}", self.done)

    def note(self, message: str) -> None:
        """As a live line."""
        self.update(message)


def _written(
    config: Config,
    trials: Sequence[Trial],
    own: "Own | None",
    left_out: Sequence[str],
    exam: "Exam",
    folder: Path,
    workspace: str,
) -> StageResult:
    """Write everything. What depends on the clock are records, and so is what the workspace's ``own`` field says; the
    scores of the trainings are outputs. ``workspace``: the name of its folder, for the command to give."""
    from stages.tradeoff.ablation import ablation_picture, worth_words
    from stages.tradeoff.pareto_front import command, points_of, recommend, table
    from stages.tradeoff.plot import write_plot

    assert config.space, "plan() reads it"
    points = points_of(trials, own.point if own else None)
    recommendation = recommend(points)
    chosen = recommendation.point
    thinned = [trial.arm.variant for trial in trials if trial.arm.every > 1]
    thinned += [OWN] if own and own.every > 1 else []
    study = {
        "headline": recommendation.headline,
        "recommendation": recommendation.words,
        "command": command(chosen, config.space, workspace),
        "recommended": points.index(chosen) + 1,
        "still_rising": recommendation.still_rising,
        "scored": _scored_on(config, exam, thinned),
        "points": table(points),
        "fields": meanings({point.variant for point in points}, config.space),
        "own": own and {"train": own.key, "every": own.every},
        "ablation": worth_words(trials, config.downscale or 1.0),
        "arms": [{**trial.arm._asdict(), **trial.figures} for trial in trials],
        "left_out": list(left_out),
    }
    write_json(folder / "tradeoff.json", study)
    write_json(folder / "quality.json", [_quality(trial) for trial in trials])
    (folder / "tradeoff.md").write_text(markdown(study), "utf-8")
    write_plot(study, folder)
    pictures = ablation_picture(trials, exam, study["ablation"], folder)
    line = f"{len(points)} settings, {sum(row['front'] for row in study['points'])} on the front · "
    if failed := sum(trial.figures["failed"] is not None for trial in trials):
        line += f"{failed} of {len(trials)} trainings without a result · "
    records = ("tradeoff.json", "tradeoff.md", "tradeoff.svg", "tradeoff.png")
    facts = {"recommendation": recommendation.words, "settings": len(points), "trainings": len(trials)}
    line += f"{recommendation.words} Train it: {study['command']}"
    return StageResult(("quality.json", *pictures), line, records, facts)


def _quality(trial: Trial) -> dict[str, Any]:
    """What a training of so many steps gives, whenever it is run."""
    figures = {key: trial.figures.get(key) for key in ("psnr", "ssim", "model_mb", "failed")}
    return {**trial.arm.options, "variant": trial.arm.variant, **figures}


def _scored_on(config: Config, exam: "Exam", thinned: Sequence[str]) -> str:
    """What scores are of; ``thinned`` are the variants that are scored on fewer pixels."""
    from stages.tradeoff.trial import WINDOW

    photos = len({window.photo for window in exam.windows})
    assert config.downscale
    slow = ", ".join(dict.fromkeys(thinned))
    but = f"; {slow}: one in {THINNED} of their rows and columns, for drawing all would take too long"
    return (
        f"{len(exam.windows)} windows of {WINDOW} × {WINDOW} pixels of {photos} held-out photo{'s' * (photos > 1)} "
        f"at {resolution_words(config.downscale)}, the same for all{but if slow else ''}"
    )


def markdown(study: dict[str, Any]) -> str:
    """tradeoff.md: the recommendation and the table. Bold rows are those that nothing beats."""
    lines = [study["recommendation"], "", f"Train it: `{study['command']}`", "", f"Scored on {study['scored']}.", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for row in study["points"]:
        shown = [f"**{cell}**" if row["front"] else cell for cell in cells(row)]
        lines.append("| " + " | ".join(shown) + " |")
    lines += ["", drawing_words(study["points"]), "", f"Fields: {study['fields']}."]
    if study["ablation"]:
        lines += ["", study["ablation"]]
    if study["left_out"]:
        lines += ["", f"Left out, for want of time unless a reason is given: {'; '.join(study['left_out'])}."]
    return "\n".join(lines) + "\n"


def drawing_words(rows: Sequence[dict[str, Any]]) -> str:
    """What the front does not tell."""
    row = next(row for row in rows if row["cheapest_drawn"])
    least = f"number {row['number']} is drawn in the least time, {row['frame_seconds']:.2f} s a frame"
    return f"The front is of training time and quality only. Of its points {least} (◂)."


def cells(row: dict[str, Any]) -> list[str]:
    """A point's row of the table, as COLUMNS has it."""
    spread = "" if row["deviation"] is None else f" ± {row['deviation']:.2f}"
    spread_ssim = "" if row["ssim_deviation"] is None else f" ± {row['ssim_deviation']:.3f}"
    return [
        str(row["number"]),
        row["variant"] + " ★" * (row["variant"] == OWN),
        resolution_words(row["downscale"]),
        f"{row['steps']:,}",
        f"{row['train_seconds']:.1f} s",
        f"{row['frame_seconds']:.2f} s" + " ◂" * row["cheapest_drawn"],
        "–" if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:,.0f} MB",
        f"{row['model_mb']:.1f} MB",
        f"{row['psnr']:.2f}{spread}",
        "–" if row["ssim"] is None else f"{row['ssim']:.3f}{spread_ssim}",
        str(row["seeds"]),
    ]
