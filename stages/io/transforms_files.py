"""Transforms files: what stands in them, and which of their frames are held out."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from stages.contract import Note, StageError, listed
from stages.io.files import stand_in

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

TRAIN, HELD_OUT = "transforms_train.json", ("transforms_test.json", "transforms_val.json")  # of a Blender-style folder
MAX_PATH_BYTES, MAX_NAME_BYTES = 2000, 250  # bytes, with room for an extension
MAX_LETTERS = 60  # of a name, in an error
ROUNDED = 1e-3  # what rounding may make of a 0
MAX_KEYS = 6  # in an error
_FRAME_HINT = (
    "Rename its keys, or convert it: file_path is the file of a photo; transform_matrix is 4 × 4, world from camera, "
    "with camera axes x right, y up, z back."
)
_JSON_HINT = (
    "Correct it there, or export it again: JSON has no comments, no comma after the last entry, no single quotes, and "
    "one value in a file."
)
_HINT = "Give a transforms.json as nerfstudio, instant-ngp or the NeRF-synthetic scenes write it."


def read_transforms(transforms: Path, *, may_be_empty: bool = False) -> dict[str, Any]:
    """The content of a transforms file, checked to hold a list ``frames`` of objects with ``file_path`` and
    ``transform_matrix``. Raises StageError otherwise."""
    what = f"cannot use {transforms.name}"
    data = transforms.read_bytes()
    try:
        content = json.loads(data)  # UTF-8, 16 or 32, with a byte order mark or without
    except (ValueError, RecursionError) as error:
        why, hint = _why_no_json(data, error)
        raise StageError("io.transforms-not-json", f"cannot read {transforms.name}", why, hint) from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise StageError("io.transforms-without-frames", what, _why_no_frames(content), _HINT)
    if not (content["frames"] or may_be_empty):
        raise StageError("io.transforms-empty", what, "its list 'frames' is empty", _HINT)
    _check_frames(content["frames"], what)
    return content


def _why_no_json(data: bytes, error: Exception) -> tuple[str, str]:
    """Why a transforms file cannot be read, and what to do."""
    if why := stand_in(data[:MAX_LETTERS]):
        return why, _HINT
    if isinstance(error, UnicodeDecodeError):
        at = f"byte {error.start} is 0x{data[error.start]:02x}" if error.start < len(data) else str(error)
        return f"it is not text in UTF-8 ({at})", "Save it as UTF-8, or export it again."
    return f"it is not JSON ({error})", _JSON_HINT


def _why_no_frames(content: Any) -> str:
    if not isinstance(content, dict):
        return "it has no list named 'frames': it is " + ("a list itself" if isinstance(content, list) else "one value")
    if "frames" in content:
        kind = "an object" if isinstance(content["frames"], dict) else ascii(content["frames"])[:MAX_LETTERS]
        return f"its 'frames' is {kind} instead of a list"
    return f"it has no list named 'frames': it has {_keys(content)}"


def _check_frames(frames: list[Any], what: str) -> None:
    for index, frame in enumerate(frames):
        if not (isinstance(frame, dict) and isinstance(frame.get("file_path"), str) and "transform_matrix" in frame):
            raise StageError("io.transforms-incomplete-frame", what, _why_incomplete(index, frame), _FRAME_HINT)
        mask = frame.get("mask_path") or ""
        if not isinstance(mask, str):
            raise StageError(
                "io.transforms-mask-path", what, f"the mask_path of frame {index} is not a file name", _HINT
            )
        if wrong := next((name for name in (*photo_names(frame), mask) if not _is_name(name)), None):
            why = f"the file name in frame {index} is impossible: {ascii(wrong)[:MAX_LETTERS]}"
            raise StageError("io.transforms-file-path", what, why, _HINT)


def _why_incomplete(index: int, frame: Any) -> str:
    if not isinstance(frame, dict):
        return f"frame {index} is {ascii(frame)[:MAX_LETTERS]} instead of an object with file_path and transform_matrix"
    if "file_path" in frame and not isinstance(frame["file_path"], str):
        return f"the file_path of frame {index} is {ascii(frame['file_path'])[:MAX_LETTERS]}, which is not a file name"
    lacks = " and no ".join(key for key in ("file_path", "transform_matrix") if key not in frame)
    return f"frame {index} has no {lacks}: it has {_keys(frame)}"


def _keys(content: Mapping[str, Any]) -> str:
    return listed([ascii(key)[1:-1][:MAX_LETTERS] for key in content], MAX_KEYS) or "nothing"


def read_splits(
    cameras: Path, has_photo: Callable[[dict[str, Any]], bool]
) -> tuple[list[tuple[str, dict[str, Any]]], list[Note]]:
    """All frames of a transforms file or of a Blender-style folder: (where they stand, content of such a file), those
    held out last, with all of them as ``test_filenames``; and notes.

    Held out are the frames of transforms_test.json, else those of transforms_val.json, or the ``test_frames`` of a
    single file. Some loaders cannot do without such a file, so it may be empty, or repeat the frames to train on: these
    are left out of it, and where that leaves none that ``has_photo`` it is as if there were no file. Raises StageError
    as :func:`read_transforms` does.
    """
    if cameras.is_file():
        train, content = cameras.name, read_transforms(cameras)
        held_out = iter([_test_frames(cameras.name, content)] if "test_frames" in content else [])
    else:
        train, content = TRAIN, read_transforms(cameras / TRAIN)
        given = [name for name in HELD_OUT if (cameras / name).is_file()]
        held_out = ((name, read_transforms(cameras / name, may_be_empty=True)) for name in given)  # read as needed
    notes = []
    trained_on = {PurePosixPath(frame["file_path"]): frame["transform_matrix"] for frame in content["frames"]}
    for where, other in held_out:
        own = [frame for frame in other["frames"] if not _is_copy(frame, trained_on)]
        if repeated := len(other["frames"]) - len(own):
            notes.append(
                Note(
                    "io.tests-repeat-training",
                    f"{where} repeats {repeated} frames of {train}: they remain training photos",
                )
            )
        if own and not any(map(has_photo, own)):
            notes.append(none_among_the_photos(len(own), where))
        elif own:
            if where == HELD_OUT[1]:
                notes.append(
                    Note(
                        "io.tests-from-validation",
                        f"the test photos come from {where}, because {HELD_OUT[0]} gives none",
                    )
                )
            names = [frame["file_path"] for frame in own]
            return [(train, content), (where, other | {"frames": own, "test_filenames": names})], notes
    return [(train, content)], notes


def none_among_the_photos(count: int, where: str) -> Note:
    """The note on test photos that are not there, or that ingest rejected."""
    return Note("io.no-test-photos", f"none of the {count} test photos in {where} is among the photos")


def _is_copy(frame: dict[str, Any], trained_on: Mapping[PurePosixPath, Any]) -> bool:
    """Whether a frame has the photo and the pose of one in ``trained_on``, matrices by file_path."""
    if (path := PurePosixPath(frame["file_path"])) not in trained_on:
        return False
    try:
        return bool((pose_matrix(frame["transform_matrix"]) == pose_matrix(trained_on[path])).all())
    except ValueError:  # no matrix: said with the frame's name where cameras are read
        return False


def _test_frames(file: str, content: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The frames that lie under ``test_frames``, as ScanNet++ has them, as a file of their own."""
    where, frames = f"test_frames of {file}", content["test_frames"]
    if not isinstance(frames, list):
        raise StageError("io.transforms-split", f"cannot use {where}", "it is not a list", _HINT)
    _check_frames(frames, f"cannot use {where}")
    return where, content | {"frames": frames}


