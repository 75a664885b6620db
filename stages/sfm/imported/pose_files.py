"""Imported poses: transforms.json, Blender's transforms_train/test.json, COLMAP models, LLFF's file.

Poses in transforms files are world_from_camera with OpenGL axes (x right, y up, z backward), in COLMAP models
camera_from_world with OpenCV axes, unless the user says otherwise; here they become world_from_camera with OpenCV axes.
Photos are told apart by their own names, as ingest noted them. Cameras of photos as their files store them are turned
upright as ingest turned the photos.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Camera
from stages.contract import Note, StageError, listed
from stages.ingest.sources import LLFF, own_registration
from stages.io.colmap_files import MAX_COORDINATE
from stages.io.photos import Photo
from stages.io.sparse_model import SparseModel
from stages.io.transforms_files import (
    MAX_LETTERS,
    TRAIN,
    is_without_pose,
    none_among_the_photos,
    pose_matrix,
    read_splits,
)
from stages.sfm.colmap.models import read_model
from stages.sfm.imported.conventions import (
    AS_DECLARED,
    OF_COLMAP,
    OF_LLFF,
    OF_TRANSFORMS,
    PoseConvention,
    inverse,
    world_from_camera,
)
from stages.sfm.imported.llff import read_llff
from stages.sfm.imported.orientation import fits_only_upright, pixel_map, stored_size
from stages.sfm.imported.photo_names import other_spelling, photos_by_name
from stages.sfm.imported.posed_photos import PosedPhoto, distinct, posed_photo, unusable, without_rays
from stages.sfm.imported.transforms_intrinsics import (
    IN_PIXELS,
    contradictions,
    intrinsics_of,
    is_one_angle,
    read_intrinsics,
    shared_intrinsics,
)
from stages.sfm.registration import told

# The root mean square stretch of a matrix beside its scale, as an angle, is about what its rotation is off by where the
# numbers were rounded: 0.02° of three decimals, 0.2° of two. Beyond this a matrix is no rotation.
MAX_STRETCH_DEG, NOTED_STRETCH_DEG = 0.05, 0.005
SCALED_WITHIN = 1e-3  # of 1: what rounding makes of a rotation's scale
MAX_ENTRY = 1e6  # of a matrix that is looked at more closely: products of three of them are numbers
SAME_POSE_WITHIN = 1e-6  # relatively: what floats of 32 bits make of two copies
MAX_NAMES, MAX_NAMES_OF_ERROR = 5, 2
APPROXIMATION = "approximation"  # how the note begins of a camera model that stands for another


@dataclass(frozen=True)
class ImportedPoses:
    """``left_out``: why photos are that have a camera; ``test_files``: an official split; both by files relative to
    ingest's ``images/``. ``notes`` are for the user."""

    model: SparseModel
    left_out: dict[str, Note]
    test_files: list[str] | None
    notes: list[Note]

    def account(self, photos: Sequence[Photo]) -> list[dict[str, Any]]:
        """What became of each photo, for registration.json."""
        seen = np.bincount(self.model.view, minlength=len(self.model.images)).tolist()
        observations = {image.file: count for image, count in zip(self.model.images, seen, strict=True)}
        without = Note("sfm.unregistered-no-imported-pose", "it has no imported pose")
        reasons = self.left_out | dict.fromkeys(observations)
        return [
            {
                "file": file,
                "registered": file in observations,
                **told(reasons.get(file, without)),
                "keypoints": observations.get(file, 0),
                "observations": observations.get(file, 0),
            }
            for file in (photo.image_name for photo in photos)
        ]


class _Framed(NamedTuple):
    photo: Photo
    where: str  # its frame, in words
    frame: Mapping[str, Any]
    values: Mapping[str, Any]  # of the frame, and of its file what the frame has none of


