"""Imported poses from transforms.json and Blender's transforms_train/test.json."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from nerf.geometry.scene import Camera
from stages.contract import Note, StageError, listed
from stages.io.amounts import counted
from stages.io.photos import Photo
from stages.io.sparse_model import SparseModel
from stages.io.transforms_files import (
    MAX_LETTERS,
    is_without_pose,
    none_among_the_photos,
    pose_matrix,
    read_splits,
)
from stages.sfm.imported.conventions import SAME_POSE_WITHIN, PoseConvention, world_from_camera
from stages.sfm.imported.imported_poses import MAX_NAMES, ImportedPoses, few, notes_on_photos, nothing_matches
from stages.sfm.imported.orientation import fits_only_upright, is_centred_upright, stored_size
from stages.sfm.imported.posed_photos import PosedPhoto, distinct, posed_photo, unusable, without_rays
from stages.sfm.imported.rotations import NearestRotation, rigid
from stages.sfm.imported.transforms_intrinsics import (
    IN_PIXELS,
    SIZE,
    contradictions,
    intrinsics_of,
    is_one_angle,
    read_intrinsics,
    shared_intrinsics,
)

NOTED_STRETCH_DEG = 0.005  # of a matrix beside its scale
SCALED_WITHIN = 1e-3  # of 1: what rounding makes of a rotation's scale
APPROXIMATION = "approximation"  # how the note begins of a camera model that stands for another


class _Framed(NamedTuple):
    photo: Photo
    where: str  # its frame, in words
    frame: Mapping[str, Any]
    values: Mapping[str, Any]  # of the frame, and of its file what the frame has none of


def read_transforms_poses(
    cameras: Path, photos: Sequence[Photo], frames: Mapping[str, str], convention: PoseConvention
) -> ImportedPoses:
    """Poses of a transforms file, or of a Blender-style folder of them. ``frames`` maps a file_path to a photo's name.
    Raises StageError, naming the frame."""
    splits, notes = read_splits(cameras, lambda frame: frames.get(frame["file_path"]) in {p.name for p in photos})
    found = _match_frames(splits, {photo.name: photo for photo in photos}, frames, notes)
    framed = found.framed
    if not framed:
        raise _nothing_usable(splits[0][0], found, photos)
    notes += _contradictions([content for _, content in splits], framed)
    _check_shared([content for _, content in splits], list(framed.values()))
    upright = _are_of_upright_photos(framed.values())
    posed, rotations = zip(*(_from_frame(framed[file], upright, convention) for file in sorted(framed)), strict=True)
    notes += _rounded_or_scaled({one.name: rotation for one, rotation in zip(posed, rotations, strict=True)})
    left_out = without_rays(posed)
    kept = [one for one in posed if one.file not in left_out]
    known = framed.keys() | found.unused.keys() | found.poseless.keys()
    unposed = [photo.name for photo in photos if photo.image_name not in known]
    kept_tests = sorted(set(found.test_files) - left_out.keys())
    if found.test_files and not kept_tests:
        words = "all official test photos are left out, so other photos become test photos"
        notes.append(Note("sfm.tests-left-out", words))
    return ImportedPoses(
        model=SparseModel.without_points(*distinct(kept)),
        left_out=left_out
        | dict.fromkeys(found.unused, Note("sfm.unregistered-in-no-split", "it is in no split of the transforms file"))
        | dict.fromkeys(found.poseless, Note("sfm.unregistered-frame-without-pose", "its frame has no pose")),
        test_files=kept_tests or None,
        notes=notes_on_photos(found.absent, unposed, posed, left_out) + notes,
    )


@dataclass
class _MatchedFrames:
    """Frames with a photo, by file; what became of the others."""

    framed: dict[str, _Framed] = field(default_factory=dict)
    test_files: list[str] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)  # by file_path: no such photo
    unused: dict[str, str] = field(default_factory=dict)  # photo by file: in no split
    poseless: dict[str, str] = field(default_factory=dict)  # photo by file


def _match_frames(
    splits: Sequence[tuple[str, Mapping[str, Any]]],
    by_name: Mapping[str, Photo],
    frames: Mapping[str, str],
    notes: list[Note],
) -> _MatchedFrames:
    found, repeated = _MatchedFrames(), []
    for where, content in splits:
        held_out, in_no_split = _split(content, where, notes)
        for frame in content["frames"]:
            name = frame["file_path"]
            photo = by_name.get(frames.get(name, ""))
            if photo is None:
                found.absent.append(name)
                continue
            file = photo.image_name
            if PurePosixPath(name) in in_no_split:
                found.unused[file] = photo.name
                continue
            if is_without_pose(frame["transform_matrix"]):
                found.poseless[file] = photo.name
                continue
            one = _framed(photo, frame, content, where)
            if file in found.framed:
                if differ := _differences(found.framed[file].values, one.values):
                    raise _two_frames(photo.name, where, found.framed[file].frame["file_path"], name, differ)
                repeated.append(name)
                continue
            found.framed[file] = one
            if PurePosixPath(name) in held_out:
                found.test_files.append(file)
        if held_out and not found.test_files:
            notes.append(none_among_the_photos(len(held_out), where))
    notes += _on_frames(found, repeated)
    return found


def _framed(photo: Photo, frame: Mapping[str, Any], content: Mapping[str, Any], source: str) -> _Framed:
    where = f"frame {frame['file_path']!r} of {source}"
    try:
        return _Framed(photo, where, frame, intrinsics_of(frame, content))
    except ValueError as error:
        raise _wrong_intrinsics(where, error) from error


def _on_frames(found: _MatchedFrames, repeated: Sequence[str]) -> list[Note]:
    """Notes on frames that are listed twice, have no pose, or say that their camera model is another."""
    notes = []
    if repeated:
        notes.append(
            Note("sfm.repeated-frames", f"the file repeats {counted(len(repeated), 'frame')}: {few(repeated)}")
        )
    approximate = [one for one in found.framed.values() if str(one.values.get("note", "")).startswith(APPROXIMATION)]
    if approximate:
        words = (
            f"the camera models of {counted(len(approximate), 'frame')} are approximations, according to the notes in "
            "the file"
        )
        notes.append(Note("sfm.approximate-cameras", words))
    if found.poseless:
        count = f"{len(found.poseless)} of {len(found.poseless) + len(found.framed)} frames"
        words = f"{count} have no pose (null, zeros or NaN), so their photos are left out"
        notes.append(Note("sfm.frames-without-pose", f"{words}: {few(sorted(found.poseless.values()))}"))
    if found.unused:
        names = few(sorted(found.unused.values()))
        words = f"{counted(len(found.unused), 'photo is', 'photos are')} left out, in no split of the file: {names}"
        notes.append(Note("sfm.in-no-split", words))
    return notes


def _nothing_usable(source: str, found: _MatchedFrames, photos: Sequence[Photo]) -> StageError:
    if not found.poseless:
        return nothing_matches(source, found.absent, photos)
    return unusable(
        "sfm.no-poses",
        f"the poses of {source}",
        f"the transform_matrix of all {counted(len(found.poseless), 'frame')} is null, zeros or NaN",
    )


def _differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """The keys in which two frames of a photo differ, but for how they spell its name, and for rounding."""
    differ = {key for key in first.keys() | second.keys() if first.get(key) != second.get(key)} - {"file_path"}
    try:
        first_pose, second_pose = (pose_matrix(one["transform_matrix"]) for one in (first, second))
        if np.allclose(first_pose, second_pose, rtol=SAME_POSE_WITHIN, atol=SAME_POSE_WITHIN):
            differ -= {"transform_matrix"}
    except ValueError:  # no matrices: they differ as they stand
        pass
    return sorted(differ)


def _two_frames(photo: str, source: str, first: str, second: str, differ: Sequence[str]) -> StageError:
    which = f"{first!r} is listed twice" if first == second else f"they are {first!r} and {second!r}"
    return StageError(
        "sfm.two-frames",
        f"two frames of {source} for the photo {photo} differ",
        f"{which}, with different {few(differ)}",
        "Remove one of them and run again.",
    )


def _split(content: Mapping[str, Any], source: str, notes: list[Note]) -> tuple[set[PurePosixPath], set[PurePosixPath]]:
    """The official test photos by file_path, nerfstudio's ``test_filenames``, else its ``val_filenames``, less those
    that its ``train_filenames`` have as well; and the frames that are in no split, where there are such. What is
    repeated is noted."""
    train = _listed(content, "train_filenames", source, notes)
    of_frames = {PurePosixPath(frame["file_path"]) for frame in content["frames"]}
    for key in ("test_filenames", "val_filenames"):
        names = _listed(content, key, source, notes)
        if repeated := len(names & train):
            notes.append(
                Note(
                    "sfm.tests-repeat-training",
                    f"{key} of {source} repeats {repeated} training photos: they remain training photos",
                )
            )
        if own := names - train:
            return own, of_frames - train - own if train else set()
    return set(), of_frames - train if train else set()


def _listed(content: Mapping[str, Any], key: str, source: str, notes: list[Note]) -> set[PurePosixPath]:
    """The photos in a list of a transforms file, by file_path. Of names that no frame has, a note is left. Raises
    StageError where none has a frame."""
    names = content.get(key) or []
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise unusable("sfm.split-no-list", f"the {key} of {source}", "it is not a list of names")
    of_frames = {PurePosixPath(frame["file_path"]) for frame in content["frames"]}
    strange = [name[:MAX_LETTERS] for name in names if PurePosixPath(name) not in of_frames]
    if strange and len(strange) == len(names):
        raise unusable(
            "sfm.split-of-no-frame",
            f"the {key} of {source}",
            f"no frame has one of its names as file_path: {few(strange)}",
        )
    if strange:
        notes.append(
            Note("sfm.split-photos-unknown", f"{len(strange)} names in {key} of {source} have no frame: {few(strange)}")
        )
    return set(map(PurePosixPath, names))


def _contradictions(files: Sequence[Mapping[str, Any]], framed: Mapping[str, _Framed]) -> list[Note]:
    """Notes on what files and frames say of a camera twice and not alike."""
    size = next((one.photo.width, one.photo.height) for one in framed.values())
    notes = [
        Note("sfm.file-contradicts-itself", f"all frames: {what}")
        for content in files
        for what in contradictions(content, *size)
    ]
    of_frames = {
        one.frame["file_path"]: what
        for one in framed.values()
        if (what := contradictions(one.frame, *(one.values.get(s) or o for s, o in zip("wh", size, strict=True))))
    }
    if of_frames:
        name, what = next(iter(of_frames.items()))
        more = f" ({len(of_frames) - 1} more frames have the same fault)" if len(of_frames) > 1 else ""
        notes.append(Note("sfm.frame-contradicts-itself", f"frame {name!r}: {'; '.join(what)}{more}"))
    return notes


def _check_shared(files: Sequence[Mapping[str, Any]], framed: Sequence[_Framed]) -> None:
    """Raises StageError where intrinsics of a file can be right for some of its photos alone: pixels without the size
    that they are of, for photos of several sizes; one angle across, for photos that lie and photos that stand."""
    stored, upright = ({size(one.photo) for one in framed} for size in (stored_size, lambda p: (p.width, p.height)))
    if min(len(stored), len(upright)) < 2:
        return
    sizes = listed(sorted("{}×{}".format(*size) for size in stored), MAX_NAMES)
    for file in files:
        shared = [shared_intrinsics(one.frame, file) for one in framed]
        where = f"the intrinsics of all frames, for photos of {len(stored)} sizes ({sizes})"
        if any("w" not in one and not one.keys().isdisjoint(IN_PIXELS) for one in shared):
            why = "they are in pixels, but w and h are missing"
            raise unusable("sfm.shared-pixels", where, f"{why}: add w and h, or write the intrinsics in each frame")
        stand = {one.photo.height > one.photo.width for one, of in zip(framed, shared, strict=True) if is_one_angle(of)}
        if len(stand) > 1:
            why = "landscape and portrait photos cannot share one camera_angle_x"
            raise unusable("sfm.shared-angle", where, f"{why}: write it in each frame")


def _are_of_upright_photos(framed: Iterable[_Framed]) -> bool:
    """Whether the cameras are of photos that were turned upright first, as their shapes alone do not tell of half turns
    and squares: a frame names the photo beside the decoded, upright picture that its camera is of, as in our own
    exports, or fits a photo only when that is upright: by its size or, without one, by its principal point."""
    return any(isinstance(one.frame.get("photo"), str) or _is_of_upright_photo(one) for one in framed)


def _is_of_upright_photo(framed: _Framed) -> bool:
    camera = _given_camera(framed, upright=False)
    fits = fits_only_upright if framed.values.keys() >= {*SIZE} else is_centred_upright
    return fits(camera, framed.photo)


def _given_camera(framed: _Framed, upright: bool) -> Camera:
    """The camera of a frame as it stands there, in the size of the photo, ``upright`` or as stored, where it has none
    of its own."""
    photo = framed.photo
    size = (photo.width, photo.height) if upright else stored_size(photo)
    try:
        return read_intrinsics(framed.values, *size)
    except ValueError as error:
        raise _wrong_intrinsics(framed.where, error) from error


def _wrong_intrinsics(where: str, why: ValueError) -> StageError:
    return unusable("sfm.frame-intrinsics", f"the camera of {where}", str(why))


def _from_frame(framed: _Framed, upright: bool, convention: PoseConvention) -> tuple[PosedPhoto, NearestRotation]:
    name = framed.frame["file_path"]
    matrix, rotation = rigid(framed.frame["transform_matrix"], framed.where)
    pose = world_from_camera(matrix, convention)
    return posed_photo(framed.photo, name, framed.where, _given_camera(framed, upright), pose, upright), rotation


def _rounded_or_scaled(rotations: Mapping[str, NearestRotation]) -> list[Note]:
    """Notes on matrices, by their frames' names, that are not rotations as they stand."""
    notes = []
    if rounded := {name: r.stretch_deg for name, r in rotations.items() if r.stretch_deg > NOTED_STRETCH_DEG}:
        off = f"off by up to {max(rounded.values()):.2g}°"
        notes.append(
            Note(
                "sfm.rounded-rotations",
                f"the rotations of {counted(len(rounded), 'frame')} are rounded and {off}: {few(list(rounded))}",
            )
        )
    if scaled := {name: r.scale for name, r in rotations.items() if abs(r.scale - 1) > SCALED_WITHIN}:
        by = " to ".join(f"{scale:.4g}" for scale in sorted({min(scaled.values()), max(scaled.values())}))
        notes.append(
            Note(
                "sfm.scaled-matrices",
                f"the matrices of {counted(len(scaled), 'frame')} scale by {by}; the scale is ignored: "
                f"{few(list(scaled))}",
            )
        )
    return notes