def pose_matrix(matrix: Any) -> "Float[np.ndarray, '3 4']":
    """The first three rows of a frame's ``transform_matrix``, which may be a flat list of its rows, and homogeneous: as
    a whole times a number. Raises ValueError for what is no matrix of that shape."""
    import numpy as np

    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("its transform_matrix is not a matrix of numbers") from error
    pose = pose.squeeze()
    if pose.shape in ((12,), (16,)):
        pose = pose.reshape(-1, 4)
    if pose.shape == (4, 3):
        raise ValueError("its transform_matrix is 4 × 3: it may be transposed")
    if pose.shape == (4, 4) and np.isfinite(pose).all() and pose[3, 3] and abs(pose[3, 3] - 1) > ROUNDED:
        pose = pose / pose[3, 3]
    if pose.shape == (4, 4) and (np.abs(pose[3, :3]) > ROUNDED).any():
        row = ", ".join(f"{value:.4g}" for value in pose[3])
        raise ValueError(f"the last row of its transform_matrix is {row} instead of 0, 0, 0, 1: it may be transposed")
    if pose.shape not in ((3, 4), (4, 4)) or not np.isfinite(pose[:3]).all():
        raise ValueError("its transform_matrix is not 4 × 4 (or 3 × 4) finite numbers")
    return pose[:3]


def is_without_pose(matrix: Any) -> bool:
    """Whether it stands for no pose, as programs write for photos that they could not align: null, zeros or NaN."""
    import numpy as np

    if matrix is None:
        return True
    try:
        values = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    return values.size in (12, 16) and bool(np.isnan(values).any() or not values.reshape(-1, 4)[:3, :3].any())


def photo_names(frame: dict[str, Any]) -> tuple[str, ...]:
    """What a frame calls its photo: in a file of ours by its own name first (``photo``), then ``file_path``."""
    own = frame.get("photo")
    return (own, frame["file_path"]) if isinstance(own, str) else (frame["file_path"],)


def _is_name(file_path: str) -> bool:
    """Whether it can be written as UTF-8 and is of a length that file systems take."""
    try:
        parts = file_path.encode().split(b"/")
    except UnicodeEncodeError:
        return False
    return sum(map(len, parts)) <= MAX_PATH_BYTES and max(map(len, parts)) <= MAX_NAME_BYTES
