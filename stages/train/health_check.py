"""Whether a field in training is sound, judged on training photos alone.

A field is examined in full after the warm-up and at the end. In between the PSNR of the batches, which costs nothing,
tells when to look: whenever it has come near that of a flat colour, before a checkpoint replaces an older one.
"""

from nerf.training.evaluation_pixels import EvaluationPixels, evaluate
from nerf.training.trainer import FieldTrainer

EMPTY_OPACITY = 1e-3  # a field whose mean opacity is below this shows nothing but background or sky
SUSPICIOUS_DB = 3.0  # above a flat colour: batches that are no better may come from a field that is lost


class Lost(Exception):
    """The field in training is useless: not finite, empty or flat, as the text says. Training goes back or restarts."""


def symptom_of(trainer: FieldTrainer, probe: EvaluationPixels) -> str | None:
    """What is wrong with the field as the training photos see it, or None."""
    if name := not_finite(trainer):
        return f"its {name} is not finite"
    try:
        seen = evaluate(trainer.model, probe, trainer.effects)
    except ValueError as error:  # of PSNR, which has no value there
        return f"it shows what is no number: {error}"
    if not seen.opacity >= EMPTY_OPACITY:  # nor is what is no number
        return f"it is empty (mean opacity {seen.opacity:.0e})"
    if not seen.psnr > probe.mean_colour_psnr:
        return f"it is no better than a flat colour ({seen.psnr:.1f} of {probe.mean_colour_psnr:.1f} dB)"
    return None


def is_suspicious(batch_psnr: float, probe: EvaluationPixels) -> bool:
    """Whether batches as bad as this ask for :func:`symptom_of`."""
    return not batch_psnr > probe.mean_colour_psnr + SUSPICIOUS_DB


def not_finite(trainer: FieldTrainer) -> str | None:
    """A tensor of the state with a number that is not finite: the update after the last finite loss can do that."""
    state = trainer.state().items()
    return next((name for name, one in state if one.is_floating_point() and not bool(one.isfinite().all())), None)
