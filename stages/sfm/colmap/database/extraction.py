"""Feature extraction: SIFT keypoints and descriptors of photos, where they yield few from more pixels or contrast."""

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

from stages.hardware import cluster
from stages.hardware.device import processors
from stages.hardware.memory import at_once
from stages.io.photos import Photo, spread
from stages.io.pixels import even_contrast, load_pixels
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.colmap.database.images import MAPPING_MODEL, NO_TURNS, Turns, fill_database, size_on_sensor

# Of the maximum: where the median of so many photos has fewer, photos are enlarged, or their contrast made even
# (docs/experiments/few_features.md).
MIN_FEATURES_SHARE, COUNTED_PHOTOS = 0.25, 12
# In features, by even contrast: photos in fog have 40 to 200 times as many, a smooth thing 3.6, others 1.2 to 1.4.
MIN_CONTRAST_GAIN = 4.0
# The deviation of a Gaussian window, a share of the longer side, taken from a photo of so many pixels; and grey values:
# less contrast is not stretched.
CONTRAST_WINDOW, WINDOW_PIXELS, CONTRAST_NOISE = 0.02, 200, 2.0
BYTES_PER_PIXEL = 100  # 77 to 86 measured on photos of 1024 to 3200 pixels
EVEN_BYTES_PER_PIXEL = 30  # of the photo's own size, before features are extracted; 28 measured
PHOTOS_AT_A_TIME = 2  # of a cluster's core: to make a database for them takes a twentieth of a second


class ExtractionOptions(NamedTuple):
    """How features are extracted: the longer side in pixels that photos are reduced to, the maximum for each photo, the
    folder of masks, up to which longer side photos are doubled first, since smaller ones yield too few features, and
    whether their contrast is made even before."""

    max_image_size: int
    max_features: int
    masks: Path | None = None
    doubled_up_to: int = 1024
    even_contrast: bool = False

    def doubles(self, photo: Photo) -> bool:
        """Whether a photo is doubled before its features are extracted."""
        return max(photo.width, photo.height) <= self.doubled_up_to

    def pixels(self, photo: Photo) -> float:
        """From how many pixels features are extracted of a photo."""
        reduced = min(1.0, self.max_image_size / max(photo.width, photo.height))
        return photo.width * photo.height * (reduced * (2 if self.doubles(photo) else 1)) ** 2

    def larger(self) -> "ExtractionOptions":
        """Twice as many from about four times the pixels: of large photos their own, of others doubled ones."""
        twice = {"max_image_size": 2 * self.max_image_size, "max_features": 2 * self.max_features}
        return self._replace(**twice, doubled_up_to=3 * self.max_image_size // 2)

    def for_few_features(self, photos: Sequence[Photo]) -> "list[ExtractionOptions]":
        """What to try where these photos yield few features: more pixels, which doubled ones have already, then more
        contrast."""
        larger = [] if all(map(self.doubles, photos)) else [self.larger()]
        return larger if self.even_contrast else [*larger, self._replace(even_contrast=True)]


def feature_bytes(photos: Sequence[Photo], extraction: ExtractionOptions) -> float:
    """Memory that feature extraction takes for the largest of the photos, by its pixels as they are used."""

    def taken(photo: Photo) -> float:
        before = EVEN_BYTES_PER_PIXEL * photo.width * photo.height if extraction.even_contrast else 0
        return max(BYTES_PER_PIXEL * extraction.pixels(photo), before)

    return max(map(taken, photos))


def extract_features(
    database: Path,
    images: Path,
    photos: Sequence[Photo],
    extraction: ExtractionOptions,
    on_few: Callable[[float, ExtractionOptions], None] = lambda median, chosen: None,
    turns: Turns = NO_TURNS,
) -> float:
    """SIFT keypoints and descriptors of every photo that has none yet, where ``masks/<image name>.png`` is not black,
    or anywhere where that is not there. ``turns`` are those that the database was filled with.

    The scale space begins at the photos' own size. Doubling them first, as is COLMAP's habit, costs 4.5 times as
    much and moves no camera of a well-sized photo (benchmarks/sfm_accuracy.py), so only small ones are doubled. Where
    half of some photos yield few features, as smooth things do, all are enlarged: those of an enlarged photo hardly
    match those of another that is not. Where that is no help, as in fog, under water and in the dark, the contrast of
    all is made even if that yields many times more: SIFT counts it in absolute grey levels. ``on_few`` is told then
    what the photos yield as they are, and what was chosen. Returns the seconds that the chosen way took, without those
    of what else was tried on some photos.
    """
    with pycolmap.Database.open(database) as db:
        todo = [number for number in range(len(photos)) if not db.exists_descriptors(number + 1)]
    if not todo:
        return 0.0
    some = spread(len(photos), min(len(photos), COUNTED_PHOTOS))
    counted = [photos[number] for number in some]
    few, yielded, seconds = MIN_FEATURES_SHARE * extraction.max_features, [], []
    ways = [extraction, *extraction.for_few_features(counted)]
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        for way in ways:
            began = time.monotonic()
            tried = Path(folder, f"{len(yielded)}.db")
            fill_database(tried, counted, MAPPING_MODEL, turns=turns)
            _extract(tried, images, counted, way, turns)
            yielded.append(_median_features(tried, len(some)))
            seconds.append(time.monotonic() - began)
            if yielded[-1] >= few:
                break
        best = max(range(len(yielded)), key=lambda n: yielded[n] / (MIN_CONTRAST_GAIN if ways[n].even_contrast else 1))
        if best:
            on_few(yielded[0], ways[best])
        _copy_features(Path(folder, f"{best}.db"), database, some)
    began = time.monotonic()
    _extract(database, images, photos, ways[best], turns)
    return seconds[best] + time.monotonic() - began


def _median_features(database: Path, count: int) -> float:
    with pycolmap.Database.open(database) as db:
        return float(np.median([db.num_keypoints_for_image(image_id) for image_id in range(1, count + 1)]))


def _copy_features(source: Path, target: Path, numbers: Sequence[int]) -> None:
    """Copy the features of photos that have none yet; ``numbers``, from 0, are those of ``source``'s photos in
    ``target``."""
    with (
        pycolmap.Database.open(source) as read,
        pycolmap.Database.open(target) as written,
        pycolmap.DatabaseTransaction(written),
    ):
        for own_id, image_id in enumerate((number + 1 for number in numbers), 1):
            if not written.exists_descriptors(image_id):
                written.write_keypoints(image_id, read.read_keypoints(own_id))
                written.write_descriptors(image_id, read.read_descriptors(own_id))


Extracted = tuple[np.ndarray, pycolmap.FeatureDescriptors]
"""Keypoints and descriptors of a photo as COLMAP writes them."""


def _extract(
    database: Path, images: Path, photos: Sequence[Photo], extraction: ExtractionOptions, turns: Turns
) -> None:
    """The features of these photos, whatever they yield. Those of photos that have some are left alone."""
    if not photos:
        return
    threads = at_once(processors(), feature_bytes(photos, extraction))

    def here(
        work: Callable[[Sequence[Photo]], list[Extracted]], groups: Iterable[Sequence[Photo]]
    ) -> Iterable[list[Extracted]]:
        if not turns and not extraction.even_contrast:
            _extract_here(database, images, photos, extraction, threads)  # COLMAP writes them itself
            return
        with ThreadPoolExecutor(threads) as pool:
            yield from pool.map(work, groups)

    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        todo = [photo for photo in photos if not db.exists_descriptors(ids[photo.image_name])]
        groups = [todo[begin : begin + PHOTOS_AT_A_TIME] for begin in range(0, len(todo), PHOTOS_AT_A_TIME)]
        extracted = cluster.fan_out(partial(_extract_apart, images, extraction), groups, here)
        for group, found in zip(groups, extracted, strict=False):
            with pycolmap.DatabaseTransaction(db):
                for photo, (keypoints, descriptors) in zip(group, found, strict=True):
                    places = on_sensor(keypoints, photo, turns.get(photo.image_name, 0))
                    db.write_keypoints(ids[photo.image_name], places)
                    db.write_descriptors(ids[photo.image_name], descriptors)


def on_sensor(keypoints: np.ndarray, photo: Photo, turns: int) -> np.ndarray:
    """Keypoints (n, 6) of an upright photo, x, y and the affine shape by rows, where they were before so many turns."""
    back = pixel_map((photo.width, photo.height), -turns % 4, *size_on_sensor(photo, turns))
    places = keypoints[:, :2] @ back[:, :2].T + back[:, 2]
    shapes = back[:, :2] @ keypoints[:, 2:].reshape(-1, 2, 2)
    return np.concatenate([places, shapes.reshape(-1, 4)], axis=1)


def _extract_apart(images: Path, extraction: ExtractionOptions, photos: Sequence[Photo]) -> list[Extracted]:
    """The features of these photos by a database of their own, on one core."""
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder, "apart.db")
        fill_database(database, photos, MAPPING_MODEL)
        images = _with_even_contrast(images, photos, Path(folder, "images")) if extraction.even_contrast else images
        _extract_here(database, images, photos, extraction, threads=1)
        with pycolmap.Database.open(database) as db:
            numbers = range(1, len(photos) + 1)
            return [(np.array(db.read_keypoints(number)), db.read_descriptors(number)) for number in numbers]


