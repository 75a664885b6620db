"""Features and matches: everything that fills COLMAP's database. Call it in a child process."""

import math
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import chain, combinations, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool

from stages.hardware import cluster
from stages.hardware.device import processors
from stages.hardware.memory import at_once, available_bytes
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.photos import Photo, spread
from stages.io.pixels import even_contrast, load_pixels
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.pairs.feature_matching import IndexedFeatures, index_features, match_descriptors, match_indexed
from stages.sfm.pairs.image_retrieval import WORDS, Words, photo_similarity, vocabulary
from stages.sfm.pairs.pair_selection import Pairs, SimilarityMatrix

FOCAL_GUESS = 1.2  # focal length over the longer side where EXIF is silent: 45 degrees, a phone's main camera
# Lowe's ratio: 0.8 is SIFT's own. 0.9 lets in many mismatches, most of which verification throws out again, and
# finds views that lie farther apart; only photos that otherwise stay unregistered are matched like that.
STRICT_RATIO = 0.8
RELAXED_RATIO = 0.9
BLOCK_SIZE = 32  # pairs of photos that are worked on and committed at once (progress, resuming)
MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
FISHEYE_MODEL = "SIMPLE_RADIAL_FISHEYE"
FISHEYE_ANGLE_DEG = 150.0
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
OPENINGS, PAUSE_SECONDS = 50, 0.1  # a reader holds the lock for milliseconds
# Features are held in memory for so many photos at least, and for more as long as they take no more than this share of
# what is free. Of 4096 features indexed ones take 2.5 MB, others 0.6.
MIN_CACHED_PHOTOS, CACHE_SHARE = 256, 0.25


Turns = Mapping[str, int]
"""By image name the quarter turns clockwise that made a photo upright, of photos whose features are kept where their
sensor had them; all others are absent."""
NO_TURNS: Turns = MappingProxyType({})


def keep_open(database: Path) -> pycolmap.Database:
    """A connection to keep for as long as another process reads along.

    Whoever opens the database first or closes it last has to be alone in it, and COLMAP does not wait for that: it
    fails. With this connection there no other one is the first or the last. Raises RuntimeError where it cannot be
    opened for seconds.
    """
    for _ in range(OPENINGS - 1):
        with suppress(RuntimeError):
            return pycolmap.Database.open(database)
        time.sleep(PAUSE_SECONDS)
    return pycolmap.Database.open(database)


def turns_of_cameras(photos: Sequence[Photo]) -> Turns:
    """The turns of photos whose camera was held in several ways: upright, such a camera has as many sizes and principal
    points, while on the sensor all its photos tell the same intrinsics."""
    ways = Counter(group for group, _ in {(photo.camera_group, photo.orientation) for photo in photos})
    turned = [photo for photo in photos if photo.orientation != 1 and ways[photo.camera_group] > 1]
    return {photo.image_name: QUARTER_TURNS[photo.orientation] for photo in turned}


def fill_database(
    database: Path,
    photos: Sequence[Photo],
    camera_model: str,
    camera_params: Sequence[float] | None = None,
    turns: Turns = NO_TURNS,
) -> None:
    """Enter photos (in order of ``file``) and their cameras, all or nothing: one for each camera group with ``turns``,
    and one for each way in which it was held without.

    Known ``camera_params`` are those of one camera for all photos.
    """
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        if db.num_images():
            return
        camera_ids: dict[tuple[int, int | None], int] = {}
        for image_id, photo in enumerate(photos, start=1):
            held = None if camera_params or turns else photo.orientation
            group = (0 if camera_params else photo.camera_group, held)
            if group not in camera_ids:
                camera_ids[group] = len(camera_ids) + 1
                size = _size_on_sensor(photo, turns.get(photo.image_name, 0))
                camera = _first_guess(size, photo.focal_px, camera_model, camera_params, camera_ids[group])
                _enter_camera(db, camera)
            _enter_image(db, photo.image_name, camera_ids[group], image_id)


def _size_on_sensor(photo: Photo, turns: int) -> tuple[int, int]:
    return (photo.height, photo.width) if turns % 2 else (photo.width, photo.height)


def _enter_image(db: pycolmap.Database, name: str, camera_id: int, image_id: int) -> None:
    image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
    db.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    db.write_frame(frame, use_frame_id=True)


