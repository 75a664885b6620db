"""What one mask says of the thing it is drawn around: whether it follows the outline, hides parts, is drawn loosely."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from stages.io.photos import Box, ends_within
from stages.io.pixels import box_of, load_pixels, pillow
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import project

CELLS = 128  # along the longer side of a photo: an outline may be wrong by so much of it
SAMPLES = 4  # along a side of a cell
MIN_AREA = 0.25  # that a mask ignores around an object; a wire or a thin border is less
ALIKE = 0.99  # of what one of two masks leaves, that both do: of a lens, a rig or a border
MIN_POINTS = 20  # that lie in a photo for them to tell
# Of the points that lie in a photo, that a mask which follows an outline may ignore. Masks of a carved stone ignored
# 0.1 % of them (median of 145 photos) and 2.5 % (95 in 100), the wrong one among them 49 %; of two statues 2.2 % at
# most.
MAX_IGNORED = 0.03
# Of its border on edges of the photo. Five sets of outlines, cut by museums, have 0.83 to 0.96 (medians); the same with
# a margin of 3 % of the longer side, or boxes with a margin around them, 0.5.
MIN_EDGE = 2 / 3
MIN_SLOPE = 1e-9  # for a direction to be told
# Points in a narrow part that a mask ignores, for it to hide them, and their density beside that in what it leaves: at
# most 0.2 in the gaps of 107 masks of a skull and a statue, 0.4 to 2 behind a rod, three cells wide, laid before them.
MIN_HIDDEN, MIN_DENSITY = 5, 0.3


class Outline(NamedTuple):
    """How much a mask ``ignored`` of each cell, what holds the rest (None: all or nothing), and whether it ``follows``
    the outline of what the points show."""

    ignored: Float[np.ndarray, "rows columns"]
    box: Box | None
    follows: bool

    @property
    def surrounds(self) -> bool:
        """Whether it ignores a good part of its photo, on two opposite sides at least."""
        return self.box is not None and ends_within(self.box) and float(self.ignored.mean()) >= MIN_AREA


def read_outline(file: Path, points: Float[np.ndarray, "n 3"], model: SparseModel, image: SparseImage) -> Outline:
    """The outline that a mask of ``image`` draws, as ``points`` in the frame of ``model`` judge it."""
    fine = read_ignored(file)
    scale = min(1.0, CELLS / max(fine.shape))
    width, height = (max(1, round(side * scale)) for side in fine.shape[::-1])
    # What is left, not what is ignored: a mean of zeros is 0, one of ones may be rounded.
    cells = 1 - cv2.resize((~fine).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    shown = _shown(points, model, image)
    if len(shown) < MIN_POINTS:
        return Outline(cells, box_of(cells < 0.5), follows=False)
    hidden = cells == 1  # whole cells
    follows = float(_at(hidden, shown).mean()) <= MAX_IGNORED and not hides_narrow_parts(hidden, shown)
    return Outline(cells, box_of(cells < 0.5), follows)


def read_ignored(file: Path) -> Bool[np.ndarray, "h w"]:
    """Which pixels a mask ignores, of some of them: about SAMPLES · CELLS along its longer side."""
    with pillow().open(file) as image:
        pixels = np.asarray(image)
    step = max(1, max(pixels.shape) // (SAMPLES * CELLS))
    return pixels[::step, ::step] == 0


def _shown(points: Float[np.ndarray, "n 3"], model: SparseModel, image: SparseImage) -> Float[np.ndarray, "shown 2"]:
    """Where points lie in a photo, hidden ones too, as shares of its width and height; those outside are left out."""
    camera, pose = model.cameras[image.camera], image.sfm_from_camera
    places = project(camera, (points - pose[:, 3]) @ pose[:, :3]) / (camera.width, camera.height)
    return places[((places >= 0) & (places < 1)).all(axis=1)]  # NaN is not


def _at(picture: np.ndarray, places: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """The values of a picture at places given as shares of its width and height."""
    rows, columns = picture.shape[:2]
    column, row = np.minimum((places * (columns, rows)).astype(int), (columns - 1, rows - 1)).T
    return picture[row, column]


def hides_narrow_parts(ignored: Bool[np.ndarray, "rows columns"], places: Float[np.ndarray, "n 2"]) -> bool:
    """Whether the cells that a mask ignores hide something thin in front of what it leaves, such as a rod, which hides
    too few points to tell.

    What it ignores between parts that it leaves, where they are close together (a morphological closing by a disc),
    may be background seen through a gap; no point of the object projects into it. Where points do, not much sparser
    than into what the mask leaves, something stood before the object. A square as wide as the disc holds MAX_IGNORED
    of the points; what is larger holds more, and is told by them. A thing thinner than two cells fills none.
    """
    left = ~ignored
    reach = math.sqrt(MAX_IGNORED * left.sum()) / 2
    grown = _distance(ignored) <= reach
    narrow = ignored & (_distance(grown) > reach)
    count, part = cv2.connectedComponents(narrow.astype(np.uint8))
    area, points = np.bincount(part.ravel(), minlength=count), np.bincount(_at(part, places), minlength=count)
    density = _at(left, places).sum() / left.sum()
    hidden = (points >= MIN_HIDDEN) & (points >= MIN_DENSITY * density * area)
    return bool(hidden[1:].any())


def edge_share(photo: Path, mask: Path) -> float:
    """Of the border of a mask, the share where its photo differs more across the border than as far beyond it.

    An outline lies on edges of the photo. A border that is drawn loosely, such as a box, runs across ground that looks
    the same on both sides; there half of it does. Compared are colours a cell inside the border, a cell outside and
    three cells outside, so that an outline may be wrong by a cell.
    """
    ignored = read_ignored(mask)
    height, width = ignored.shape
    cell = max(height, width) / CELLS
    pixels = load_pixels(photo, width, height, quick=True)[..., :3].astype(np.float32)
    colours = cv2.GaussianBlur(pixels, (0, 0), cell / 2)
    towards = cv2.GaussianBlur(ignored.astype(np.float32), (0, 0), cell)
    grown = cv2.dilate(ignored.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    border = np.argwhere(grown & ~ignored)
    slope = np.stack([cv2.Sobel(towards, cv2.CV_32F, 0, 1), cv2.Sobel(towards, cv2.CV_32F, 1, 0)], axis=2)[*border.T]
    normal = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), MIN_SLOPE)
    inside, outside, beyond = (np.rint(border + steps * cell * normal).astype(int) for steps in (-1, 1, 3))
    seen = ((inside >= 0) & (inside < ignored.shape) & (beyond >= 0) & (beyond < ignored.shape)).all(axis=1)
    inside, outside, beyond = inside[seen].T, outside[seen].T, beyond[seen].T
    fits = ~ignored[*inside] & ignored[*outside] & ignored[*beyond]
    left, right, far = (colours[*place][fits] for place in (inside, outside, beyond))
    more = np.abs(left - right).max(axis=1) > np.abs(right - far).max(axis=1)
    return float(more.sum() / max(1, len(more)))


def are_alike(ignored: Sequence[Float[np.ndarray, "rows columns"]]) -> bool:
    """Whether all those of a shape leave nearly the same."""
    first = {one.shape: 1 - one for one in reversed(ignored)}
    together = [(1 - one, first[one.shape]) for one in ignored]
    return all(np.minimum(*pair).sum() >= ALIKE * np.maximum(*pair).sum() for pair in together)


def _distance(inside: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """How far each cell that is ``inside`` is from the nearest that is not, in cells."""
    return cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
