"""Cameras that are known already: transforms.json, Blender's transforms_train/test.json, or a COLMAP model.

Poses in transforms files are world_from_camera with OpenGL axes (x right, y up, z backward); they are turned to
OpenCV axes here and nowhere else. Photos are told apart by their own names, as ingest noted them.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from nerf.scene import Camera
from stages.colmap.cameras import camera_rays, focal_lengths_and_centre, rescaled
from stages.colmap.model_files import FARTHEST, LARGEST_SIDE
from stages.colmap.models import read_model
from stages.contract import StageError
from stages.photos import Photo
from stages.sources import pose_matrix, read_transforms
from stages.sparse_model import SparseImage, SparseModel
from stages.transforms_export import OPENGL_FROM_OPENCV

ORTHONORMAL_WITHIN = 1e-3  # largest entry of RᵀR − 1 that is rounding; beyond it a matrix means something else
ASPECT_WITHIN = 0.01
# Focal lengths in widths of the picture: from 179° across to 20 seconds of arc, a telescope's.
FOCAL_RATIOS = (0.005, 10_000.0)
FARTHEST_CENTRE = 100.0  # in widths: where the principal point of the last corner cut out of a large picture may lie
LARGEST_ENTRY = 1e6  # of a matrix that is looked at more closely: products of three of them are numbers
MOST_NAMES = 5
MOST_LETTERS = 40  # of a value, in an error
TRANSFORMS_HINT = "Correct the file, or leave the cameras out to have them found from the photos."
LENS_SAMPLES = 8  # pixels along each side at which a lens must have an inverse; normalise looks at more
FISHEYE, RATIONAL, PANORAMA = "OPENCV_FISHEYE", "FULL_OPENCV", "EQUIRECTANGULAR"
NO_PANORAMAS = "panoramas are not supported"


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

    def number(key: str, default: float) -> float:
        return _finite(values.get(key, default), f"{key} of frame {name!r}")

    width, height = number("w", photo.width), number("h", photo.height)
    if not all(1 <= side <= LARGEST_SIDE and side.is_integer() for side in (width, height)):
        raise _wrong(f"the size of frame {name!r}", f"w and h are {width:g} and {height:g}")
    fx = number("fl_x", _focal_of(values.get("camera_angle_x"), width, name))
    fy = number("fl_y", _focal_of(values.get("camera_angle_y"), height, name) or fx)
    pinhole = (fx, fy, number("cx", width / 2), number("cy", height / 2))
    k = [number(f"k{i}", 0.0) for i in range(1, 7)]
    p = [number("p1", 0.0), number("p2", 0.0)]
    fisheye = bool(values.get("is_fisheye")) or str(values.get("camera_model", "")).endswith("FISHEYE")
    model, distortion = _distortion(k, p, FISHEYE if fisheye else str(values.get("camera_model", "")), name)
    return _at_size_of(photo, Camera(model, int(width), int(height), (*pinhole, *distortion)), name)


def _distortion(k: list[float], p: list[float], declared: str, name: str) -> tuple[str, list[float]]:
    """COLMAP's model for these terms and its parameters after fx, fy, cx, cy."""
    if declared == PANORAMA:
        raise _wrong(f"the camera model of frame {name!r}", NO_PANORAMAS)
    if declared == FISHEYE:
        return FISHEYE, k[:4]
    if any(k[3:]) and declared != RATIONAL:
        # In such files k4 multiplies r⁸, which no model of COLMAP has; FULL_OPENCV's k4 is a denominator's r².
        raise _wrong(f"the distortion of frame {name!r}", "it has a k4, and its camera_model is not FULL_OPENCV")
    if any(k[2:]):
        return RATIONAL, [k[0], k[1], *p, *k[2:]]
    if any(k) or any(p):
        return "OPENCV", [k[0], k[1], *p]
    return "PINHOLE", []


def _focal_of(angle: Any, size: float, name: str) -> float:
    """Focal length in pixels of a full viewing angle in radians across ``size`` pixels; 0 without an angle."""
    if angle is None:
        return 0.0
    angle = _finite(angle, f"the viewing angle of frame {name!r}")
    return 0.5 * size / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0


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


def _finite(value: Any, what: str) -> float:
    number = value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    if not abs(number) <= sys.float_info.max:
        raise _wrong(what, f"it is {repr(value)[:MOST_LETTERS]}, not a finite number")
    return float(number)


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
    if flaw := _flaw(camera):
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


def _flaw(camera: Camera) -> str | None:
    """What is wrong with intrinsics that no lens and no crop could have."""
    if camera.model == PANORAMA:
        return NO_PANORAMAS
    if not np.isfinite(camera.params).all():
        return f"its parameters are not finite: {', '.join(f'{value:.5g}' for value in camera.params)}"
    focal, centre = focal_lengths_and_centre(camera)
    longer = max(camera.width, camera.height)
    if not all(FOCAL_RATIOS[0] <= value / longer <= FOCAL_RATIOS[1] for value in focal):
        pixels = " × ".join(f"{value:.5g}" for value in focal)
        return f"a focal length of {pixels} pixels is not one for a picture of {camera.width}×{camera.height}"
    if max(map(abs, centre), default=0.0) > FARTHEST_CENTRE * longer:
        place = ", ".join(f"{value:.5g}" for value in centre)
        return f"its principal point ({place}) is far outside of its {camera.width}×{camera.height} pixels"
    return None


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
