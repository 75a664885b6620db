"""Features and matches: everything that fills COLMAP's database. Call it in a child process."""

import shutil
from collections.abc import Container, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap

    from stages.photos import Photo

FOCAL_GUESS = 1.2  # focal length over the longer side where EXIF is silent: 45 degrees, a phone's wide lens
UPSAMPLE_UP_TO_PX = 1024  # smaller photos yield too few features at their own size
BLOCK_SIZE = 5  # photos per block of matching; a block of pairs is committed at once (progress, resuming)


def fill_database(database: Path, photos: "Sequence[Photo]", camera_model: str) -> None:
    """Enter photos (in order of ``file``) and one camera per camera group, all or nothing."""
    import pycolmap

    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        if db.num_images():
            return
        camera_ids: dict[int, int] = {}
        for image_id, photo in enumerate(photos, start=1):
            if photo.camera_group not in camera_ids:
                camera_ids[photo.camera_group] = _enter_camera(db, photo, camera_model, len(camera_ids) + 1)
            camera_id = camera_ids[photo.camera_group]
            image = pycolmap.Image(name=_name(photo), camera_id=camera_id, image_id=image_id)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def _enter_camera(db: "pycolmap.Database", photo: "Photo", camera_model: str, camera_id: int) -> int:
    import pycolmap

    focal_px = photo.focal_px or FOCAL_GUESS * max(photo.width, photo.height)
    camera = pycolmap.Camera.create_from_model_name(camera_id, camera_model, focal_px, photo.width, photo.height)
    camera.has_prior_focal_length = photo.focal_px is not None
    db.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    db.write_rig(rig, use_rig_id=True)
    return camera_id


def _name(photo: "Photo") -> str:
    """The photo's name inside COLMAP."""
    return photo.file.removeprefix("images/")


def extract_features(
    database: Path,
    images: Path,
    photos: "Sequence[Photo]",
    max_image_size: int,
    max_features: int,
    masks: Path | None = None,
) -> None:
    """SIFT keypoints and descriptors of every photo that has none yet, where ``masks/<image name>.png`` is not black,
    or anywhere where that is not there.

    Photos are searched from their own size down. Doubling them first, as is COLMAP's habit, costs 4.5 times as
    much and moves no camera of a well-sized photo (benchmarks/sfm_accuracy.py), so only small ones are doubled.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = max_image_size
    options.sift.max_num_features = max_features
    small = {_name(p) for p in photos if max(p.width, p.height) <= UPSAMPLE_UP_TO_PX}
    masked = {name for name in map(_name, photos) if masks and (masks / f"{name}.png").is_file()}
    # A photo without a mask has to go without a folder of masks: one that is not there is an error to COLMAP.
    for is_small, is_masked in product((True, False), (False, True)):
        names = [name for name in map(_name, photos) if (name in small, name in masked) == (is_small, is_masked)]
        if not names:
            continue
        options.sift.first_octave = -1 if is_small else 0
        reader = pycolmap.ImageReaderOptions()
        if masks and is_masked:
            reader.mask_path = masks
        pycolmap.extract_features(
            database, images, names, reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu
        )


def match_exhaustively(database: Path, seed: int, max_ratio: float) -> None:
    """Match and verify every pair of photos that has not been yet.

    ``max_ratio`` is Lowe's: the best match must be nearer than this share of the second best.
    """
    import pycolmap

    # With two threads 2 of 9 runs on the fox came out different: on the same descriptors, four pairs of photos had
    # one match more or less (it is an approximate search). With one thread that has not been seen.
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    matching.sift.max_ratio = max_ratio
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # The block size decides which photo of a pair comes first, and with it ties: it may not depend on anything.
    pairing = pycolmap.ExhaustivePairingOptions(block_size=BLOCK_SIZE)
    pycolmap.match_exhaustive(database, matching, pairing, verification, pycolmap.Device.cpu)


def copy_without_matches_of(names: Container[str], database: Path, copy: Path) -> None:
    """Copy the database, less every pair with one of these photos; nothing where the copy is there already."""
    import pycolmap

    if copy.exists():
        return
    unfinished = copy.with_suffix(".unfinished")
    for part in ("", "-wal"):  # as long as anybody reads along, the latest pages stay in the write-ahead log
        unfinished.with_name(unfinished.name + part).unlink(missing_ok=True)
        if (source := database.with_name(database.name + part)).exists():
            shutil.copyfile(source, unfinished.with_name(unfinished.name + part))
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        for first, second in combinations(images, 2):
            if first.name in names or second.name in names:
                db.delete_matches(first.image_id, second.image_id)
                db.delete_two_view_geometry(first.image_id, second.image_id)
    unfinished.replace(copy)
