"""Cameras that are known already: transforms.json, Blender's transforms_train/test.json, or a COLMAP model.

Poses in transforms files are world_from_camera with OpenGL axes (x right, y up, z backward); they are turned to
OpenCV axes here and nowhere else. Photos are told apart by their own names, as ingest noted them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from nerf.scene import Camera
from stages.colmap.cameras import camera_rays, rescaled
from stages.colmap.model_files import FARTHEST
from stages.colmap.models import read_model
from stages.contract import StageError
from stages.photos import Photo
from stages.sources import pose_matrix, read_transforms
from stages.sparse_model import SparseImage, SparseModel
from stages.transforms_export import OPENGL_FROM_OPENCV
from stages.transforms_intrinsics import flaw_of, read_intrinsics

ORTHONORMAL_WITHIN = 1e-3  # largest entry of RᵀR − 1 that is rounding; beyond it a matrix means something else
ASPECT_WITHIN = 0.01
LARGEST_ENTRY = 1e6  # of a matrix that is looked at more closely: products of three of them are numbers
MOST_NAMES = 5
TRANSFORMS_HINT = "Correct the file, or leave the cameras out to have them found from the photos."
LENS_SAMPLES = 8  # pixels along each side at which a lens must have an inverse; normalise looks at more


@dataclass(frozen=True)
class KnownCameras:
    """``test_files`` is an official split, as files relative to ingest's ``images/``; ``notes`` are for the user."""

    model: SparseModel
    test_files: list[str] | None
    notes: list[str]

    def account(self, photos: Sequence[Photo]) -> list[dict[str, Any]]:
        """What became of each photo, for registration.json."""
        seen = np.bincount(self.model.view, minlength=len(self.model.images)).tolist()
        observations = {image.file: count for image, count in zip(self.model.images, seen, strict=True)}
        return [
            {
                "file": file,
                "registered": file in observations,
                "reason": None if file in observations else "the given cameras have none for it",
                "keypoints": observations.get(file, 0),
                "observations": observations.get(file, 0),
            }
            for file in (photo.image_name for photo in photos)
        ]


@dataclass(frozen=True)
class _Posed:
    photo: Photo
    camera: Camera
    world_from_camera: Float[np.ndarray, "3 4"]


def read_known_cameras(cameras: Path, photos: Sequence[Photo], frames: Mapping[str, str]) -> KnownCameras:
    """Read ``cameras`` and match them to ``photos``. ``frames`` maps a transforms file's file_path to a photo's name.

    Raises StageError, naming the frame, for anything that is no camera: numbers that are not finite, a focal length
    that is not positive, a rotation that is scaled or mirrored; and where no frame has a photo.
    """
    if cameras.is_file():
        return _from_transforms((cameras,), photos, frames, test=None)
    if (train := cameras / "transforms_train.json").is_file():
        test = cameras / "transforms_test.json"
        return _from_transforms((train, test) if test.is_file() else (train,), photos, frames, test)
    return _from_colmap(cameras, photos)


# --- transforms files


def _from_transforms(
    paths: Sequence[Path], photos: Sequence[Photo], frames: Mapping[str, str], test: Path | None
) -> KnownCameras:
    by_name = {photo.name: photo for photo in photos}
    posed: dict[str, _Posed] = {}
    absent, test_files = [], []
    for path in paths:
        content = read_transforms(path)
        for frame in content["frames"]:
            name = frame["file_path"]
            photo = by_name.get(frames.get(name, ""))
            if photo is None:
                absent.append(name)
                continue
            file = photo.image_name
            if file in posed:
                raise StageError(f"two frames for the photo {photo.name}", f"one is {name!r}", TRANSFORMS_HINT)
            posed[file] = _Posed(photo, _camera({**content, **frame}, photo), _pose(frame["transform_matrix"], name))
            if path == test:
                test_files.append(file)
    return KnownCameras(
        model=_without_points([posed[file] for file in sorted(posed)], paths[0].name),
        test_files=sorted(test_files) if test_files else None,
        notes=_notes(absent, [photo.name for photo in photos if photo.image_name not in posed]),
    )


def _without_points(posed: Sequence[_Posed], source: str) -> SparseModel:
    if not posed:
        raise _nothing_matches(source)
    cameras = list(dict.fromkeys(p.camera for p in posed))
    images = [SparseImage(p.photo.image_name, cameras.index(p.camera), p.world_from_camera) for p in posed]
    return SparseModel.without_points(cameras, images)


def _camera(values: Mapping[str, Any], photo: Photo) -> Camera:
    """The intrinsics of one frame (its own values over those of the file), at the photo's size."""
    name = values["file_path"]
    try:
        camera = read_intrinsics(values, photo.width, photo.height)
    except ValueError as error:
        raise _wrong(f"the camera of frame {name!r}", str(error)) from error
    return _at_size_of(photo, camera, name)