def read_poses(
    cameras: Path, photos: Sequence[Photo], frames: Mapping[str, str], convention: PoseConvention = AS_DECLARED
) -> ImportedPoses:
    """Read ``cameras`` and match them to ``photos``. ``frames`` maps a transforms file's file_path to a photo's name.

    Raises StageError, naming the frame, for anything that is no camera: numbers that are not finite, a focal length
    that is not positive, a rotation that is scaled or mirrored; and where no frame has a photo.
    """
    convention = convention.with_defaults(convention_of_format(cameras))
    if cameras.suffix.lower() == LLFF:
        return _from_llff(cameras, photos, frames, convention)
    if _is_transforms(cameras):
        return _from_transforms(cameras, photos, frames, convention)
    return _from_colmap(cameras, photos, convention)


def convention_of_format(cameras: Path) -> PoseConvention:
    """Of the poses in these files, unless the user says otherwise."""
    if cameras.suffix.lower() == LLFF:
        return OF_LLFF
    return OF_TRANSFORMS if _is_transforms(cameras) else OF_COLMAP


def _is_transforms(cameras: Path) -> bool:
    """Whether cameras stand in a transforms file, or a Blender-style folder of them, and not in a COLMAP model."""
    return cameras.is_file() or (cameras / TRAIN).is_file()


# --- transforms files


def _from_transforms(
    cameras: Path, photos: Sequence[Photo], frames: Mapping[str, str], convention: PoseConvention
) -> ImportedPoses:
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
        notes=_notes(found.absent, unposed, posed, left_out) + notes,
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
        notes.append(Note("sfm.repeated-frames", f"the file repeats {len(repeated)} frames: {_few(repeated)}"))
    approximate = [one for one in found.framed.values() if str(one.values.get("note", "")).startswith(APPROXIMATION)]
    if approximate:
        words = f"the camera models of {len(approximate)} frames are approximations, according to the notes in the file"
        notes.append(Note("sfm.approximate-cameras", words))
    if found.poseless:
        count = f"{len(found.poseless)} of {len(found.poseless) + len(found.framed)} frames"
        words = f"{count} have no pose (null, zeros or NaN), so their photos are left out"
        notes.append(Note("sfm.frames-without-pose", f"{words}: {_few(sorted(found.poseless.values()))}"))
    if found.unused:
        names = _few(sorted(found.unused.values()))
        words = f"{len(found.unused)} photos are in no split of the file and are left out: {names}"
        notes.append(Note("sfm.in-no-split", words))
    return notes


