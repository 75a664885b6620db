"""At which of torch's precisions a training computes its matrix products: "medium" where it is measured to pay.

A run in seconds may choose by a measurement, as it does its sizes: the choice is kept and enters the key. A run counted
in steps promises the same bytes every time, which no measurement does: it takes "highest" unless told otherwise.
"""

from typing import Any

import torch

from nerf.runtime.matmul_precision import MediumPrecision, Precision, measure_medium_matmul
from stages.contract import Progress
from stages.hardware.device import compute_device
from stages.train.config import Config
from stages.train.fields.field_list import field_of


def chosen_precision(config: Config, progress: Progress) -> Precision:
    """For the products of a training whose field and sizes of networks are known; "medium" is said."""
    if config.steps is not None or not field_of(config).multiplies_by_torch(config):
        return "highest"
    medium = _medium(config)
    if not medium.is_worthwhile:
        return "highest"
    progress.note(
        "train.matmul-medium",
        f"matrix multiplications at torch's precision medium: {medium.speedup:.1f} times faster here, with an error "
        f"of {medium.error:.0e}",
    )
    return "medium"


def say_if_inexact(config: Config, progress: Progress) -> None:
    """Where a precision that was asked for, or chosen on another machine, means less here."""
    concerned = config.matmul == "medium" and field_of(config).multiplies_by_torch(config)
    if concerned and not (medium := _medium(config)).is_exact:
        progress.note(
            "train.matmul-inexact",
            f"matrix multiplications have an error of {medium.error:.0e} here; --train.matmul highest makes them exact",
        )


def precision_facts(config: Config) -> dict[str, Any]:
    """For the manifest: the precision, and what "medium" is on this machine, where torch multiplies."""
    if not field_of(config).multiplies_by_torch(config):
        return {"matmul": config.matmul}
    medium = _medium(config)
    return {
        "matmul": config.matmul,
        "medium_matmul_speedup": round(medium.speedup, 2),
        "medium_matmul_error": float(f"{medium.error:.1e}"),
    }


def _medium(config: Config) -> MediumPrecision:
    """Measured at the width of the field's networks."""
    return measure_medium_matmul(torch.device(compute_device()), field_of(config).matmul_width(config))
