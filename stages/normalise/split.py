"""Which photos are held out: an official split, or every n-th photo by name."""

import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from itertools import groupby

from nerf.geometry.scene import Split
from stages.io.photos import Photo


def split_photos(photos: Sequence[Photo], test_every: int, official: list[str] | None) -> list[Split]:
    """An official split as it came; else the first photo by name and every ``test_every``-th after it (as LLFF), of
    rigs not the same view each time."""
    if official is None:
        held_out = {photos[i].file for i in _every([photo.name for photo in photos], test_every)}
    else:
        held_out = {f"images/{file}" for file in official}
    return ["test" if photo.file in held_out else "train" for photo in photos]


def _every(names: Sequence[str], step: int) -> list[int]:
    """Every ``step``-th index of sorted names, from the first.

    Where most names lie in blocks of one size that are alike but for their last numbers, as of a rig or of views cut
    out of panoramas, and ``step`` would come upon some of the views only, each index is one further from the last.
    """
    blocks = [len(list(block)) for _, block in groupby(names, _without_last_number)]
    size, count = Counter(blocks).most_common(1)[0]
    in_step = 2 * count > len(blocks) > 1 and math.gcd(size, step) > 1
    found = (step * i + in_step * (i % step) for i in range(math.ceil(len(names) / step)))
    return [i for i in found if i < len(names)]


def _without_last_number(name: str) -> str:
    return re.sub(r"\d+(?=\D*$)", "", os.path.splitext(name)[0])