def _first_guess(
    size: tuple[int, int], focal_px: float | None, model: str, params: Sequence[float] | None, camera_id: int
) -> pycolmap.Camera:
    """The camera of photos of this width and height: as it is known, by EXIF's focal length, or by a guess."""
    if params is not None:
        camera = pycolmap.Camera(camera_id=camera_id, model=model, width=size[0], height=size[1], params=list(params))
        camera.has_prior_focal_length = True
        return camera
    fisheye = model.endswith("FISHEYE")
    guess = fisheye_focal_px(*size) if fisheye else FOCAL_GUESS * max(size)
    camera = pycolmap.Camera.create_from_model_name(camera_id, model, focal_px or guess, *size)
    # Two views through a fisheye have no fundamental matrix to do without a focal length: the guess has to serve.
    camera.has_prior_focal_length = fisheye or focal_px is not None
    return camera


def fisheye_focal_px(width: int, height: int) -> float:
    """Of an equidistant camera, r = f θ, with FISHEYE_ANGLE_DEG from corner to corner."""
    return math.hypot(width, height) / math.radians(FISHEYE_ANGLE_DEG)


def _enter_camera(db: pycolmap.Database, camera: pycolmap.Camera) -> None:
    db.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    db.write_rig(rig, use_rig_id=True)


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
        longer = max(photo.width, photo.height)
        scale = min(1.0, extraction.max_image_size / longer) * (2 if extraction.doubles(photo) else 1)
        before = EVEN_BYTES_PER_PIXEL if extraction.even_contrast else 0
        return photo.width * photo.height * max(BYTES_PER_PIXEL * scale**2, before)

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
    back = pixel_map((photo.width, photo.height), -turns % 4, *_size_on_sensor(photo, turns))
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


Item = TypeVar("Item")
Result = TypeVar("Result")


def match_pairs(
    database: Path,
    pairs: Pairs,
    seed: int,
    max_ratio: float,
    on_expected: Callable[[int, float], None] = lambda left, seconds: None,
    features: "Features | None" = None,
) -> None:
    """Match and verify these pairs of photos (numbered from 0) where that has not been done yet.

    ``max_ratio`` is Lowe's: the best match must be nearer than this share of the second best. ``features`` says how
    features are compared, exactly without it, and keeps those that were read for further calls. ``on_expected`` is
    told how many pairs there are to match and how long it will take, once a first block, spread over all, is done.
    """
    with pycolmap.Database.open(database) as db, ThreadPoolExecutor(processors()) as pool:
        todo = _spread([(i, j) for i, j in pairs.tolist() if not db.exists_two_view_geometry(i + 1, j + 1)])
        photo = partial((features or Features()).read, db)
        every = _blocks(todo)
        blocks = ([(photo(i), photo(j)) for i, j in block] for block in every)
        matched = cluster.fan_out(partial(_match_block, max_ratio, seed), blocks, partial(_on_own_cores, pool))
        started = time.monotonic()
        for number, (block, found) in enumerate(zip(every, matched, strict=True)):
            with pycolmap.DatabaseTransaction(db):
                for (i, j), (matches, geometry) in zip(block, found, strict=True):
                    db.write_matches(i + 1, j + 1, matches)
                    db.write_two_view_geometry(i + 1, j + 1, geometry)
            if number == 0:
                on_expected(len(todo), (time.monotonic() - started) * len(todo) / len(block))


