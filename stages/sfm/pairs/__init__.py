"""Pair selection: which image pairs are matched, and how features are compared."""

from typing import Literal

Matcher = Literal["exhaustive", "sequential", "spatial", "retrieval"]
