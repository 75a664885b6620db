"""Photos that are nearly the same picture as another one, and so add no baseline: bursts, brackets, second tries, and
copies in another size.

All comparisons are made on thumbnails, whose grey values are equalised: another exposure maps grey levels to others
in the same order, which their ranks do not notice.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stages.ingest.video.optical_flow import corners, follow, follow_both_ways

THUMBNAIL_PX = 320  # longer side: MAX_PARALLAX is then 0.8 of a pixel, which corners are followed to with ease
# Shares of the picture's longer side. Through a usual lens of 60 degrees the parallax of a point is then below 0.15
# degrees, a tenth of the least angle under which COLMAP keeps a point (1.5 degrees). And were all of the shift a step
# to the side in front of a flat wall, which shows no parallax, that angle would still be no more than 1.2 degrees.
MAX_PARALLAX = 0.0025
MAX_SHIFT = 0.02
# Of the corners that are followed: the others may be people, leaves, or mistakes.
MIN_AGREEING_FRACTION = 0.95
# Of all corners: with fewer of them found again, the pictures differ.
MIN_TRACKED_FRACTION = 0.8
MIN_CORNERS, MAX_CORNERS = 30, 200
# What is compared pair by pair: nearly the same pictures are nearly the same in a few large pixels.
CELLS = 16
MIN_CORRELATION = 0.8
MAX_CANDIDATES = 4
MIN_BRACKET_EV = 0.5  # between the darkest and the lightest of one place: three, a third of a stop apart, span more
# Of 255. Of a pixel that is darker, rounding and noise leave ever less; nothing is left of a clipped one.
DARK, CLIPPED = 48, 250
GAMMA = 2.2  # about what takes sRGB to linear light


class Exposure(NamedTuple):
    """How a picture is exposed: ``level_ev`` is the base-2 logarithm of its median luminance in linear light,
    ``usable`` the fraction of it that is neither clipped nor lost in the dark."""

    level_ev: float
    usable: float


class Brackets(NamedTuple):
    """Places that were photographed with the same number of exposures; of each the one at ``position`` is kept, counted
    from the darkest."""

    places: int
    exposures: int
    position: int


class _Picture(NamedTuple):
    grey: np.ndarray  # (h, w) uint8, equalised
    corners: np.ndarray  # (n, 1, 2) float32, pixels


def thumbnail(pixels: np.ndarray, used: np.ndarray | None = None) -> np.ndarray:
    """A photo, (h, w, 3 or 4) uint8, as (h', w') uint8 with equalised grey values. What is transparent counts as
    black, and what its mask ignores, ``used`` being the mask made :func:`small`: before a background that never moves,
    an object that turns is another picture."""
    picture = small(pixels)
    grey = cv2.cvtColor(picture[..., :3], cv2.COLOR_RGB2GRAY)
    for cover in (picture[..., 3] if pixels.shape[2] == 4 else None, used):
        if cover is not None:
            grey = np.rint(grey * (cover / 255.0)).astype(np.uint8)
    return cv2.equalizeHist(grey)


def small(pixels: np.ndarray) -> np.ndarray:
    """A picture of any channels, no larger than a thumbnail."""
    height, width = pixels.shape[:2]
    scale = min(1.0, THUMBNAIL_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def exposure(pixels: np.ndarray) -> Exposure:
    """Of a photo, (h, w, 3 or 4) uint8; what is transparent does not count."""
    picture = small(pixels)
    opaque = picture[..., 3] > 0 if picture.shape[2] == 4 else np.ones(picture.shape[:2], bool)
    if not opaque.any():
        return Exposure(0.0, 0.0)
    grey = cv2.cvtColor(picture[..., :3], cv2.COLOR_RGB2GRAY)[opaque]
    left = np.minimum(grey / DARK, 1.0)
    left[picture[..., :3].max(axis=2)[opaque] >= CLIPPED] = 0
    return Exposure(float(GAMMA * np.log2(max(float(np.median(grey)), 1.0) / 255)), float(left.mean()))


def well_exposed(
    left_out: Mapping[int, int], exposures: Sequence[Exposure], pixels: Sequence[int]
) -> tuple[dict[int, int], Brackets | None]:
    """:func:`near_duplicates` with the best exposed picture kept of each place with several exposures: in all places of
    a bracketed set the same one, so that the photos kept are exposed alike. Also the pattern of such a set."""
    groups: dict[int, list[int]] = {}
    for index, kept in left_out.items():
        groups.setdefault(kept, [kept]).append(index)
    brackets = []
    for kept, members in groups.items():
        largest = [i for i in members if _size_class(pixels[i]) >= _size_class(pixels[kept])]
        largest.sort(key=lambda i: (exposures[i].level_ev, i))
        if exposures[largest[-1]].level_ev - exposures[largest[0]].level_ev >= MIN_BRACKET_EV:
            brackets.append((kept, largest))
    chosen: dict[int, int] = {}
    pattern = _pattern([members for _, members in brackets], exposures)
    for kept, members in brackets:
        if pattern and len(members) == pattern.exposures:
            chosen[kept] = members[pattern.position]
        else:
            chosen[kept] = max(members, key=lambda i: exposures[i].usable)
    found = {}
    for kept, members in groups.items():
        best = chosen.get(kept, kept)
        found |= {index: best for index in members if index != best}
    return found, pattern


def _pattern(brackets: Sequence[Sequence[int]], exposures: Sequence[Exposure]) -> Brackets | None:
    """How most of the places with several exposures, darkest first, were taken; None of a single place."""
    counts = Counter(map(len, brackets))
    if not counts or max(counts.values()) < 2:
        return None
    count, places = counts.most_common(1)[0]
    usable = np.mean([[exposures[i].usable for i in members] for members in brackets if len(members) == count], axis=0)
    return Brackets(places, count, int(usable.argmax()))


def _size_class(pixels: int) -> int:
    """By the nearest power of √2."""
    return round(2 * math.log2(pixels))


def near_duplicates(
    thumbnails: Sequence[np.ndarray], sharpness: Sequence[float], pixels: Sequence[int]
) -> dict[int, int]:
    """Which photos are nearly the same picture as another one, and as which: {left out: kept}. ``pixels`` is how many
    each has.

    The largest are kept first, by the nearest power of √2 to their pixels, and of those the sharpest (of equal ones the
    first): a reduced copy has the sharper edges and shows less, and a few per cent that were cut off seldom count. A
    photo is left out only where a kept one is nearly the same: of a slow walk, in which each step is small, enough
    photos stay.
    """
    candidates = _candidates(thumbnails)
    pictures: dict[int, _Picture] = {}

    def picture(index: int) -> _Picture:
        if index not in pictures:
            pictures[index] = _Picture(thumbnails[index], corners(thumbnails[index], MAX_CORNERS))
        return pictures[index]

    left_out: dict[int, int] = {}
    kept: set[int] = set()
    for index in sorted(range(len(thumbnails)), key=lambda i: (-_size_class(pixels[i]), -sharpness[i], i)):
        nearest = [other for other in candidates[index] if other in kept][:MAX_CANDIDATES]
        same = next((other for other in nearest if _is_same_picture(picture(index), picture(other))), None)
        if same is None:
            kept.add(index)
        else:
            left_out[index] = same
    return left_out


def _candidates(thumbnails: Sequence[np.ndarray]) -> list[list[int]]:
    """For each photo the others of its shape, as a smaller or larger copy rounded to whole pixels has it, that may be
    nearly the same, those most like it first."""
    cells = [cv2.resize(one, (CELLS, CELLS), interpolation=cv2.INTER_AREA).ravel() for one in thumbnails]
    table = np.array(cells, np.float32).reshape(len(thumbnails), CELLS * CELLS)
    table -= table.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(table, axis=1)
    shapes = np.array([one.shape for one in thumbnails]).reshape(-1, 2)
    found = []
    for index in range(len(thumbnails)):
        # cos >= c without a quotient, which a blank picture would not have
        alike = table @ table[index] - MIN_CORRELATION * norms * norms[index]
        askew = np.abs(shapes[:, 0] * shapes[index, 1] - shapes[:, 1] * shapes[index, 0])
        possible = (alike > 0) & (askew <= np.maximum(shapes.max(axis=1), shapes[index].max()))
        possible[index] = False
        order = np.argsort(-(table @ table[index])[possible] / norms[possible], kind="stable")
        found.append(np.flatnonzero(possible)[order].tolist())
    return found


def _is_same_picture(one: _Picture, other: _Picture) -> bool:
    """Whether one picture, shifted and turned a little, is the other made as large as it, without parallax."""
    if len(one.corners) < MIN_CORNERS:
        return False
    longer = max(one.grey.shape)
    grey = other.grey
    if grey.shape != one.grey.shape:
        grey = cv2.resize(grey, one.grey.shape[::-1], interpolation=cv2.INTER_AREA)
    there, _ = follow(one.grey, grey, one.corners)
    if np.median(np.linalg.norm(there - one.corners, axis=2)) > MAX_SHIFT * longer:  # most pairs end here
        return False
    there, followed = follow_both_ways(one.grey, grey, one.corners)
    if followed.sum() < max(MIN_CORNERS, MIN_TRACKED_FRACTION * len(followed)):
        return False
    before, after = one.corners[followed], there[followed]
    if np.quantile(np.linalg.norm(after - before, axis=2), MIN_AGREEING_FRACTION) > MAX_SHIFT * longer:
        return False
    _, agreeing = cv2.estimateAffinePartial2D(
        before, after, method=cv2.RANSAC, ransacReprojThreshold=MAX_PARALLAX * longer, confidence=0.999
    )
    return bool(agreeing.mean() >= MIN_AGREEING_FRACTION)
