"""curve.json: quality against training time, and what it says in words.

``{"field", "downscale", "device": "cpu" | "cuda", "threads", "whole", "points": [{"step", "seconds",
"train_psnr", "heldout_psnr", "heldout_ssim"} …]}``; what cannot be measured is null. ``downscale`` is that of the
photos, those measured on included. Seconds are those of training steps alone: measuring is not among them. ``whole``:
the rate fell once, at the end, and never rose again to go on.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf.training.learning_curve import KNEE_DB, Gain, knee, last_doubling, next_doubling, quality_at
from stages.amounts import duration, duration_option
from stages.hardware.device import compute_device, cores
from stages.io.files import write_json
from stages.train.config import OPTIONS_OF_FIELD, FieldName

BARS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 10


def write_curve(folder: Path, field: FieldName, downscale: float, whole: bool, points: list[dict[str, Any]]) -> None:
    """Write curve.json of a run that ends on this machine."""
    about = {"field": field, "downscale": downscale, "device": compute_device(), "threads": cores(), "whole": whole}
    write_json(folder / "curve.json", about | {"points": points})


def heldout_curve(points: Sequence[dict[str, Any]]) -> list[tuple[float, float]]:
    """(seconds, dB on held-out photos), as nerf/training/learning_curve.py reads it."""
    known = ((point["seconds"], point["heldout_psnr"]) for point in points)
    return [(seconds, psnr) for seconds, psnr in known if psnr is not None and seconds > 0]


def coming_doubling(field: FieldName, whole: bool, points: Sequence[dict[str, Any]]) -> Gain | None:
    """What the next doubling of the time is predicted to buy at the same sizes of photos and field, as ``--more`` keeps
    them; None where the curve is too short, and for what the prediction was not fitted to: another field than the hash
    grid, and a run that is not ``whole``, where half of the time may have ended annealed, too."""
    fitted = whole and OPTIONS_OF_FIELD[field].predicts_gains
    return next_doubling(heldout_curve(points), points[-1]["step"]) if points and fitted else None


def doubling_words(points: Sequence[dict[str, Any]], coming: Gain | None) -> str | None:
    """What the last doubling of the time bought and what is ``coming``; None where the curve is too short."""
    curve = heldout_curve(points)
    last = last_doubling(curve)
    if last is None:
        return None
    words = (
        f"the last doubling of training time, to {duration(curve[-1][0])}, bought {last:+z.1f} dB on held-out photos"
    )
    if coming is None:
        return words
    words += " (less over a run of half the time, which would have ended above this curve)"
    again = f"as long again at these sizes ({more_option(points)})"
    return f"{words}; {again} is predicted to buy {coming.db:+z.1f} dB (± {coming.half_width:.1f})"


def next_words(points: Sequence[dict[str, Any]], coming: Gain | None) -> str | None:
    """:func:`doubling_words` for a line that has no room."""
    gain = coming and f"{coming.db:+z.1f} ± {coming.half_width:.1f} dB"
    return gain and f"as long again ({more_option(points)}) is predicted to buy {gain}"


def more_option(points: Sequence[dict[str, Any]]) -> str:
    """``--more 3m``: as long again."""
    return f"--more {duration_option(points[-1]['seconds'])}"


def target_words(target: float | None, reached: float | None, seconds: float) -> str | None:
    """Whether a target was reached, and after how long; None where there was none."""
    if target is None or reached is None:
        return None
    if reached >= target:
        return f"{target:g} dB reached after {duration(seconds)}, on photos set aside"
    return f"{target:g} dB not reached in {duration(seconds)}: {reached:.1f} on photos set aside"


def knee_words(points: Sequence[dict[str, Any]]) -> str | None:
    """Where the knee is, or that there is none; None where the curve is too short to tell."""
    curve = heldout_curve(points)
    if last_doubling(curve) is None:
        return None
    at = knee(curve)
    if at is None:
        return f"no knee yet: the last doubling bought more than {KNEE_DB:g} dB"
    return f"the knee is at {duration(at)}: from there on a doubling bought less than {KNEE_DB:g} dB"


def ssim_words(points: Sequence[dict[str, Any]]) -> str | None:
    """SSIM at the end and half of the time before; None where it is not known."""
    known = [(p["seconds"], p["heldout_ssim"]) for p in points if p["heldout_ssim"] is not None and p["seconds"] > 0]
    if len(known) < 2 or known[0][0] > known[-1][0] / 2:
        return None
    before, after = quality_at(known, known[-1][0] / 2), known[-1][1]
    if f"{before:.2f}" == f"{after:.2f}":
        return f"SSIM stayed at {after:.2f} in that doubling"
    return f"SSIM {'rose' if after > before else 'fell'} from {before:.2f} to {after:.2f} in that doubling"


def sparkline(points: Sequence[dict[str, Any]]) -> str:
    """Held-out PSNR from the first measurement to the last, even in log time; "" for fewer than three."""
    curve = heldout_curve(points)
    if len(curve) < 3:
        return ""
    first, ratio = curve[0][0], curve[-1][0] / curve[0][0]
    times = [first * ratio ** (k / (SPARK_WIDTH - 1)) for k in range(SPARK_WIDTH)]
    values = [quality_at(curve, min(time, curve[-1][0])) for time in times]
    low, high = min(values), max(values)
    if high == low:
        return BARS[0] * SPARK_WIDTH
    return "".join(BARS[round((value - low) / (high - low) * (len(BARS) - 1))] for value in values)