def _spread(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same pairs, a block from all over them first: what it costs then holds for the rest."""
    step = max(1, len(pairs) // BLOCK_SIZE)
    first = pairs[::step][:BLOCK_SIZE]
    chosen = set(first)
    return first + [pair for pair in pairs if pair not in chosen]


def _blocks(todo: list[Item]) -> list[list[Item]]:
    return [todo[begin : begin + BLOCK_SIZE] for begin in range(0, len(todo), BLOCK_SIZE)]


class _Photo(NamedTuple):
    camera: pycolmap.Camera
    keypoints: np.ndarray  # (keypoints, 2), pixels
    features: Any  # descriptors, (keypoints, 128) bytes, or IndexedFeatures of them


SharedPhoto = Callable[[], _Photo]


class Features:
    """Photos' features as they are compared: exactly, or with ``words`` by an inverted file, which takes a fifth of the
    time and misses two matches in a hundred. The latest photos are kept."""

    def __init__(self, words: Words | None = None) -> None:
        self._words, self._room = words, CACHE_SHARE * available_bytes()
        self._photos: dict[int, tuple[SharedPhoto, int]] = {}
        self._bytes = 0

    def read(self, db: pycolmap.Database, photo: int) -> SharedPhoto:
        """Those of the photo with this number, for work anywhere."""
        if (found := self._photos.pop(photo, None)) is None:
            camera = db.read_camera(db.read_image(photo + 1).camera_id)
            keypoints = np.array(db.read_keypoints(photo + 1), float).reshape(-1, 6)[:, :2].copy()
            features: Any = read_descriptors(db, photo)
            if self._words is not None:
                features = index_features(features, self._words)
            arrays = [features] if self._words is None else vars(features).values()
            size = keypoints.nbytes + sum(array.nbytes for array in arrays)
            found = cluster.share(_Photo(camera, keypoints, features)), size
            self._bytes += size
        self._photos[photo] = found  # the latest last
        while len(self._photos) > MIN_CACHED_PHOTOS and self._bytes > self._room:
            self._bytes -= self._photos.pop(next(iter(self._photos)))[1]
        return found[0]


def read_vocabulary(database: Path, count: int, seed: int, words: int) -> Words:
    """So many visual words of these photos' features."""
    with pycolmap.Database.open(database) as db:
        return vocabulary(partial(read_descriptors, db), count, seed, words)


def image_similarity(database: Path, count: int, seed: int) -> SimilarityMatrix:
    """How much any two photos look alike, by their features."""
    words = read_vocabulary(database, count, seed, WORDS)
    with pycolmap.Database.open(database) as db:
        return photo_similarity(partial(read_descriptors, db), count, words)


def verified_matches(database: Path, pairs: Pairs) -> np.ndarray:
    """How many verified matches each of these pairs has; 0 where it was not matched or failed."""
    with pycolmap.Database.open(database) as db:
        found = dict(zip(*db.read_two_view_geometry_num_inliers(), strict=True))
    return np.array([found.get(pycolmap.image_pair_to_pair_id(i + 1, j + 1), 0) for i, j in pairs.tolist()], int)


def matched_pairs(database: Path) -> Pairs:
    """All pairs of photos that were matched so far, verified or not."""
    with pycolmap.Database.open(database) as db:
        ids, _ = db.read_all_matches()
    return np.array([pycolmap.pair_id_to_image_pair(pair) for pair in ids], int).reshape(-1, 2) - 1


def read_descriptors(db: pycolmap.Database, photo: int) -> np.ndarray:
    """Of the photo with this number, (keypoints, 128) bytes."""
    return np.array(db.read_descriptors(photo + 1).data, np.uint8).reshape(-1, 128)


Block = list[tuple[SharedPhoto, SharedPhoto]]
Matched = tuple[np.ndarray, pycolmap.TwoViewGeometry]
"""Matches, and the geometry of two views with those that it explains: none where they are too few."""


def _on_own_cores(
    pool: ThreadPoolExecutor, work: Callable[[list[Item]], list[Result]], blocks: Iterable[list[Item]]
) -> Iterator[list[Result]]:
    """Each block on all cores, at work while the one before is written."""
    before = list[Future[list[Result]]]()
    for block in chain(blocks, [list[Item]()]):
        ahead = [pool.submit(work, [pair]) for pair in block]
        if before:
            yield [found for each in before for found in each.result()]
        before = ahead


def _match_block(max_ratio: float, seed: int, block: Block) -> list[Matched]:
    options, photos = _verification(seed), {each: each() for pair in block for each in pair}
    return [_match(photos[first], photos[second], max_ratio, options) for first, second in block]


def _match(first: _Photo, second: _Photo, max_ratio: float, options: pycolmap.TwoViewGeometryOptions) -> Matched:
    match: Any = match_indexed if isinstance(first.features, IndexedFeatures) else match_descriptors
    matches = match(first.features, second.features, max_ratio)
    return matches, _verified(first, second, matches, options)


def _verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    return options


def _verified(
    first: _Photo, second: _Photo, matches: np.ndarray, options: pycolmap.TwoViewGeometryOptions
) -> pycolmap.TwoViewGeometry:
    views = first.camera, first.keypoints, second.camera, second.keypoints
    return pycolmap.estimate_two_view_geometry(*views, matches, options)


def copy_without_matches_of(names: Container[str], database: Path, copy: Path) -> None:
    """Copy the database, less every pair with one of these photos; nothing where the copy is there already."""
    if copy.exists():
        return
    unfinished = unfinished_copy(database, copy)
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        for first, second in combinations(images, 2):
            if first.name in names or second.name in names:
                db.delete_matches(first.image_id, second.image_id)
                db.delete_two_view_geometry(first.image_id, second.image_id)
    finish_copy(unfinished, copy)


def adopt_cameras(database: Path, model: pycolmap.Reconstruction, image_ids: Iterable[int]) -> set[int]:
    """Give the cameras of these images the intrinsics that they have in the model, as known; the ids of the cameras."""
    camera_ids = {model.image(image_id).camera_id for image_id in image_ids}
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        for camera_id in sorted(camera_ids):
            camera = pycolmap.Camera(model.camera(camera_id).todict())
            camera.has_prior_focal_length = True
            db.update_camera(camera)
    return camera_ids


def copy_with_cameras_of(model: pycolmap.Reconstruction, database: Path, copy: Path) -> None:
    """Copy keypoints and verified matches to a database whose images, numbered as in the model, have its cameras."""
    with (
        pycolmap.Database.open(database) as db,
        pycolmap.Database.open(copy) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        for camera in model.cameras.values():
            _enter_camera(new, camera)
        for image_id, image in sorted(model.images.items()):
            _enter_image(new, image.name, image.camera_id, image_id)
            new.write_keypoints(image_id, db.read_keypoints(image_id))
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            new.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(pair_id), geometry)


def copy_without_pairs(database: Path, copy: Path, pairs: Iterable[Sequence[int]]) -> None:
    """Copy the database less what was verified of these pairs of image ids."""
    unfinished = unfinished_copy(database, copy)
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        for first, second in pairs:
            db.delete_two_view_geometry(first, second)
    finish_copy(unfinished, copy)


def keep_inliers(
    db: pycolmap.Database, pair: tuple[int, int], geometry: pycolmap.TwoViewGeometry, keep: Bool[np.ndarray, "n"]
) -> None:
    """Leave only some of the verified matches of a pair of image ids, which it is deleted without."""
    db.delete_two_view_geometry(*pair)
    if keep.any():
        geometry.inlier_matches = np.asarray(geometry.inlier_matches)[keep].astype(np.uint32)
        db.write_two_view_geometry(*pair, geometry)


def copy_as_fisheye(database: Path, copy: Path, seed: int) -> None:
    """Copy the database, its cameras become fisheyes and its matches verified anew; nothing where it is there.

    Without EXIF the focal length is :func:`fisheye_focal_px`, and counts as known.
    """
    if copy.exists():
        return
    unfinished = unfinished_copy(database, copy)
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        for camera in db.read_all_cameras():
            size = camera.width, camera.height
            focal_px = camera.mean_focal_length() if camera.has_prior_focal_length else fisheye_focal_px(*size)
            fisheye = pycolmap.Camera.create_from_model_name(camera.camera_id, FISHEYE_MODEL, focal_px, *size)
            fisheye.has_prior_focal_length = True
            db.update_camera(fisheye)
        verify_again(db, seed)
    finish_copy(unfinished, copy)


def verify_again(db: pycolmap.Database, seed: int) -> None:
    """Verify all matches anew, by the cameras and keypoints that the database has now."""
    todo = [
        (*pycolmap.pair_id_to_image_pair(pair_id), np.asarray(matches, np.uint32))
        for pair_id, matches in zip(*db.read_all_matches(), strict=True)
    ]
    every, photo = _blocks(todo), partial(Features().read, db)
    with ThreadPoolExecutor(processors()) as pool:
        blocks = ([(photo(i - 1), photo(j - 1), matches) for i, j, matches in block] for block in every)
        verified = cluster.fan_out(partial(_verify_block, seed), blocks, partial(_on_own_cores, pool))
        for block, geometries in zip(every, verified, strict=True):
            for (i, j, _), geometry in zip(block, geometries, strict=True):
                db.delete_two_view_geometry(i, j)
                db.write_two_view_geometry(i, j, geometry)


def _verify_block(
    seed: int, block: list[tuple[SharedPhoto, SharedPhoto, np.ndarray]]
) -> list[pycolmap.TwoViewGeometry]:
    options = _verification(seed)
    return [_verified(first(), second(), matches, options) for first, second, matches in block]


def unfinished_copy(database: Path, copy: Path) -> Path:
    """Copy a database beside ``copy``, to be renamed to it once it is what it should be."""
    unfinished = copy.with_suffix(".unfinished")
    for part in ("", "-wal"):  # as long as anybody reads along, the latest pages stay in the write-ahead log
        unfinished.with_name(unfinished.name + part).unlink(missing_ok=True)
        if (source := database.with_name(database.name + part)).exists():
            shutil.copyfile(source, unfinished.with_name(unfinished.name + part))
    return unfinished


def finish_copy(unfinished: Path, copy: Path) -> None:
    """Put a finished copy in its place.

    The write-ahead log of an earlier copy, which a process that was killed leaves behind, would be read as if it were
    the new one's.
    """
    for part in ("-wal", "-shm"):
        copy.with_name(copy.name + part).unlink(missing_ok=True)
    unfinished.replace(copy)
