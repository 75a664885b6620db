"""What says where the background begins: the photos' alpha, or masks that cut out an object.

A mask says which pixels are to be ignored, and no more. Masks drawn around a thing so leave open what is beside it:
training may put anything there, and does. The sparse points tell masks that follow an outline from those that hide
something, such as people who pass by. From wherever it was taken, a photo shows all points of a thing within the
thing's outline, those on its back, too; but points of what is hidden lie among the ignored pixels.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from nerf.geometry.normalisation import Normalisation
from nerf.geometry.region_of_interest import CaptureType
from stages.contract import Progress, listed
from stages.io.amounts import counted
from stages.io.photos import Box, Photo, ends_within, spread
from stages.io.pixels import box_of, loaders, pillow
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import project

MaskMeaning = Literal["cut-out", "ignore"]

CELLS = 128  # along the longer side of a photo: an outline may be wrong by so much of it
SAMPLES = 4  # along a side of a cell
FEW = 24  # masks, evenly spread, that decide for all
MIN_AREA = 0.25  # that a mask ignores around an object; a wire or a thin border is less
ALIKE = 0.99  # of what one of two masks leaves, that both do: of a lens, a rig or a border
MIN_PHOTOS = 3  # that see a point for it to count
MIN_POINTS, MAX_POINTS = 20, 4000  # that lie in a photo for them to tell; that are looked at
# Of the points that lie in a photo, that a mask which follows an outline may ignore. Masks of a carved stone ignored
# 0.1 % of them (median of 145 photos) and 2.5 % (95 in 100), the wrong one among them 49 %; of two statues 2.2 % at
# most.
MAX_IGNORED = 0.03


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
    capture_type: CaptureType,
    meaning: MaskMeaning | None,
    progress: Progress,
) -> Alpha | None:
    """The photos' own alpha, else their masks, where these cut out an object or are said to (``meaning``); None where
    nothing says what is background. Photo i is image ``order[i]`` of the model."""
    if _has_alpha(photos, progress, tracked=len(model.view) > 0):
        return Alpha([photo.opaque for photo in photos], [None] * len(photos))
    if meaning == "ignore":
        return None
    masks = _Masks(ingest, photos, model, order)
    if meaning == "cut-out":
        if not masks.photos or any(photo.has_alpha for photo in photos):
            why = "some photos have alpha" if masks.photos else "no mask ignores anything"
            progress.note("normalise.masks-not-used", f"--normalise.masks cut-out changes nothing: {why}")
            return None
        return masks.as_alpha(forced=True, progress=progress)
    if not masks.surround_something():
        return None
    if why := masks.why_unknown(capture_type):
        hint = "--normalise.masks cut-out makes it transparent"
        progress.note("normalise.masks-ignore", f"what masks ignore stays unknown: {why}; {hint}")
        return None
    return masks.as_alpha(forced=False, progress=progress)


def alpha_or_none(
    alpha: Alpha, photos: Sequence[Photo], found: Normalisation, roi_given: bool, progress: Progress
) -> Alpha | None:
    """``alpha`` where nothing of the scene lies outside of what it leaves, else None; says which and why."""
    of_masks = any(alpha.masks)
    if not found.bounded:
        left = "what the masks leave" if of_masks else "the opaque parts of the photos"
        where = "the given region" if roi_given else left
        unknown = "what masks ignore stays unknown; --normalise.roi can say where the object ends"
        so = unknown if of_masks else "transparent parts are ignored like masked ones"
        what = f"{found.beyond_alpha:.1%} of the tracked points lie outside {where}"
        code = "normalise.masks-beyond-region" if of_masks else "normalise.alpha-beyond-region"
        progress.note(code, f"{what}: the scene continues there, so {so}")
        return None
    if of_masks:
        others = [photo.name for photo, mask in zip(photos, alpha.masks, strict=True) if photo.mask and not mask]
        without = [photo.name for photo in photos if not photo.has_mask]
        but = f"; masks that also hide parts of it only ignore ({listed(others, 3)})" if others else ""
        but += f"; photos without a mask count as opaque ({listed(without, 3)})" if without else ""
        progress.note(
            "normalise.masks-cut-out",
            f"the masks cut out an object: what they ignore is transparent, and counts in the scores{but}",
        )
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


class _Masks:
    """The masks of ``photos`` that ignore something, and whether they follow the outline of what the points show."""

    def __init__(self, ingest: Path, photos: Sequence[Photo], model: SparseModel, order: Sequence[int]) -> None:
        self.ingest, self.all, self.model = ingest, photos, model
        self.image = {photo.name: model.images[i] for photo, i in zip(photos, order, strict=True)}
        self.photos = [photo for photo in photos if photo.mask]
        seen = np.bincount(model.point, minlength=len(model.xyz)) if len(model.point) else np.zeros(len(model.xyz))
        firm = model.xyz[seen >= MIN_PHOTOS]
        self.points = firm[:: -(-len(firm) // MAX_POINTS) or 1]
        self.looked_at = dict[str, _Mask]()  # by the names of their photos
        few = [self.photos[i] for i in spread(len(self.photos), min(len(self.photos), FEW))]
        self._look_at(few, lambda done: None)
        self.few = [*self.looked_at.values()]

    def surround_something(self) -> bool:
        """Whether most masks, as far as a few tell, ignore a good part of their photo on two of its opposite sides, and
        not all the same part, as around a thing."""
        around = sum(_is_around_something(mask) for mask in self.few) * len(self.photos)
        most = 2 * around > sum(photo.has_mask for photo in self.all) * len(self.few)
        return most and not _are_alike([mask.ignored for mask in self.few])

    def why_unknown(self, capture_type: CaptureType) -> str | None:
        """What speaks against masks that surround something cutting out an object, as far as a few tell."""
        if any(photo.has_alpha for photo in self.all):
            return "some photos have alpha"
        if without := sum(not photo.has_mask for photo in self.all):
            return f"{without} of {counted(len(self.all), 'photo')} {'has' if without == 1 else 'have'} no mask"
        if capture_type != "object-centric":
            return "the photos were not taken around an object"
        if not len(self.points):
            return "no points tell whether they hide parts of the object"
        follow = sum(mask.follows and _is_around_something(mask) for mask in self.few)
        return None if 2 * follow > len(self.few) else "most of them also hide tracked points"

    def as_alpha(self, forced: bool, progress: Progress) -> Alpha:
        """The masks as alpha, but for those that do not follow an outline; ``forced``: all of them."""

        def report(done: float) -> None:
            progress.update("looking at the masks", done)

        self._look_at(self.photos, report)
        boxes = {name: mask.box for name, mask in self.looked_at.items() if forced or mask.follows}
        return Alpha(
            [boxes.get(photo.name) for photo in self.all],
            [photo.mask if photo.name in boxes else None for photo in self.all],
        )

    def _look_at(self, photos: Sequence[Photo], report: Callable[[float], None]) -> None:
        """Look at the masks of ``photos`` that have not been looked at."""
        rest = [photo for photo in photos if photo.name not in self.looked_at]
        files = [self.ingest / photo.mask for photo in rest if photo.mask]
        with ThreadPoolExecutor(loaders(files)) as pool:
            for photo, ignored in zip(rest, pool.map(_ignored_share, files), strict=True):
                share = self._ignored_points(self.image[photo.name], ignored)
                self.looked_at[photo.name] = _Mask(ignored, box_of(ignored < 0.5), share <= MAX_IGNORED)
                report(len(self.looked_at) / len(photos))

    def _ignored_points(self, image: SparseImage, ignored: Float[np.ndarray, "rows columns"]) -> float:
        """Of the points that lie in a photo, hidden ones too, the share in cells that its mask ignores whole; 1 where
        too few lie there."""
        camera, pose = self.model.cameras[image.camera], image.sfm_from_camera
        local = (self.points - pose[:, 3]) @ pose[:, :3]
        pixels, size = project(camera, local), np.array([camera.width, camera.height])
        inside = ((pixels >= 0) & (pixels < size)).all(axis=1)  # NaN is not
        if inside.sum() < MIN_POINTS:
            return 1.0
        rows, columns = ignored.shape
        column, row = np.minimum((pixels[inside] / size * [columns, rows]).astype(int), [columns - 1, rows - 1]).T
        return float((ignored[row, column] == 1).mean())


class _Mask(NamedTuple):
    """How much it ``ignored`` of each cell, what holds the rest, and whether it ``follows`` an outline."""

    ignored: Float[np.ndarray, "rows columns"]
    box: Box | None
    follows: bool


def _is_around_something(mask: _Mask) -> bool:
    return mask.box is not None and ends_within(mask.box) and float(mask.ignored.mean()) >= MIN_AREA


def _are_alike(ignored: Sequence[Float[np.ndarray, "rows columns"]]) -> bool:
    """Whether all those of a shape leave nearly the same."""
    first = {one.shape: 1 - one for one in reversed(ignored)}
    together = [(1 - one, first[one.shape]) for one in ignored]
    return all(np.minimum(*pair).sum() >= ALIKE * np.maximum(*pair).sum() for pair in together)


def _ignored_share(file: Path) -> Float[np.ndarray, "rows columns"]:
    """How much a mask ignores of each of CELLS cells along its longer side, by some of their pixels."""
    with pillow().open(file) as image:
        pixels = np.asarray(image)
    step = max(1, max(pixels.shape) // (SAMPLES * CELLS))
    ignored = (pixels[::step, ::step] == 0).astype(np.float32)
    scale = min(1.0, CELLS / max(ignored.shape))
    width, height = (max(1, round(side * scale)) for side in ignored.shape[::-1])
    return cv2.resize(ignored, (width, height), interpolation=cv2.INTER_AREA)