def _pose(matrix: Any, name: str) -> Float[np.ndarray, "3 4"]:
    """world_from_camera with OpenCV axes, from a matrix as written in a transforms file."""
    try:
        pose = pose_matrix(matrix)
    except ValueError as error:
        raise _wrong(f"frame {name!r}", str(error)) from error
    if (place := np.abs(pose[:, 3]).max()) > FARTHEST:
        why = f"its place is {place:.3g} units from the origin, and the most is {FARTHEST:g}"
        raise _wrong(f"the transform_matrix of frame {name!r}", why)
    rotation = pose[:, :3]
    if not np.abs(rotation).max() <= LARGEST_ENTRY:
        raise _wrong(
            f"the transform_matrix of frame {name!r}", f"it is no rotation: {np.abs(rotation).max():.3g} is in it"
        )
    if (determinant := np.linalg.det(rotation)) < 0:
        raise _wrong(f"the transform_matrix of frame {name!r}", "it mirrors (its determinant is negative)")
    off = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not off <= ORTHONORMAL_WITHIN:
        why = f"it is no rotation: RᵀR is off by {off:.2g}, and it scales by {np.cbrt(determinant):.4g}"
        raise _wrong(f"the transform_matrix of frame {name!r}", why)
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt @ OPENGL_FROM_OPENCV, pose[:, 3:]], axis=1)


def _wrong(what: str, why: str) -> StageError:
    return StageError(f"cannot use {what}", why, TRANSFORMS_HINT)


# --- COLMAP models


def _from_colmap(folder: Path, photos: Sequence[Photo]) -> KnownCameras:
    given = read_model(folder)
    photo_of = _by_name([image.file for image in given.images], photos)
    kept = sorted(photo_of, key=lambda i: photo_of[i].image_name)
    if not kept:
        raise _nothing_matches(folder.name)
    own = {i: given.cameras[given.images[i].camera] for i in kept}
    cameras_of = [_at_size_of(photo_of[i], own[i], given.images[i].file) for i in kept]
    cameras = list(dict.fromkeys(cameras_of))
    images = [
        SparseImage(photo_of[i].image_name, cameras.index(camera), given.images[i].sfm_from_camera)
        for i, camera in zip(kept, cameras_of, strict=True)
    ]
    scales = [_scale(own[i], photo_of[i]) for i in kept]
    posed = {photo.image_name for photo in photo_of.values()}
    model, behind = given.restricted(kept, scales, cameras, images).without_points_behind()
    notes = _notes(
        [image.file for i, image in enumerate(given.images) if i not in photo_of],
        [photo.name for photo in photos if photo.image_name not in posed],
    )
    if behind:
        notes.append(f"{behind} observations of points behind their cameras are left out")
    return KnownCameras(model, None, notes)


def _by_name(names: Sequence[str], photos: Sequence[Photo]) -> dict[int, Photo]:
    """Photo by index of its image: of the same name, else alone with the same last part of the name."""
    exact = {photo.name: photo for photo in photos} | {photo.image_name: photo for photo in photos}
    last: dict[str, list[Photo]] = {}
    for photo in photos:
        last.setdefault(PurePosixPath(photo.name).name, []).append(photo)
    alone = {name: same[0] for name, same in last.items() if len(same) == 1}
    found: dict[int, Photo] = {}
    for index, name in enumerate(names):
        photo = exact.get(name) or alone.get(PurePosixPath(name).name)
        if photo is None:
            continue
        if photo in found.values():
            raise StageError(f"two cameras for the photo {photo.name}", f"one is that of {name!r}", TRANSFORMS_HINT)
        found[index] = photo
    return found


# --- both


def _scale(camera: Camera, photo: Photo) -> tuple[float, float]:
    return photo.width / camera.width, photo.height / camera.height


def _at_size_of(photo: Photo, camera: Camera, name: str) -> Camera:
    """``camera`` rescaled where the photo has another size. Raises StageError where it has another shape, too, and for
    a lens that is none."""
    if flaw := flaw_of(camera):
        raise _wrong(f"the camera of {name!r}", flaw)
    camera_rays(camera, LENS_SAMPLES, LENS_SAMPLES)
    across, down = _scale(camera, photo)
    if across == down == 1:
        return camera
    if abs(across / down - 1) > ASPECT_WITHIN:
        raise _wrong(
            f"the camera of {name!r}",
            f"it is for {camera.width}×{camera.height} pixels, the photo has {photo.width}×{photo.height}",
        )
    return rescaled(camera, photo.width, photo.height)


def _nothing_matches(source: str) -> StageError:
    return StageError(
        f"no camera in {source} belongs to a photo",
        "none of the names in it is the name of a photo",
        "Give the folder of the very photos that the cameras were made for.",
    )


def _notes(absent: Sequence[str], unposed: Sequence[str]) -> list[str]:
    notes = []
    for names, what in ((absent, "cameras have no photo"), (unposed, "photos have no camera and are left out")):
        if names:
            more = ", …" if len(names) > MOST_NAMES else ""
            notes.append(f"{len(names)} {what}: {', '.join(sorted(names)[:MOST_NAMES])}{more}")
    return notes
