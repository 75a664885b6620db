"""What structure-from-motion tries until every photo has a place: a fixed list, cheapest first. Runs in the child.

Each attempt changes one thing against the first and says so. The best model so far and a journal are on disk between
attempts (``attempts/`` in the stage's folder), so that whatever ends the process costs one attempt at most.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from stages.colmap.mapping import OTHER_SEED, WEAK_START, Effort, map_globally, map_incrementally, rank
from stages.files import write_json

if TYPE_CHECKING:
    import pycolmap

# Attempts that search features or match anew cost as much as the first: they wait until so many photos are missing.
WORTH_NEW_FEATURES = 0.1


class Attempt(NamedTuple):
    """One way to get at cameras. ``matches``: those of the best attempt so far, or which new ones; ``effort`` of
    incremental mapping, None for global mapping."""

    name: str
    words: str
    matches: Literal["strict", "loose", "same", "fisheye", "rich"]
    effort: Effort | None


ATTEMPTS = (
    Attempt("first", "", "strict", Effort()),
    Attempt("looser matching", "matching them again, less strictly", "loose", Effort()),
    Attempt("weaker start", "mapping again, with less asked of the first pair and of every photo", "same", WEAK_START),
    Attempt("other seed", "mapping again, with another seed", "same", OTHER_SEED),
    Attempt("all at once", "placing all photos at once (global mapping)", "same", None),
    Attempt("fisheye", "verifying and mapping again, as if through a fisheye lens", "fisheye", Effort()),
    Attempt("more features", "searching twice the features at full size, and matching those", "rich", WEAK_START),
)


@dataclass
class Tried:
    """What came of an attempt: the files in each sub-model, best first, and what the best is ranked by."""

    name: str
    database: str
    groups: list[list[str]] = field(default_factory=list)
    rank: tuple[int, int, float] = (0, 0, 0.0)
    skipped: str | None = None


Say = Callable[..., None]
