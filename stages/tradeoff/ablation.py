"""What each part of the method is worth: the reduced networks without it against the complete ones, in numbers and in
pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.tradeoff.runs import ABLATIONS, REDUCED, Arm, resolution_words
from stages.tradeoff.trial import strip_file, write_strip

if TYPE_CHECKING:
    from stages.tradeoff.trial import Exam

Trials = Sequence[tuple[Arm, Mapping[str, Any]]]


class Worth(NamedTuple):
    """PSNR without a part less that of the complete method: mean over pairs of trainings that have their seed, photo
    size and steps in common, and their standard deviation, None for one pair."""

    variant: str
    difference: float
    deviation: float | None
    seeds: int

    @property
    def words(self) -> str:
        """``−2.4 ± 0.2 dB``."""
        spread = "" if self.deviation is None else f" ± {self.deviation:.2f}"
        return f"{self.difference:+.2f}{spread} dB".replace("-", "−")


def worth(trials: Trials) -> list[Worth]:
    """Of every part that was left out of a training whose complete counterpart was scored, too."""
    scores = {
        (arm.variant, arm.downscale, arm.steps, arm.seed): figures["psnr"]
        for arm, figures in trials
        if figures["failed"] is None
    }
    found = []
    for variant in ABLATIONS:
        pairs = [(psnr, scores.get((REDUCED, *key[1:]))) for key, psnr in scores.items() if key[0] == variant]
        differences = [without - complete for without, complete in pairs if complete is not None]
        if differences:
            deviation = stdev(differences) if len(differences) > 1 else None
            found.append(Worth(variant, mean(differences), deviation, len(differences)))
    return found


def worth_words(trials: Trials, scored_at: float) -> str | None:
    """The differences in a sentence, of scores at 1/``scored_at`` of the resolution; None where there are none."""
    found = worth(trials)
    if not found:
        return None
    arm = next(arm for arm, figures in trials if arm.variant == found[0].variant and figures["failed"] is None)
    seeds = max(part.seeds for part in found)
    pairs = f"seed by seed, of {seeds} seeds (± their standard deviation)" if seeds > 1 else "of one seed"
    differences = "; ".join(f"{part.variant} {part.words}" for part in found)
    sizes = f"trained on photos at {resolution_words(arm.downscale)}, scored at {resolution_words(scored_at)}"
    return f"Against the complete reduced method, {pairs}: {differences}; {arm.steps:,} steps each, {sizes}."


def ablation_picture(trials: Trials, exam: "Exam", words: str | None, folder: Path) -> tuple[str, ...]:
    """ablation.png: held-out photos beside what the method, each variant of it and the study's best field make of them,
    and ``words`` below; the names of the files written, none where no ablation was run."""
    from stages.tradeoff.plot import Row, write_sheet

    done = [(arm, figures) for arm, figures in trials if figures["failed"] is None and arm.every == 1]
    ablated = next((arm for arm, _ in done if arm.variant in ABLATIONS), None)
    if ablated is None:
        return ()
    arms = folder / "arms"
    write_strip(arms / "photo.png", [photo.truth for photo in exam.photos])
    rows, worths = [Row("photo", (), arms / "photo.png")], {part.variant: part.words for part in worth(trials)}
    for arm, figures in done:
        same = (arm.downscale, arm.steps, arm.seed) == (ablated.downscale, ablated.steps, ablated.seed)
        if same and arm.variant in (REDUCED, *ABLATIONS):
            lines = [f"{figures['psnr']:.1f} dB", *([worths[arm.variant]] if arm.variant in worths else [])]
            rows.append(Row(arm.variant, tuple(lines), strip_file(arm, arms)))
    best, figures = max(done, key=lambda trial: trial[1]["psnr"])
    rows.append(Row(f"best: {best.variant}", (f"{figures['psnr']:.1f} dB",), strip_file(best, arms)))
    write_sheet(rows, words or "", folder / "ablation.png")
    return ("ablation.png",)
