"""curve.json: quality against training time, and what it says in words.

``{"field", "downscale", "device": "cpu" | "cuda", "threads", "single_cycle", "points": [{"step",
"seconds", "train_psnr", "probe_psnr", "probe_ssim"} …]}``; what cannot be measured is null. ``downscale`` is that of
the photos trained on. ``probe_psnr`` is of a fixed sample of pixels of all test photos, taken together, at the size at
which photos are scored: it follows the score, PSNR of stage evaluate, and is not it. Seconds are those of training
steps alone, without evaluations. ``single_cycle``: the learning rate decayed once, at the end: no finished run was
continued, and no target missed.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf.training.learning_curve import (
    MIN_DOUBLING_GAIN_DB,
    PredictedGain,
    diminishing_returns_seconds,
    last_doubling_gain,
    predicted_doubling_gain,
    quality_at,
)
from stages.hardware.device import compute_device, cores
from stages.io.amounts import duration, duration_option
from stages.io.files import write_json
from stages.train.config import OPTIONS_OF_FIELD, FieldName

BARS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 10


def write_curve(
    folder: Path, field: FieldName, downscale: float, single_cycle: bool, points: list[dict[str, Any]]
) -> None:
    """Write curve.json of a run that ends on this machine."""
    about = {"field": field, "downscale": downscale, "device": compute_device(), "threads": cores()}
    about["single_cycle"] = single_cycle
    write_json(folder / "curve.json", about | {"points": points})


def probe_curve(points: Sequence[dict[str, Any]]) -> list[tuple[float, float]]:
    """(seconds, dB on the test probe), as nerf/training/learning_curve.py reads it."""
    known = ((point["seconds"], point["probe_psnr"]) for point in points)
    return [(seconds, psnr) for seconds, psnr in known if psnr is not None and seconds > 0]


def predicted_gain(field: FieldName, single_cycle: bool, points: Sequence[dict[str, Any]]) -> PredictedGain | None:
    """The predicted gain of twice the training time at the same sizes of photos and field, as ``--more`` keeps them.
    None if the curve is too short, and for runs that the prediction was not fitted to: those of another field than the
    hash grid, and those not of a ``single_cycle``, which may have decayed at half of the time."""
    fitted = single_cycle and OPTIONS_OF_FIELD[field].predicts_gains
    return predicted_doubling_gain(probe_curve(points), points[-1]["step"]) if points and fitted else None


def doubling_message(points: Sequence[dict[str, Any]], gain: PredictedGain | None) -> str | None:
    """The gain of the last doubling of the time, and the predicted one of the next; None if the curve is too short."""
    curve = probe_curve(points)
    last = last_doubling_gain(curve)
    if last is None:
        return None
    message = f"the last doubling of training time, to {duration(curve[-1][0])}, gained {last:+z.1f} dB on test pixels"
    if gain is None:
        return message
    message += " (a separate run of half the time would end higher, so the gain over it is smaller)"
    again = f"twice the training time at these sizes ({more_option(points)})"
    return f"{message}; {again} is predicted to gain {gain.db:+z.1f} dB (± {gain.half_width:.1f})"


def predicted_gain_message(points: Sequence[dict[str, Any]], gain: PredictedGain | None) -> str | None:
    """The second part of :func:`doubling_message`, in short."""
    if gain is None:
        return None
    much = f"{gain.db:+z.1f} ± {gain.half_width:.1f} dB"
    return f"twice the training time ({more_option(points)}) is predicted to gain {much}"


def more_option(points: Sequence[dict[str, Any]]) -> str:
    """``--more 3m``, for as long again."""
    return f"--more {duration_option(points[-1]['seconds'])}"


def target_message(target: float | None, reached: float | None, seconds: float) -> str | None:
    """Whether a target was reached, and after how long; None where there was none."""
    if target is None or reached is None:
        return None
    if reached >= target:
        return f"{target:g} dB reached on validation photos after {duration(seconds)}"
    return f"{target:g} dB not reached in {duration(seconds)}: {reached:.1f} dB on validation photos"


def diminishing_returns_message(points: Sequence[dict[str, Any]]) -> str | None:
    """From when on returns diminish, if they do; None if the curve is too short to tell."""
    curve = probe_curve(points)
    if last_doubling_gain(curve) is None:
        return None
    start = diminishing_returns_seconds(curve)
    if start is None:
        return f"no diminishing returns yet: the last doubling gained more than {MIN_DOUBLING_GAIN_DB:g} dB"
    return f"diminishing returns from {duration(start)} on: each doubling gained less than {MIN_DOUBLING_GAIN_DB:g} dB"


def ssim_message(points: Sequence[dict[str, Any]]) -> str | None:
    """SSIM at the end and at half of the time; None if it is not known."""
    known = [(p["seconds"], p["probe_ssim"]) for p in points if p["probe_ssim"] is not None and p["seconds"] > 0]
    if len(known) < 2 or known[0][0] > known[-1][0] / 2:
        return None
    before, after = quality_at(known, known[-1][0] / 2), known[-1][1]
    if f"{before:.2f}" == f"{after:.2f}":
        return f"SSIM stayed at {after:.2f} in that doubling"
    return f"SSIM {'rose' if after > before else 'fell'} from {before:.2f} to {after:.2f} in that doubling"


def sparkline(points: Sequence[dict[str, Any]]) -> str:
    """Held-out PSNR from the first evaluation to the last, even in log time; "" for fewer than three."""
    curve = probe_curve(points)
    if len(curve) < 3:
        return ""
    first, ratio = curve[0][0], curve[-1][0] / curve[0][0]
    times = [first * ratio ** (k / (SPARK_WIDTH - 1)) for k in range(SPARK_WIDTH)]
    values = [quality_at(curve, min(time, curve[-1][0])) for time in times]
    low, high = min(values), max(values)
    if high == low:
        return BARS[0] * SPARK_WIDTH
    return "".join(BARS[round((value - low) / (high - low) * (len(BARS) - 1))] for value in values)
