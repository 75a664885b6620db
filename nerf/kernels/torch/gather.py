"""Rows of a table by their numbers."""

from jaxtyping import Float, Int32
from torch import Tensor


def gather_rows(values: Float[Tensor, "rows width"], rows: Int32[Tensor, "chosen"]) -> Float[Tensor, "chosen width"]:
    """``values[rows]``. The width is a multiple of four."""
    return values.index_select(0, rows)
