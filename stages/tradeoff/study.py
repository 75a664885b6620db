"""A study from plan to recommendation: choose its runs, train and score them one by one, write what was found."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any, NamedTuple

from nerf.geometry.scene import Scene
from stages.contract import Inputs, Progress, SilentProgress, StageError, StageResult
from stages.effects.decisions import read_decisions
from stages.evaluate.tiles import MIN_TILES, TILE_SIZE
from stages.hardware.cluster import fan_out
from stages.io.amounts import counted, duration, duration_option, resolution_name
from stages.io.files import read_scene, write_json
from stages.io.stopwatch import counting
from stages.tradeoff import plots
from stages.tradeoff.benchmark import (
    NUM_SHOWN,
    Benchmark,
    WorkspaceField,
    figures_file,
    make_benchmark,
    read_figures,
    score_workspace_field,
    strip_file,
    train_and_score,
    write_strip,
)
from stages.tradeoff.pareto_front import points_of, recommend, table, workspace_point
from stages.tradeoff.schedule import (
    ABLATIONS,
    MIN_STEPS,
    REDUCED,
    SCORING_STRIDE,
    SMALL_SIDE,
    VARIANTS,
    WORKSPACE_FIELD,
    ReadingTime,
    Run,
    Schedule,
    Speed,
    describe,
    list_runs,
    make_schedule,
    measure_reading,
    measure_speeds,
    rendered_rays_per_second,
    study_sizes,
    train_command,
)
from stages.train.fields.space import chosen_space

if TYPE_CHECKING:
    from stages.tradeoff import Config

MAX_TILES = 512  # or as few of each test photo as make a score
SCORING_TIME = 0.003  # of the study's time: for rendering all tiles once, whatever the field but the published one
MIN_SLOWNESS = 1.05  # of runs against the time expected of them, to be given as the reason
MAX_LATE = 0.1  # of the study's time by which it may end late before runs are left out


class Result(NamedTuple):
    """A run that was made, and its figures."""

    run: Run
    figures: dict[str, Any]


class Outcome(NamedTuple):
    """All that a study found. ``left_out`` are the runs without a score, in words."""

    results: list[Result]
    left_out: tuple[str, ...]
    existing: WorkspaceField | None
    benchmark: Benchmark


# --- plan


def plan_study(config: "Config", inputs: Inputs, progress: Progress) -> "Config":
    """Measure how fast this machine trains each kind of field and reads photos; choose photo sizes and tiles."""
    scene = _scene_with_test_photos(inputs)
    speeds = measure_speeds(scene, inputs, config.seconds, progress)
    sizes = config.sizes or study_sizes(scene, speeds, config.seconds)
    quick = [name for name in speeds if VARIANTS[name].family != "published"]
    rendering = min(rendered_rays_per_second(name, speeds[name]) for name in quick)
    affordable = int(SCORING_TIME * config.seconds * rendering / TILE_SIZE**2)
    reading = measure_reading(scene, inputs["ingest"])
    chosen: dict[str, Any] = {
        "speeds": {name: (round(speed.steps, 4), round(speed.rays, 2)) for name, speed in speeds.items()},
        "space": chosen_space(read_decisions(inputs["effects"]), scene)[0],
        "sizes": sizes,
        "tiles": max(min(affordable, MAX_TILES), MIN_TILES * len(scene.of_split("test"))),
        "reading": (round(reading.photos, 5), round(reading.scored, 5)),
    }
    planned = config.model_copy(update=chosen)
    schedule_of(planned)  # too little time is said before the choice is kept: the next attempt measures anew
    return planned


def _scene_with_test_photos(inputs: Inputs) -> Scene:
    scene = read_scene(inputs["normalise"])
    if not scene.of_split("test"):
        why = "this scene has no test photos"
        hint = "Lower --normalise.test-every, or add photos."
        raise StageError("tradeoff.no-test-photos", "nothing to score the study on", why, hint)
    return scene


def schedule_of(config: "Config") -> Schedule:
    """The runs of a planned study.

    Raises:
        StageError: where the time does not allow a single one, with the time that allows two settings.
    """
    schedule = _schedule(config, config.seconds)
    if not schedule.runs:
        why = f"no field can be trained for {MIN_STEPS} steps and scored in {duration(config.seconds)} here"
        enough = f"--budget {duration_option(_enough_seconds(config))}"
        hint = f"Give at least about {enough}, which compares two settings; more time compares more."
        raise StageError("tradeoff.too-little-time", "too little time for a study", why, hint)
    return schedule


def _enough_seconds(config: "Config") -> int:
    """The time that allows two settings, as round as a user would give it."""
    seconds = 0
    while len({(run.variant, run.downscale, run.steps) for run in _schedule(config, seconds).runs}) < 2:
        step = 10 if seconds < 600 else 60
        seconds = step * math.ceil(max(config.seconds, 1.1 * seconds) / step)
    return seconds


def _schedule(config: "Config", seconds: float) -> Schedule:
    """The runs of a planned study if it had so many ``seconds``."""
    assert config.speeds and config.space and config.sizes and config.tiles and config.reading, "plan() chooses them"
    speeds = {name: Speed(*speed) for name, speed in config.speeds.items()}
    rays = config.tiles * TILE_SIZE**2 + NUM_SHOWN * SMALL_SIDE**2
    return make_schedule(seconds, config.seeds, config.space, config.sizes, speeds, rays, ReadingTime(*config.reading))


def schedule_lines(schedule: Schedule, seconds: float, runs: Path) -> list[str]:
    """How many runs there are to do, some of which an earlier attempt has left in the folder ``runs``, and when they
    are expected to be done; a line for each variant with its share of the time; what is left out."""
    to_do = [run for run in schedule.runs if read_figures(figures_file(run, runs)) is None]
    expected = sum(run.seconds for run in to_do)
    done = f", {len(schedule.runs) - len(to_do)} of them done" if len(to_do) < len(schedule.runs) else ""
    finish = time.strftime("%H:%M", time.localtime(time.time() + expected))
    lines = [f"{counted(len(schedule.runs), 'run')}{done}: about {duration(expected)}, until {finish}"]
    lines.append(f"about {duration(schedule.seconds)} of {duration(seconds)} in all")
    for variant in VARIANTS:
        chosen = [run for run in schedule.runs if run.variant == variant]
        if chosen:
            share = sum(run.seconds for run in chosen) / schedule.seconds
            settings = len({(run.downscale, run.steps) for run in chosen})
            sizes = ", ".join(resolution_name(size) for size in sorted({run.downscale for run in chosen}))
            steps = [run.steps for run in chosen]
            span = f"{min(steps):,}" if min(steps) == max(steps) else f"{min(steps):,} to {max(steps):,}"
            seeds = f"{len(chosen)} runs" if len(chosen) > settings else "one seed each"
            lines.append(f"{variant}: {settings} × {span} steps at {sizes}, {seeds}, {share:.0%} of the time")
    if schedule.left_out:
        lines.append(f"left out for lack of time: {'; '.join(list_runs(schedule.left_out))}")
    return lines


# --- run


def run_study(config: "Config", inputs: Inputs, folder: Path, progress: Progress) -> Outcome:
    """Make and score the runs of a planned study, and score the workspace's field on the same tiles.

    Raises:
        StageError: without test photos, without time for a run, where every run failed, or where one could not be
            trained for want of memory or disk.
    """
    schedule, runs = schedule_of(config), folder / "runs"
    for line in schedule_lines(schedule, config.seconds, runs):
        progress.note("tradeoff.schedule", line)
    with counting(folder / "clock.json") as spent:
        benchmark = _benchmark(config, inputs)
        places = {run: f"{number}/{len(schedule.runs)}" for number, run in enumerate(schedule.runs, 1)}
        results, late, slowness = list[Result](), list[Run](), 1.0

        def affordable() -> Iterator[Run]:
            for run in schedule.runs:
                too_late = spent() + run.seconds * slowness > (1 + MAX_LATE) * config.seconds
                # The first one is made in any case: whatever killed attempts took, asking again helps.
                if results and too_late and read_figures(figures_file(run, runs)) is None:
                    late.append(run)
                else:
                    yield run

        def here(work: object, chosen: Iterable[Run]) -> Iterator[Result]:
            for run in chosen:
                inner = _RunProgress(progress, f"{places[run]} {run.variant}", spent() / config.seconds)
                yield Result(run, train_and_score(run, benchmark, inputs, runs, inner))

        for result in fan_out(RunApart(config, dict(inputs), runs), affordable(), here, "machine"):
            results.append(result)
            slowness = sum(r.figures["wall_seconds"] for r in results) / sum(r.run.seconds for r in results)
            progress.note("tradeoff.result", f"{places[result.run]} {_result_line(result)}")
        if late:
            why = f"runs took {slowness:.1f} × the time expected" if slowness >= MIN_SLOWNESS else "no time is left"
            progress.note("tradeoff.not-trained", f"{why}; not trained: {'; '.join(list_runs(late))}")
        failed = [f"{run.label} ({figures['failed']})" for run, figures in results if figures["failed"]]
        if len(failed) == len(results):
            why = "; ".join(dict.fromkeys(str(figures["failed"]) for _, figures in results))
            hint = "Correct the cameras or the masks, then give the same command again."
            raise StageError("tradeoff.no-result", "the study has no result", why, hint)
        last = _RunProgress(progress, WORKSPACE_FIELD, spent() / config.seconds)
        existing = score_workspace_field(benchmark, inputs, runs, config.seconds, last)
    return Outcome(results, (*list_runs((*schedule.left_out, *late)), *failed), existing, benchmark)


@dataclass(frozen=True)
class RunApart:
    """Makes runs of a study with these planned options on a machine of a cluster."""

    config: "Config"
    inputs: Inputs
    runs: Path

    @cached_property
    def benchmark(self) -> Benchmark:
        """What they are scored on."""
        return _benchmark(self.config, self.inputs)

    def __call__(self, run: Run) -> Result:
        """Train and score it."""
        return Result(run, train_and_score(run, self.benchmark, self.inputs, self.runs, SilentProgress()))


def _benchmark(config: "Config", inputs: Inputs) -> Benchmark:
    assert config.tiles and config.sizes, "plan() chooses them"
    scene = _scene_with_test_photos(inputs)
    return make_benchmark(inputs["ingest"], scene, config.downscale, config.tiles, config.sizes[-1])


def _result_line(result: Result) -> str:
    run, figures = result
    if figures["failed"]:
        return f"{run.label}: no result ({figures['failed']})"
    restarts = f", restarted {counted(figures['restarts'], 'time')}" if figures["restarts"] else ""
    return f"{run.label}: {figures['psnr']:.2f} dB in {duration(figures['train_seconds'])}{restarts}"


class _RunProgress:
    """A Progress for one run, or the score of the workspace's field: live lines under its name and the study's share of
    the time; its notes become live lines, because the study says in one line what came of it."""

    def __init__(self, progress: Progress, name: str, done: float) -> None:
        self.progress, self.name, self.done = progress, name, min(1.0, done)

    def update(self, message: str, done: float | None = None) -> None:
        """As the run's, under its name; the share is the study's."""
        del done
        self.progress.update(f"{self.name} · {message}", self.done)

    def note(self, code: str, text: str) -> None:
        """As a live line."""
        self.update(text)


# --- save


def save_study(config: "Config", outcome: Outcome, folder: Path, workspace: str) -> StageResult:
    """Write everything. What depends on the clock are records, and so is what the workspace's field says; the scores of
    the runs are outputs. ``workspace``: the name of its folder, for the command to give."""
    assert config.space, "plan() chooses them"
    results, existing = outcome.results, outcome.existing
    points = points_of(results, workspace_point(existing.facts, existing.figures) if existing else None)
    recommendation = recommend(points)
    chosen = recommendation.point
    study = {
        "headline": recommendation.headline,
        "recommendation": recommendation.words,
        "command": train_command(chosen.variant, chosen.train_seconds, chosen.downscale, config.space, workspace),
        "recommended": points.index(chosen) + 1,
        "still_rising": recommendation.still_rising,
        "scored": _scored_on(outcome),
        "points": table(points),
        "descriptions": describe({point.variant for point in points}, config.space),
        "workspace_field": existing and {"train": existing.key, "stride": existing.stride},
        "ablation": ablation_sentence(results, outcome.benchmark.size),
        "runs": [{**run._asdict(), **figures} for run, figures in results],
        "left_out": list(outcome.left_out),
    }
    write_json(folder / "tradeoff.json", study)
    write_json(folder / "quality.json", [_quality(result) for result in results])
    (folder / "tradeoff.md").write_text(plots.markdown(study), "utf-8")
    plots.write_plot(study, folder)
    pictures = _ablation_sheet(outcome, study["ablation"], folder)
    on_front = sum(row["pareto_front"] for row in study["points"])
    line = f"{counted(len(points), 'setting')}, {on_front} on the Pareto front · "
    if failed := sum(figures["failed"] is not None for _, figures in results):
        line += f"{failed} of {len(results)} runs without a result · "
    line += f"{recommendation.words} Train it: {study['command']}"
    records = ("tradeoff.json", "tradeoff.md", "tradeoff.svg", "tradeoff.png")
    facts = {"recommendation": recommendation.words, "settings": len(points), "runs": len(results)}
    return StageResult(("quality.json", *pictures), line, records, facts)


def _quality(result: Result) -> dict[str, Any]:
    """What a training of so many steps gives, whenever it is run."""
    figures = {key: result.figures.get(key) for key in ("psnr", "ssim", "model_mb", "failed")}
    return {**result.run.options, "variant": result.run.variant, **figures}


def _scored_on(outcome: Outcome) -> str:
    """What scores are of, and which fields are scored on fewer pixels."""
    slow = [run.variant for run, _ in outcome.results if run.stride > 1]
    slow += [WORKSPACE_FIELD] if outcome.existing and outcome.existing.stride > 1 else []
    crops, (width, height) = outcome.benchmark.crops, outcome.benchmark.size
    tiles = sum(len(crop.truth) // (crop.tile_rows or 1) for crop in crops)
    fewer = f"; {', '.join(dict.fromkeys(slow))}: one in {SCORING_STRIDE} of their rows and columns, to save time"
    return (
        f"{counted(tiles, 'tile')} of {TILE_SIZE} × {TILE_SIZE} pixels of {counted(len(crops), 'test photo')} "
        f"at {width} × {height}, the same for all{fewer if slow else ''}"
    )


# --- what each part of the method is worth: the reduced networks without it against the complete ones


class Worth(NamedTuple):
    """PSNR without a part minus that of the complete method: mean over pairs of runs that have their seed, photo size
    and steps in common, and their standard deviation, None for one pair."""

    variant: str
    difference: float
    std: float | None
    seeds: int

    @property
    def words(self) -> str:
        """``−2.40 ± 0.20 dB``."""
        spread = "" if self.std is None else f" ± {self.std:.2f}"
        return f"{self.difference:+.2f}{spread} dB".replace("-", "−")


def ablation_differences(results: Sequence[tuple[Run, Mapping[str, Any]]]) -> list[Worth]:
    """For every part that was left out of a run whose complete counterpart was scored, too."""
    scores = {
        (run.variant, run.downscale, run.steps, run.seed): figures["psnr"]
        for run, figures in results
        if figures["failed"] is None
    }
    found = []
    for variant in ABLATIONS:
        pairs = [(psnr, scores.get((REDUCED, *key[1:]))) for key, psnr in scores.items() if key[0] == variant]
        differences = [without - complete for without, complete in pairs if complete is not None]
        if differences:
            std = stdev(differences) if len(differences) > 1 else None
            found.append(Worth(variant, mean(differences), std, len(differences)))
    return found


def ablation_sentence(results: Sequence[tuple[Run, Mapping[str, Any]]], scored_size: tuple[int, int]) -> str | None:
    """The differences, of scores at this width and height; None where there are none."""
    found = ablation_differences(results)
    if not found:
        return None
    run = next(run for run, figures in results if run.variant == found[0].variant and figures["failed"] is None)
    seeds = max(part.seeds for part in found)
    pairs = f"seed by seed, of {seeds} seeds (± their standard deviation)" if seeds > 1 else "of one seed"
    differences = "; ".join(f"{part.variant} {part.words}" for part in found)
    sizes = f"trained on photos at {resolution_name(run.downscale)}, scored at {scored_size[0]} × {scored_size[1]}"
    return f"Against the complete reduced method, {pairs}: {differences}; {run.steps:,} steps each, {sizes}."


def _ablation_sheet(outcome: Outcome, sentence: str | None, folder: Path) -> tuple[str, ...]:
    """ablation.png: test photos beside what the method, each variant of it and the study's best field make of them,
    and the ``sentence`` below; the names of the files written, none where no ablation was run."""
    done = [(run, figures) for run, figures in outcome.results if figures["failed"] is None and run.stride == 1]
    ablated = next((run for run, _ in done if run.variant in ABLATIONS), None)
    if ablated is None:
        return ()
    runs = folder / "runs"
    write_strip(runs / "photo.png", [photo.truth for photo in outcome.benchmark.photos])
    rows = [plots.Row("photo", (), runs / "photo.png")]
    worths = {part.variant: part.words for part in ablation_differences(outcome.results)}
    for run, figures in done:
        same = (run.downscale, run.steps, run.seed) == (ablated.downscale, ablated.steps, ablated.seed)
        if same and run.variant in (REDUCED, *ABLATIONS):
            lines = [f"{figures['psnr']:.1f} dB", *([worths[run.variant]] if run.variant in worths else [])]
            rows.append(plots.Row(run.variant, tuple(lines), strip_file(run, runs)))
    best, figures = max(done, key=lambda result: result[1]["psnr"])
    rows.append(plots.Row(f"best: {best.variant}", (f"{figures['psnr']:.1f} dB",), strip_file(best, runs)))
    plots.write_sheet(rows, sentence or "", folder / "ablation.png")
    return ("ablation.png",)
