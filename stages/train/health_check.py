"""The health check of a field in training, on training photos alone: has it collapsed or diverged?

The full check runs once after the first steps and at the end. In between the batch PSNR, which costs nothing, tells
when it is due: whenever it is near that of a flat colour, before a checkpoint replaces an older one.
"""

from nerf.training.evaluation_pixels import EvaluationPixels, evaluate
from nerf.training.trainer import FieldTrainer

MIN_OPACITY = 1e-3  # a field of less mean opacity shows nothing but background
FULL_CHECK_MARGIN_DB = 3.0  # above a flat colour: batches that are no better may come from a collapsed field


class TrainingFailure(Exception):
    """The field in training has collapsed or diverged, for the reason given. Training rolls back or restarts."""


def failure_reason(trainer: FieldTrainer, pixels: EvaluationPixels) -> str | None:
    """Why the field, as the training photos see it, has collapsed or diverged; None if it has not."""
    if name := non_finite_tensor(trainer):
        return f"its {name} is not finite"
    try:
        rendered = evaluate(trainer.model, pixels, trainer.effects)
    except ValueError as error:  # the PSNR is not finite
        return f"its rendering is not finite: {error}"
    if not rendered.opacity >= MIN_OPACITY:  # nor is NaN
        return f"it is empty (mean opacity {rendered.opacity:.0e})"
    if not rendered.psnr > pixels.mean_colour_psnr:
        return f"it is no better than a flat colour ({rendered.psnr:.1f} of {pixels.mean_colour_psnr:.1f} dB)"
    return None


def needs_full_check(batch_psnr: float, pixels: EvaluationPixels) -> bool:
    """Whether batches as bad as this call for :func:`failure_reason`."""
    return not batch_psnr > pixels.mean_colour_psnr + FULL_CHECK_MARGIN_DB


def non_finite_tensor(trainer: FieldTrainer) -> str | None:
    """The name of a state tensor that is not finite, which the update after a finite loss can cause; None if there is
    none."""
    state = trainer.state().items()
    return next((name for name, one in state if one.is_floating_point() and not bool(one.isfinite().all())), None)
