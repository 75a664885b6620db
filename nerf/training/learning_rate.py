"""Learning rates by the progress of a run: the hash grid's warms up, stays and decays; the vanilla NeRF's falls all the
time, as published."""

LR_WARMUP_STEPS = 20
# Fraction of the run before the learning rate begins to decay. A decay over most of the run costs short runs up to 2 dB
# and gains long ones nothing (docs/experiments/learning_rate.md), and what is measured before it does not depend on how
# long the run will be.
LR_HOLD_FRACTION = 0.75
LR_FINAL_FRACTION = 0.05  # of the base learning rate


def lr_multiplier(step: int, progress: float) -> float:
    """The learning rate over its base: a linear warm-up, then constant, then falling exponentially."""
    decayed = max(0.0, progress - LR_HOLD_FRACTION) / (1 - LR_HOLD_FRACTION)
    return min(1.0, (step + 1) / LR_WARMUP_STEPS) * LR_FINAL_FRACTION**decayed


def learning_rate(progress: float, start: float, end: float) -> float:
    """From ``start`` to ``end`` exponentially in the progress of the run (Mildenhall et al. 2020, section 5.3)."""
    return start * (end / start) ** progress
