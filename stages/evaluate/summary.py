"""What the figures say: metrics.json over all photos, the stage's line, the verdict."""

from collections.abc import Sequence
from typing import Any

from stages.contract import Note
from stages.evaluate.image_metrics import ERROR_SCALE, MIN_FOR_INTERVAL, mean_interval
from stages.io.amounts import counted
from stages.train.data import MAX_SCORED_SIDE

RIGHT_HALVES = ("psnr_right_half", "psnr_exposure_fitted", "psnr_pose_fitted")
FIGURES = ("psnr", "ssim", "psnr_mean_image", "psnr_nearest_view", *RIGHT_HALVES)
MIN_TRUSTED_WIDTH = 0.5  # of the scores' usual one: below, an image can be sharp and the field know no fine detail
MIN_DIFFERENCE_DB = 0.5  # between two scores of right halves, to be mentioned
# Why nothing is measured, by whether there are test photos at all.
UNMEASURED = {False: "no photo was kept for testing", True: "masks leave nothing of the test photos"}
NO_LPIPS = Note(
    "evaluate.no-lpips", "LPIPS is not computed: no installed package has its weights, and nothing is downloaded"
)


def overall(images: list[dict[str, Any]], test_photos: int, notes: list[Note]) -> dict[str, Any]:
    """The figures over all photos, as metrics.json has them."""
    metrics: dict[str, Any] = {key: _mean([image[key] for image in images]) for key in FIGURES}
    for key in ("psnr", "ssim"):
        values = [image[key] for image in images if image[key] is not None]
        metrics[f"{key}_interval"] = mean_interval(values)
    more = list[Note]()
    if not images:
        what = f"{UNMEASURED[test_photos > 0]}, so nothing is measured"
        more.append(Note("evaluate.nothing-measured", what))
    elif len(images) < MIN_FOR_INTERVAL:
        what = f"no interval: {counted(len(images))} cannot show how much the figures vary"
        more.append(Note("evaluate.no-interval", what))
    if small := sum(image["psnr_right_half"] is None for image in images):
        why = "a half has too few pixels to fit an exposure or to score it"
        what = f"no half-image PSNR of {counted(small)}: {why}"
        more.append(Note("evaluate.small-halves", what))
    return metrics | {
        "lpips": None,
        "photos_scored": len(images),
        "photos_test": test_photos,
        "error_scale": [0, ERROR_SCALE],
        "notes": [note._asdict() for note in (*notes, *more, NO_LPIPS)],
        "images": images,
    }


def verdict(metrics: dict[str, Any]) -> str:
    """One sentence on how far the field can be trusted, from test PSNR, SSIM and the two trivial predictions.

    * no better than the mean image: unusable;
    * no better than the nearest training view: worse than showing that;
    * below 22 dB or SSIM 0.7: soft; below 27 dB or SSIM 0.85: good; else sharp, and trustworthy if at least three
      photos say so at no less than half of the usual width.
    """
    value, similarity, nearest, mean = (metrics[k] for k in ("psnr", "ssim", "psnr_nearest_view", "psnr_mean_image"))
    if value is None:
        return f"Not measured: {UNMEASURED[metrics['photos_test'] > 0]}."
    figures = f"{value:.1f} dB on {_unseen(metrics)}" + ("" if similarity is None else f", SSIM {similarity:.2f}")
    gain = f"{value - nearest:.1f} dB better than the nearest training view"
    if value <= mean:
        what = f"Unusable: {value:.1f} dB is no better than the mean training image ({mean:.1f} dB)"
        what += "; train longer, or add photos that overlap with these"  # doubtful cameras are the report's to tell
    elif value <= nearest:
        what = f"Worse than the nearest training view ({value:.1f} against {nearest:.1f} dB): train longer"
    elif value < 22 or _below(similarity, 0.7):
        what = f"Better than the nearest training view by {value - nearest:.1f} dB but soft: {figures}"
    elif value < 27 or _below(similarity, 0.85):
        what = f"Good, with fine detail missing: {figures}, {gain}"
    elif max(metrics["scored_size"]) < MIN_TRUSTED_WIDTH * min(max(metrics["photo_size"]), MAX_SCORED_SIDE):
        what = f"Sharp as a small image, with finer detail unscored: {figures}, {gain}"
    elif metrics["photos_scored"] < MIN_FOR_INTERVAL:
        what = f"Sharp, as far as {counted(metrics['photos_scored'])} can tell: {figures}, {gain}"
    else:
        what = f"Sharp and trustworthy: {figures}, {gain}"
    return what + "."


def line_of(metrics: dict[str, Any]) -> str:
    """21.4 ± 0.4 dB, SSIM 0.61 · nearest training view 14.2 dB, mean image 12.9 dB · 25% of each of 11 photos at
    1600 × 1067 (trained at 800 × 534)."""
    if metrics["psnr"] is None:
        return f"nothing measured: {UNMEASURED[metrics['photos_test'] > 0]}"
    interval = metrics["psnr_interval"]
    deviation = f" ± {(interval[1] - interval[0]) / 2:.1f}" if interval else ""
    similarity = "" if metrics["ssim"] is None else f", SSIM {metrics['ssim']:.2f}"
    trivial = (
        f"nearest training view {metrics['psnr_nearest_view']:.1f} dB, mean image {metrics['psnr_mean_image']:.1f} dB"
    )
    return f"{metrics['psnr']:.1f}{deviation} dB{similarity}{_right_halves(metrics)} · {trivial} · {scored_on(metrics)}"


def scored_on(metrics: dict[str, Any]) -> str:
    """25% of each of 11 photos at 1600 × 1067 (trained at 800 × 534)."""
    scored, test = metrics["photos_scored"], metrics["photos_test"]
    count = counted(scored) if scored == test else f"{scored} of {counted(test)}"
    return f"{_part(metrics, scored)}{count} at {_sizes(metrics)}"


def _unseen(metrics: dict[str, Any]) -> str:
    """25% of each of 11 test photos at 1600 × 1067 (trained at 800 × 534)."""
    scored = metrics["photos_scored"]
    return f"{_part(metrics, scored)}{counted(scored, 'test photo')} at {_sizes(metrics)}"


def _part(metrics: dict[str, Any], photos: int) -> str:
    """How much of the photos was scored, where that is not all."""
    each = "each of " if photos > 1 else ""
    return "" if metrics["fraction"] == 1 else f"{100 * metrics['fraction']:.3g}% of {each}"


def _sizes(metrics: dict[str, Any]) -> str:
    scored, trained = metrics["scored_size"], metrics["trained_size"]
    size = "" if [*scored] == [*trained] else f" (trained at {trained[0]} × {trained[1]})"
    return f"{scored[0]} × {scored[1]}{size}"


def _right_halves(metrics: dict[str, Any]) -> str:
    """The scores of right halves, where what is fitted on the left ones makes a difference."""
    right, fitted, posed = (metrics[key] for key in RIGHT_HALVES)
    if right is None or all(abs(s - right) <= MIN_DIFFERENCE_DB for s in (fitted, posed) if s is not None):
        return ""
    words = f" · right halves {right:.1f} dB, {fitted:.1f} dB with the exposure fitted on the left half"
    return words if posed is None else f"{words}, {posed:.1f} dB with the pose, too"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _below(value: float | None, limit: float) -> bool:
    return value is not None and value < limit
