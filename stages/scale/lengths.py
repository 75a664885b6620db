"""Lengths and points as they are written in options."""

import math
import re

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048}


def parse_length(text: str) -> float:
    """Metres in ``50mm``, ``12.5 cm``, ``1.25m``, ``2in``, ``6ft``. Raises ValueError for anything else."""
    found = re.fullmatch(r"\s*([0-9.]+(?:e-?\d+)?)\s*(\w+)\s*", text)
    try:
        metres = float(found[1]) * METRES[found[2]] if found else 0.0
    except (KeyError, ValueError):
        metres = 0.0
    if not 0 < metres < math.inf:
        raise ValueError(f"{text!r} is not a length: write a number above 0 and its unit, such as 50mm or 1.25m")
    return metres


def length_in_words(metres: float) -> str:
    """``50 mm``, ``1.25 m``: a length with three digits in the unit that suits it."""
    unit, size = next(
        ((unit, size) for unit, size in (("km", 1000), ("m", 1), ("cm", 0.01)) if metres >= size), ("mm", 0.001)
    )
    return f"{metres / size:.3g} {unit}"


def parse_point(text: str) -> tuple[float, float, float]:
    """The coordinates in ``x,y,z``. Raises ValueError for anything else."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise ValueError(f"{text!r} is not a point: write x,y,z without spaces") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"{text!r} is not finite")
    return x, y, z