def _nothing_usable(source: str, found: _MatchedFrames, photos: Sequence[Photo]) -> StageError:
    if not found.poseless:
        return _nothing_matches(source, found.absent, photos)
    return unusable(
        "sfm.no-poses",
        f"the poses of {source}",
        f"the transform_matrix of all {len(found.poseless)} frames is null, zeros or NaN",
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
        f"{which}, with different {_few(differ)}",
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
            f"no frame has one of its names as file_path: {_few(strange)}",
        )
    if strange:
        notes.append(
            Note(
                "sfm.split-photos-unknown", f"{len(strange)} names in {key} of {source} have no frame: {_few(strange)}"
            )
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
            why = "they are in pixels, and no w and h tell of which size"
            raise unusable("sfm.shared-pixels", where, f"{why}: write w and h beside them, or intrinsics in each frame")
        stand = {one.photo.height > one.photo.width for one, of in zip(framed, shared, strict=True) if is_one_angle(of)}
        if len(stand) > 1:
            why = "one camera_angle_x cannot be that of photos that lie and of photos that stand"
            raise unusable("sfm.shared-angle", where, f"{why}: write it in each frame")


def _are_of_upright_photos(framed: Iterable[_Framed]) -> bool:
    """Whether the cameras are of photos that were turned upright first, as their shapes alone do not tell of half turns
    and squares: a frame names the photo beside the decoded, upright picture that its camera is of, as in our own
    exports, or fits a photo only when that is upright."""
    return any(
        isinstance(one.frame.get("photo"), str) or fits_only_upright(_given_camera(one, upright=False), one.photo)
        for one in framed
    )


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


class _Rotation(NamedTuple):
    """The rotation nearest to a matrix, by which it ``scales``, and the ``stretch_deg`` that is left."""

    matrix: Float[np.ndarray, "3 3"]
    scale: float
    stretch_deg: float


def _from_frame(framed: _Framed, upright: bool, convention: PoseConvention) -> tuple[PosedPhoto, _Rotation]:
    name = framed.frame["file_path"]
    matrix, rotation = _rigid(framed.frame["transform_matrix"], framed.where)
    pose = world_from_camera(matrix, convention)
    return posed_photo(framed.photo, name, framed.where, _given_camera(framed, upright), pose, upright), rotation


def _rigid(matrix: Any, where: str) -> tuple[Float[np.ndarray, "3 4"], _Rotation]:
    """A matrix as written in a transforms file with the rotation that is nearest to it."""
    what = f"the transform_matrix of {where}"
    try:
        pose = pose_matrix(matrix)
    except ValueError as error:
        raise unusable("sfm.frame-pose", what, str(error)) from error
    if (distance := np.abs(pose[:, 3]).max()) > MAX_COORDINATE:
        why = f"its position is {distance:.3g} units from the origin; the limit is {MAX_COORDINATE:g}"
        raise unusable("sfm.pose-far-away", what, why)
    if not (largest := np.abs(pose[:, :3]).max()) <= MAX_ENTRY:
        raise unusable("sfm.pose-large-entry", what, f"it is no rotation: it holds {largest:.3g}")
    if np.linalg.det(pose[:, :3]) < 0:
        raise StageError(
            "sfm.pose-mirrors",
            f"cannot use {what}",
            "it mirrors (its determinant is negative): the world is left-handed, or one camera axis is reversed",
            "Negate one row of every matrix if the world is left-handed (Unity, Unreal), else the column of that axis.",
        )
    rotation = _nearest_rotation(pose[:, :3])
    if not rotation.stretch_deg <= MAX_STRETCH_DEG:
        off = f"its axes are off by {rotation.stretch_deg:.2g}°, and it scales by {rotation.scale:.4g}"
        why = f"it is no rotation: {off if rotation.scale > 0 else 'its determinant is 0'}"
        raise unusable("sfm.pose-no-rotation", what, why)
    return np.concatenate([rotation.matrix, pose[:, 3:]], axis=1), rotation


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> _Rotation:
    """By singular values (Schönemann 1966); infinitely stretched where one of them is 0."""
    u, stretch, vt = np.linalg.svd(matrix)
    scale = float(np.cbrt(stretch.prod()))
    off = np.degrees(np.sqrt(np.mean((stretch / scale - 1) ** 2))) if scale > 0 else np.inf
    return _Rotation(u @ vt, scale, float(off))


def _rounded_or_scaled(rotations: Mapping[str, _Rotation]) -> list[Note]:
    """Notes on matrices, by their frames' names, that are not rotations as they stand."""
    notes = []
    if rounded := {name: r.stretch_deg for name, r in rotations.items() if r.stretch_deg > NOTED_STRETCH_DEG}:
        off = f"off by up to {max(rounded.values()):.2g}°"
        notes.append(
            Note(
                "sfm.rounded-rotations",
                f"the rotations of {len(rounded)} frames are rounded and {off}: {_few(list(rounded))}",
            )
        )
    if scaled := {name: r.scale for name, r in rotations.items() if abs(r.scale - 1) > SCALED_WITHIN}:
        by = " to ".join(f"{scale:.4g}" for scale in sorted({min(scaled.values()), max(scaled.values())}))
        notes.append(
            Note(
                "sfm.scaled-matrices",
                f"the matrices of {len(scaled)} frames scale by {by}; the scale is ignored: {_few(list(scaled))}",
            )
        )
    return notes


# --- LLFF's poses_bounds.npy


def _from_llff(
    file: Path, photos: Sequence[Photo], rows: Mapping[str, str], convention: PoseConvention
) -> ImportedPoses:
    """``rows`` maps the place of a row, from 0, to a photo's name."""
    try:
        given = read_llff(file)
    except (OSError, ValueError) as error:
        raise unusable("sfm.llff-unreadable", file.name, str(error)) from error
    if len(given) != len(rows):
        why = f"it has {len(given)} rows for {len(rows)} photos; it needs one row for each photo"
        raise unusable("sfm.llff-count", file.name, why)
    by_name = {photo.name: photo for photo in photos}
    of = [(by_name[name], given[int(row)]) for row, name in rows.items() if name in by_name]
    upright = any(fits_only_upright(one.camera, photo) for photo, one in of)
    posed = []
    for photo, one in sorted(of, key=lambda pair: pair[0].image_name):
        where = f"the row of {file.name} for {photo.name!r}"
        matrix, _ = _rigid(one.world_from_camera, where)
        pose = world_from_camera(matrix, convention)
        posed.append(posed_photo(photo, photo.name, where, one.camera, pose, upright))
    left_out = without_rays(posed)
    model = SparseModel.without_points(*distinct([one for one in posed if one.file not in left_out]))
    return ImportedPoses(model, left_out, None, _notes((), (), posed, left_out))


# --- COLMAP models


def _from_colmap(folder: Path, photos: Sequence[Photo], convention: PoseConvention) -> ImportedPoses:
    given = _with_slashes(read_model(folder), photos)
    repeated = _repeated(given, folder)
    photo_of = photos_by_name([image.file for image in given.images], photos)
    if not photo_of:
        raise _nothing_matches(str(folder), [image.file for image in given.images], photos)
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
    pixel_maps = [
        pixel_map(given.cameras[given.images[i].camera], one.turns, one.photo.width, one.photo.height)
        for i, one in kept.items()
    ]
    cameras, images = distinct(kept.values())
    model, behind = given.restricted(list(kept), pixel_maps, cameras, images).without_points_behind()
    notes = _notes(
        [image.file for i, image in enumerate(given.images) if i not in photo_of and i not in repeated],
        {photo.name for photo in photos} - {photo.name for photo in photo_of.values()},
        posed.values(),
        left_out,
    )
    if others := [pair for one in kept.values() if (pair := other_spelling(one.name, one.photo))]:
        notes.append(
            Note(
                "sfm.other-spellings",
                f"{len(others)} photos take the cameras of images whose names are spelt differently: {_few(others)}",
            )
        )
    if repeated:
        names = _few(sorted(given.images[i].file for i in repeated))
        notes.append(Note("sfm.repeated-images", f"the model repeats {len(repeated)} images: {names}"))
    if not len(given.xyz):
        notes.append(Note("sfm.no-points", "the model has no points: near and far are estimated from the camera poses"))
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


# --- both


def _nothing_matches(source: str, names: Sequence[str], photos: Sequence[Photo]) -> StageError:
    here = _few([photo.name for photo in photos], MAX_NAMES_OF_ERROR)
    its = f"it has cameras of {_few(names, MAX_NAMES_OF_ERROR)}" if names else "it has no cameras"
    return StageError(
        "sfm.no-camera-matches",
        f"no camera in {source} belongs to a photo",
        f"{its}; the photos are {here}",
        "Give the folder of the photos that these cameras belong to, with their original names.",
    )


def _notes(
    absent: Collection[str], unposed: Collection[str], posed: Collection[PosedPhoto], left_out: Collection[str]
) -> list[Note]:
    notes = []
    bent = [one.photo.name for one in posed if one.file in left_out]
    for names, code, what in (
        (absent, "sfm.no-photo", "cameras have no photo"),
        (unposed, "sfm.no-camera", "photos are left out, because they have no camera"),
        (bent, "sfm.no-rays", "photos are left out, because their cameras have no ray for some pixels"),
    ):
        if names:
            notes.append(Note(code, f"{len(names)} {what}: {_few(sorted(names))}"))
    if turned := sum(one.turns > 0 and one.file not in left_out for one in posed):
        notes.append(
            Note("sfm.turned-upright", f"{turned} cameras are turned upright like their photos (EXIF orientation)")
        )
    return notes


def _few(names: Sequence[str], most: int = MAX_NAMES) -> str:
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")
