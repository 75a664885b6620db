"""What says where the background begins: the photos' alpha, or masks that cut out an object.

A mask says which pixels are to be ignored, and no more. Masks drawn around a thing so leave open what is beside it:
training may put anything there, and does. The sparse points tell masks that follow an outline from those that hide
something, such as people who pass by. From wherever it was taken, a photo shows all points of a thing within the
thing's outline, those on its back, too; but points of what is hidden lie among the ignored pixels.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from nerf.geometry.normalisation import Normalisation
from nerf.geometry.scene import Camera
from stages.contract import Progress, listed
from stages.io.photos import Box, Photo, ends_within, spread
from stages.io.pixels import box_of, loaders, pillow
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import project

MaskMeaning = Literal["cut-out", "ignore"]

CELLS = 128  # along the longer side of a photo: an outline may be wrong by so much of it
SAMPLES = 4  # along a side of a cell
MIN_PHOTOS = 3  # that see a point for it to count
MAX_POINTS = 4000
FEW = 24  # masks, evenly spread, that decide for all: a large one takes a tenth of a second
# Of the points that lie in a photo, that a mask which follows an outline may ignore. Of a carved stone masks ignored
# 0.1 % of them (median of 145 photos) and 2.5 % (95 in 100), the wrong one among them 49 %; of a statue 2.2 % at most.
MAX_IGNORED = 0.05


class Alpha(NamedTuple):
    """What separates an object from its background. ``opaque``: by photo, what holds all that may be opaque; None: all
    of the photo may. ``masks``: by photo, the mask that is its alpha; None where its own is."""

    opaque: list[Box | None]
    masks: list[str | None]


def find_alpha(
    ingest: Path,
    photos: Sequence[Photo],
    model: SparseModel,
    order: Sequence[int],
    meaning: MaskMeaning | None,
    progress: Progress,
) -> Alpha | None:
    """The photos' own alpha, else their masks, where these cut out an object or are said to (``meaning``); None where
    nothing says what is background. Photo i is image ``order[i]`` of the model."""
    if _has_alpha(photos, progress, tracked=len(model.view) > 0):
        return Alpha([photo.opaque for photo in photos], [None] * len(photos))
    if meaning == "ignore" or not any(photo.mask for photo in photos):
        return None
    if meaning is None and not (len(model.view) and all(photo.mask for photo in photos)):
        return None
    return _cut_out(ingest, photos, model, order, forced=meaning == "cut-out")


def alpha_or_none(
    alpha: Alpha, photos: Sequence[Photo], found: Normalisation, roi_given: bool, progress: Progress
) -> Alpha | None:
    """``alpha`` where nothing of the scene lies outside of what it leaves, else None; says which and why."""
    of_masks = any(alpha.masks)
    if not found.bounded:
        left = "what the masks leave" if of_masks else "the opaque parts of the photos"
        where = "the given region" if roi_given else left
        so = "what masks ignore stays unknown" if of_masks else "transparent parts are ignored like masked ones"
        what = f"{found.beyond_alpha:.1%} of the tracked points lie outside {where}"
        code = "normalise.masks-beyond-region" if of_masks else "normalise.alpha-beyond-region"
        progress.note(code, f"{what}: the scene continues there, so {so}")
        return None
    if of_masks:
        others = [photo.name for photo, mask in zip(photos, alpha.masks, strict=True) if photo.mask and not mask]
        but = f", but for {len(others)} that also hide parts of it ({listed(others, 3)})" if others else ""
        what = f"the masks cut out an object{but}: what they ignore is transparent"
        progress.note("normalise.masks-cut-out", f"{what}; --normalise.masks ignore leaves it unknown")
    return alpha


def _has_alpha(photos: Sequence[Photo], progress: Progress, tracked: bool) -> bool:
    """Whether the photos may say what is background: most have transparent parts, and most of these show what is opaque
    from one of its sides to the other, as one sees a thing. Outdoors without a sky one does not, nor in photos with
    empty corners. Where nothing is tracked, which would tell, all alpha counts. Exceptions are said."""
    transparent = sum(photo.has_alpha for photo in photos)
    framing = sum(photo.has_alpha and ends_within(photo.opaque) for photo in photos) if tracked else transparent
    opaque = len(photos) - transparent
    has_alpha = transparent > opaque and 2 * framing > transparent
    if has_alpha and opaque:
        progress.note(
            "normalise.opaque-photos",
            f"{opaque} of {len(photos)} photos have no transparent parts and count as opaque",
        )
    elif transparent and not has_alpha:
        why = "most photos have none" if transparent <= opaque else "few photos show the opaque object whole"
        progress.note(
            "normalise.alpha-ignored",
            f"transparent parts of {transparent} of {len(photos)} photos are ignored like masked ones: {why}",
        )
    return has_alpha


def _cut_out(
    ingest: Path, photos: Sequence[Photo], model: SparseModel, order: Sequence[int], forced: bool
) -> Alpha | None:
    """What the masks cut out; None where a few of them show that they do not.

    They do where they are not all alike, as of a part of the camera, where most show what is left from one of its sides
    to the other, as one sees a thing, and where most follow an outline. The mask of a photo that does not stays a mask.
    ``forced``: all do.
    """
    masked = [(photo, model.images[i]) for photo, i in zip(photos, order, strict=True) if photo.mask]
    points = _firm_points(model)

    def look(photo: Photo, image: SparseImage) -> _Mask:
        ignored = _ignored_share(ingest / str(photo.mask))
        share = _ignored_points(points, image.sfm_from_camera, model.cameras[image.camera], ignored)
        return _Mask(ignored, box_of(ignored < 0.5), forced or share <= MAX_IGNORED)

    with ThreadPoolExecutor(loaders(ingest / str(photo.mask) for photo, _ in masked)) as pool:
        if not forced:
            few = list(pool.map(lambda number: look(*masked[number]), spread(len(masked), min(len(masked), FEW))))
            alike = all(np.array_equal(mask.ignored, few[0].ignored) for mask in few)
            framing, follow = sum(ends_within(mask.box) for mask in few), sum(mask.follows for mask in few)
            if alike or 2 * min(framing, follow) <= len(few):
                return None
        names = [photo.name for photo, _ in masked]
        of = dict(zip(names, pool.map(lambda one: look(*one)[1:], masked), strict=True))
    boxes = {name: box for name, (box, follows) in of.items() if follows}
    return Alpha(
        [boxes.get(photo.name) for photo in photos],
        [photo.mask if photo.name in boxes else None for photo in photos],
    )


class _Mask(NamedTuple):
    """How much it ``ignored`` of each cell, what holds the rest, and whether it ``follows`` an outline."""

    ignored: Float[np.ndarray, "rows columns"]
    box: Box | None
    follows: bool


def _ignored_share(file: Path) -> Float[np.ndarray, "rows columns"]:
    """How much a mask ignores of each of CELLS cells along its longer side, by some of their pixels."""
    with pillow().open(file) as image:
        pixels = np.asarray(image)
    step = max(1, max(pixels.shape) // (SAMPLES * CELLS))
    ignored = (pixels[::step, ::step] == 0).astype(np.float32)
    scale = min(1.0, CELLS / max(ignored.shape))
    width, height = (max(1, round(side * scale)) for side in ignored.shape[::-1])
    return cv2.resize(ignored, (width, height), interpolation=cv2.INTER_AREA)


def _firm_points(model: SparseModel) -> Float[np.ndarray, "n 3"]:
    """Points that MIN_PHOTOS photos see, at most MAX_POINTS of them."""
    firm = model.xyz[np.bincount(model.point, minlength=len(model.xyz)) >= MIN_PHOTOS]
    return firm[:: -(-len(firm) // MAX_POINTS) or 1]


def _ignored_points(
    points: Float[np.ndarray, "n 3"],
    pose: Float[np.ndarray, "3 4"],
    camera: Camera,
    ignored: Float[np.ndarray, "rows columns"],
) -> float:
    """Of the points that lie in a photo, hidden ones too, the share in cells that its mask ignores whole; 1 where none
    lies there."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    pixels = project(camera, local[local[:, 2] > 0])
    size = np.array([camera.width, camera.height])
    inside = ((pixels >= 0) & (pixels < size)).all(axis=1)  # NaN is not
    if not inside.any():
        return 1.0
    rows, columns = ignored.shape
    column, row = np.minimum((pixels[inside] / size * [columns, rows]).astype(int), [columns - 1, rows - 1]).T
    return float((ignored[row, column] == 1).mean())
