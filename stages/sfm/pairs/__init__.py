"""Pair selection: which image pairs are matched, and how features are compared."""

from typing import Literal

Matcher = Literal["exhaustive", "sequential", "spatial", "retrieval"]

# Matching every pair misses nothing, but most pairs of many photos show nothing in common. On sets of up to so many it
# is done, exactly; on larger ones the match graph is grown (match_graph.py).
MAX_EXHAUSTIVE = 50
