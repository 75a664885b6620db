"""What says where the background begins: the photos' alpha, or masks that cut out an object.

A mask says which pixels are to be ignored, and no more. Masks drawn around a thing so leave open what is beside it:
training may put anything there, and does. The sparse points tell masks that follow an outline from those that hide
something, such as people who pass by. From wherever it was taken, a photo shows all points of a thing within the
thing's outline, those on its back, too; but points of what is hidden lie among the ignored pixels. Where a mask leaves
plain ground around the thing there are no points; there its border lies on no edge of the photo.

Training photos decide, the masks of test photos have no say.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from nerf.geometry.normalisation import Normalisation
from nerf.geometry.reconstruction import thinned
from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.scene import Split
from stages.contract import Progress, listed
from stages.io.amounts import counted
from stages.io.photos import Box, Photo, ends_within, spread
from stages.io.pixels import loaders
from stages.io.sparse_model import SparseModel
from stages.normalise.outlines import MIN_EDGE, Outline, are_alike, edge_share, read_outline

MaskMeaning = Literal["cut-out", "ignore"]
T = TypeVar("T")

FEW = 24  # masks, evenly spread, that decide for all
MIN_PHOTOS = 3  # that see a point for it to count
MAX_POINTS = 4000  # that are looked at


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
    split: Sequence[Split],
    capture_type: CaptureType,
    meaning: MaskMeaning | None,
    progress: Progress,
) -> Alpha | None:
    """The photos' own alpha, else their masks, where these cut out an object or are said to (``meaning``); None where
    nothing says what is background. Photo i is image ``order[i]`` of the model; training photos alone decide."""
    train = _of_training(photos, split)
    if _has_alpha(photos, train, progress, tracked=len(model.view) > 0):
        return Alpha([photo.opaque for photo in photos], [None] * len(photos))
    if meaning == "ignore":
        return None
    masks = _Masks(ingest, photos, model, order, split)
    if meaning == "cut-out":
        if not masks.few or any(photo.has_alpha for photo in train):
            why = "some photos have alpha" if masks.few else "no mask ignores anything"
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
        without = [photo.name for photo in photos if not photo.mask]
        but = f"; masks that also hide parts of it only ignore ({listed(others, 3)})" if others else ""
        but += f"; photos without a mask count as opaque ({listed(without, 3)})" if without else ""
        progress.note(
            "normalise.masks-cut-out",
            f"the masks cut out an object: what they ignore is transparent, and counts in the scores{but}",
        )
    return alpha


def _has_alpha(photos: Sequence[Photo], train: Sequence[Photo], progress: Progress, tracked: bool) -> bool:
    """Whether the photos may say what is background: most of those to train on have transparent parts, and most of
    these show what is opaque from one of its sides to the other, as one sees a thing. Outdoors without a sky one does
    not, nor in photos with empty corners. Where nothing is tracked, which would tell, all alpha counts. Exceptions are
    said."""
    with_alpha = [photo for photo in train if photo.has_alpha]
    framing = sum(not tracked or ends_within(photo.opaque) for photo in with_alpha)
    most = 2 * len(with_alpha) > len(train)
    has_alpha = most and 2 * framing > len(with_alpha)
    transparent = sum(photo.has_alpha for photo in photos)
    if has_alpha and transparent < len(photos):
        progress.note(
            "normalise.opaque-photos",
            f"{len(photos) - transparent} of {len(photos)} photos have no transparent parts and count as opaque",
        )
    elif transparent and not has_alpha:
        why = "few photos show the opaque object whole" if most else "most photos have none"
        progress.note(
            "normalise.alpha-ignored",
            f"transparent parts of {transparent} of {len(photos)} photos are ignored like masked ones: {why}",
        )
    return has_alpha


class _Masks:
    """The masks of ``photos``, and what those of the training photos say together."""

    def __init__(
        self, ingest: Path, photos: Sequence[Photo], model: SparseModel, order: Sequence[int], split: Sequence[Split]
    ) -> None:
        self.ingest, self.all, self.model = ingest, photos, model
        self.image = {photo.name: model.images[i] for photo, i in zip(photos, order, strict=True)}
        self.train = _of_training(photos, split)
        seen = np.bincount(model.point[np.isin(model.view, _of_training(order, split))], minlength=len(model.xyz))
        self.points = thinned(model.xyz[seen >= MIN_PHOTOS], MAX_POINTS)
        self.outlines = dict[str, Outline]()  # by the names of their photos
        masked = [photo for photo in self.train if photo.mask]
        self.few = [masked[i] for i in spread(len(masked), min(len(masked), FEW))]
        self._look_at(self.few, lambda done: None)
        self.around = [photo for photo in self.few if self.outlines[photo.name].surrounds]

    def surround_something(self) -> bool:
        """Whether most masks, as far as a few tell, ignore a good part of their photo on two of its opposite sides, and
        not all the same part, as around a thing."""
        ignored = [self.outlines[photo.name].ignored for photo in self.few]
        return 2 * len(self.around) > len(ignored) and not are_alike([cells for cells in ignored if cells.max() > 0.5])

    def why_unknown(self, capture_type: CaptureType) -> str | None:
        """What speaks against masks that surround something cutting out an object, as far as a few tell."""
        if any(photo.has_alpha for photo in self.train):
            return "some photos have alpha"
        if without := sum(not photo.mask for photo in self.train):
            have = "has" if without == 1 else "have"
            return f"{without} of {counted(len(self.train), 'training photo')} {have} no mask"
        if capture_type != "object-centric":
            return "the photos were not taken around an object"
        if not len(self.points):
            return "no points tell whether they hide parts of the object"
        if 2 * sum(self.outlines[photo.name].follows for photo in self.around) <= len(self.around):
            return "most of them also hide tracked points"
        files = [(self.ingest / photo.file, self.ingest / str(photo.mask)) for photo in self.around]
        with ThreadPoolExecutor(loaders(photo for photo, _ in files)) as pool:
            loose = sum(share < MIN_EDGE for share in pool.map(edge_share, *zip(*files, strict=True)))
        return (
            "most of their borders lie on no edge of the photo, as of a box around an object"
            if 2 * loose > len(files)
            else None
        )

    def as_alpha(self, forced: bool, progress: Progress) -> Alpha:
        """The masks as alpha, but for those that do not follow an outline; ``forced``: all of them."""
        masked = [photo for photo in self.all if photo.mask]
        self._look_at(masked, lambda done: progress.update("looking at the masks", done))
        boxes = {name: one.box for name, one in self.outlines.items() if forced or one.follows}
        return Alpha(
            [boxes.get(photo.name) for photo in self.all],
            [photo.mask if photo.name in boxes else None for photo in self.all],
        )

    def _look_at(self, photos: Sequence[Photo], report: Callable[[float], None]) -> None:
        """Look at the masks of ``photos`` that have not been looked at."""
        rest = [photo for photo in photos if photo.name not in self.outlines]
        files = [self.ingest / str(photo.mask) for photo in rest]

        def outline(photo: Photo, file: Path) -> Outline:
            return read_outline(file, self.points, self.model, self.image[photo.name])

        with ThreadPoolExecutor(loaders(files)) as pool:
            for photo, one in zip(rest, pool.map(outline, rest, files), strict=True):
                self.outlines[photo.name] = one
                report(len(self.outlines) / len(photos))


def _of_training(items: Sequence[T], split: Sequence[Split]) -> list[T]:
    """Those of the training photos."""
    return [item for item, part in zip(items, split, strict=True) if part == "train"]