def _with_even_contrast(images: Path, photos: Sequence[Photo], folder: Path) -> Path:
    """``folder``, with these photos in grey, of even contrast."""
    for photo in photos:
        pixels = load_pixels(images / photo.image_name, photo.width, photo.height)
        grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
        grey = even_contrast(grey, _nearby, CONTRAST_NOISE)
        file = folder / photo.image_name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(cv2.imencode(file.suffix, grey, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes())
    return folder


def _nearby(values: np.ndarray) -> np.ndarray:
    """The weighted means around the pixels of (h, w) float32."""
    height, width = values.shape
    scale = WINDOW_PIXELS / max(height, width)
    reduced = max(1, round(scale * width)), max(1, round(scale * height))
    small = cv2.resize(values, reduced, interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), CONTRAST_WINDOW * WINDOW_PIXELS), (width, height))


def _extract_here(
    database: Path, images: Path, photos: Sequence[Photo], extraction: ExtractionOptions, threads: int
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = extraction.max_image_size
    options.sift.max_num_features = extraction.max_features
    options.num_threads = threads
    small = {photo.image_name for photo in photos if extraction.doubles(photo)}
    masks = extraction.masks
    masked = {p.image_name for p in photos if masks and (masks / f"{p.image_name}.png").is_file()}
    # A photo without a mask has to go without a folder of masks: one that is not there is an error to COLMAP.
    for is_small, is_masked in product((True, False), (False, True)):
        names = [
            p.image_name for p in photos if (p.image_name in small, p.image_name in masked) == (is_small, is_masked)
        ]
        if not names:
            continue
        options.sift.first_octave = -1 if is_small else 0
        reader = pycolmap.ImageReaderOptions()
        if is_masked and masks:
            reader.mask_path = masks
        pycolmap.extract_features(
            database, images, names, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
        )
