"""Imported poses and points from a COLMAP model."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.contract import Note, StageError
from stages.ingest.sources.camera_files import own_registration
from stages.io.amounts import counted
from stages.io.photos import Photo
from stages.io.sparse_model import SparseModel
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.colmap.models import read_model
from stages.sfm.imported.conventions import OF_COLMAP, SAME_POSE_WITHIN, PoseConvention, inverse, world_from_camera
from stages.sfm.imported.imported_poses import ImportedPoses, few, notes_on_photos, nothing_matches
from stages.sfm.imported.orientation import fits_only_upright
from stages.sfm.imported.photo_names import other_spelling, photos_by_name
from stages.sfm.imported.posed_photos import distinct, posed_photo, without_rays


def read_colmap_model(folder: Path, photos: Sequence[Photo], convention: PoseConvention) -> ImportedPoses:
    """Poses and points of a model of text or binary files. Raises StageError, naming the image."""
    given = _with_slashes(read_model(folder), photos)
    repeated = _repeated(given, folder)
    photo_of = photos_by_name([image.file for image in given.images], photos)
    if not photo_of:
        raise nothing_matches(str(folder), [image.file for image in given.images], photos)
    upright = _is_of_upright_photos(folder, given, photo_of)
    posed = {}
    for i in sorted(photo_of, key=lambda i: photo_of[i].image_name):
        image = given.images[i]
        pose = image.sfm_from_camera
        if convention != OF_COLMAP:
            pose = world_from_camera(inverse(pose), convention)
        where = f"{image.file!r} of {folder}"
        posed[i] = posed_photo(photo_of[i], image.file, where, given.cameras[image.camera], pose, upright)
    left_out = without_rays(posed.values())
    kept = {i: one for i, one in posed.items() if one.file not in left_out}
    before = [given.cameras[given.images[i].camera] for i in kept]
    pixel_maps = [
        pixel_map((camera.width, camera.height), one.turns, one.photo.width, one.photo.height)
        for camera, one in zip(before, kept.values(), strict=True)
    ]
    cameras, images = distinct(kept.values())
    model, behind = given.restricted(list(kept), pixel_maps, cameras, images).without_points_behind()
    notes = notes_on_photos(
        [image.file for i, image in enumerate(given.images) if i not in photo_of and i not in repeated],
        {photo.name for photo in photos} - {photo.name for photo in photo_of.values()},
        posed.values(),
        left_out,
    )
    if others := [pair for one in kept.values() if (pair := other_spelling(one.name, one.photo))]:
        notes.append(
            Note(
                "sfm.other-spellings",
                f"{counted(len(others), 'photo takes the camera of an image', 'photos take the cameras of images')} "
                f"spelt differently: {few(others)}",
            )
        )
    if repeated:
        names = few(sorted(given.images[i].file for i in repeated))
        notes.append(Note("sfm.repeated-images", f"the model repeats {counted(len(repeated), 'image')}: {names}"))
    if not len(given.xyz):
        notes.append(
            Note(
                "sfm.no-points", "the model has no points: they are found by matches of the photos, where its poses fit"
            )
        )
    if behind:
        notes.append(
            Note(
                "sfm.points-behind", f"{behind} observations are left out, because their points lie behind the cameras"
            )
        )
    return ImportedPoses(model, left_out, None, notes)


def _with_slashes(model: SparseModel, photos: Sequence[Photo]) -> SparseModel:
    """``model`` with the names of its images as Windows means them, backslashes between folders, but for those that
    are a photo's own."""
    own = {photo.name for photo in photos}
    images = [replace(i, file=i.file if i.file in own else i.file.replace("\\", "/")) for i in model.images]
    return replace(model, images=images)


def _repeated(model: SparseModel, folder: Path) -> set[int]:
    """Which images of a model are there once more under an earlier number. Raises StageError where two images of a
    name have different cameras or poses."""
    first: dict[str, int] = {}
    for i, image in enumerate(model.images):
        one = model.images[first.setdefault(image.file, i)]
        is_same = model.cameras[one.camera] == model.cameras[image.camera] and np.allclose(
            one.sfm_from_camera, image.sfm_from_camera, rtol=SAME_POSE_WITHIN, atol=SAME_POSE_WITHIN
        )
        if not is_same:
            raise StageError(
                "sfm.two-images",
                f"two images of {folder} have the name {image.file!r}",
                "they have different cameras or poses, and nothing tells which of them is the photo's",
                "Remove one of them; or put the photos of each camera into a folder of its own and export again.",
            )
    return set(range(len(model.images))) - set(first.values())


def _is_of_upright_photos(folder: Path, given: SparseModel, photo_of: Mapping[int, Photo]) -> bool:
    """Whether a model is of photos that were turned upright first, as its shapes alone do not tell of half turns and
    squares: it is one of ours, or of the pictures that ingest wrote, or fits a photo only when that is upright."""
    pairs = [(given.images[i], photo) for i, photo in photo_of.items()]
    has_names_of_ingest = all(image.file == photo.image_name for image, photo in pairs)
    return (
        own_registration(folder) is not None
        or (has_names_of_ingest and any(photo.image_name != photo.name for _, photo in pairs))
        or any(fits_only_upright(given.cameras[image.camera], photo) for image, photo in pairs)
    )
