"""curve.json: quality against training time, and what it says in words.

``{"field": "grid" | "paper", "downscale", "device": "cpu" | "cuda", "threads", "whole", "points": [{"step", "seconds",
"train_psnr", "probe_psnr", "probe_ssim"} …]}``; what cannot be measured is null. ``downscale`` is that of the
photos trained on. ``probe_psnr`` is of a fixed sample of pixels of all test photos, taken together, at the size at
which photos are scored: it follows the score, PSNR of stage evaluate, and is not it. Seconds are those of training
steps alone: measuring is not among them. ``whole``: the rate fell once, at the end, and never rose again to go on.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf.training.learning_curve import KNEE_DB, Gain, knee, last_doubling, next_doubling, quality_at
from stages.amounts import duration, duration_option
from stages.hardware.device import compute_device, cores
from stages.io.files import write_json

BARS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 10


def write_curve(folder: Path, field: str, downscale: float, whole: bool, points: list[dict[str, Any]]) -> None:
    """Write curve.json of a run that ends on this machine."""
    about = {"field": field, "downscale": downscale, "device": compute_device(), "threads": cores(), "whole": whole}
    write_json(folder / "curve.json", about | {"points": points})


def probe_curve(points: Sequence[dict[str, Any]]) -> list[tuple[float, float]]:
    """(seconds, dB on the test probe), as nerf/training/learning_curve.py reads it."""
    known = ((point["seconds"], point["probe_psnr"]) for point in points)
    return [(seconds, psnr) for seconds, psnr in known if psnr is not None and seconds > 0]


def coming_doubling(field: str, whole: bool, points: Sequence[dict[str, Any]]) -> Gain | None:
    """What the next doubling of the time is predicted to buy at the same sizes of photos and field, as ``--more`` keeps
    them; None where the curve is too short, and for what the prediction was not fitted to: the paper's field, whose
    rate falls all the way, and a run that is not ``whole``, where half of the time may have ended annealed, too."""
    return next_doubling(probe_curve(points), points[-1]["step"]) if points and field == "grid" and whole else None


def doubling_words(points: Sequence[dict[str, Any]], coming: Gain | None) -> str | None:
    """What the last doubling of the time bought and what is ``coming``; None where the curve is too short."""
    curve = probe_curve(points)
    last = last_doubling(curve)
    if last is None:
        return None
    words = f"the last doubling of training time, to {duration(curve[-1][0])}, bought {last:+z.1f} dB on test pixels"
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
        return f"{target:g} dB reached after {duration(seconds)}, on validation photos"
    return f"{target:g} dB not reached in {duration(seconds)}: {reached:.1f} on validation photos"


def knee_words(points: Sequence[dict[str, Any]]) -> str | None:
    """Where the knee is, or that there is none; None where the curve is too short to tell."""
    curve = probe_curve(points)
    if last_doubling(curve) is None:
        return None
    at = knee(curve)
    if at is None:
        return f"no knee yet: the last doubling bought more than {KNEE_DB:g} dB"
    return f"the knee is at {duration(at)}: from there on a doubling bought less than {KNEE_DB:g} dB"


def ssim_words(points: Sequence[dict[str, Any]]) -> str | None:
    """SSIM at the end and half of the time before; None where it is not known."""
    known = [(p["seconds"], p["probe_ssim"]) for p in points if p["probe_ssim"] is not None and p["seconds"] > 0]
    if len(known) < 2 or known[0][0] > known[-1][0] / 2:
        return None
    before, after = quality_at(known, known[-1][0] / 2), known[-1][1]
    if f"{before:.2f}" == f"{after:.2f}":
        return f"SSIM stayed at {after:.2f} in that doubling"
    return f"SSIM {'rose' if after > before else 'fell'} from {before:.2f} to {after:.2f} in that doubling"


def sparkline(points: Sequence[dict[str, Any]]) -> str:
    """Held-out PSNR from the first measurement to the last, even in log time; "" for fewer than three."""
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
