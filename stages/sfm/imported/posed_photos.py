"""Imported poses as those of upright photos: turned with them, of their size, with a ray for every pixel."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Camera
from stages.contract import Note, StageError
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.photos import Photo
from stages.io.sparse_model import SparseImage
from stages.sfm.colmap.cameras import (
    native,
    no_ray,
    rescaled,
    share_without_ray,
    turned_camera,
    turned_pose,
    why_no_ray,
)
from stages.sfm.imported.orientation import is_of_stored_pixels, same_shape
from stages.sfm.imported.transforms_intrinsics import why_unusable

HINT = "Correct it and run again, or leave out the cameras to find them from the photos: pipeline run FOLDER"


@dataclass(frozen=True)
class PosedPhoto:
    """A photo and its camera; ``name`` is its own in the file or model that the camera comes from."""

    photo: Photo
    name: str
    camera: Camera  # of the upright photo
    world_from_camera: Float[np.ndarray, "3 4"]
    turns: int  # quarter turns clockwise that made the camera upright

    @property
    def file(self) -> str:
        """The photo's, relative to ingest's ``images/``."""
        return self.photo.image_name


def posed_photo(
    photo: Photo, name: str, where: str, camera: Camera, world_from_camera: Float[np.ndarray, "3 4"], upright: bool
) -> PosedPhoto:
    """A camera, given under ``name``, as one of the upright photo; ``upright`` is as :func:`is_of_stored_pixels` has
    it. Raises StageError, saying ``where`` it stands, for a camera that is none and for another shape than the
    photo's."""
    turns = _turns(photo, camera, where, upright)
    camera = _at_size_of(photo, turned_camera(camera, turns), where)
    return PosedPhoto(photo, name, camera, turned_pose(world_from_camera, turns), turns)


def _turns(photo: Photo, camera: Camera, where: str, upright: bool) -> int:
    """How many quarter turns clockwise make an imported camera one of the upright photo. Raises StageError for a camera
    that is none, and where the photo was mirrored, which no camera can be."""
    if why_degenerate := why_unusable(camera):
        raise unusable("sfm.degenerate-camera", f"the camera of {where}", why_degenerate)
    if not is_of_stored_pixels(camera, photo, upright):
        return 0
    if photo.orientation not in QUARTER_TURNS:
        raise StageError(
            "sfm.mirrored-photo",
            f"cannot use the camera of {where}",
            f"the EXIF orientation {photo.orientation} of {photo.name} mirrors the photo, and no camera pose mirrors",
            "Leave out the cameras, or make them for photos that are saved upright, without an EXIF orientation.",
        )
    return QUARTER_TURNS[photo.orientation]


def _at_size_of(photo: Photo, camera: Camera, where: str) -> Camera:
    """``camera`` rescaled where the photo has another size. Raises StageError where it has another shape, too."""
    size = (photo.width, photo.height)
    if (camera.width, camera.height) == size:
        return camera
    if not same_shape(camera, size):
        raise unusable(
            "sfm.photo-shape",
            f"the camera of {where}",
            f"it has {camera.width}×{camera.height} pixels, and the photo has {photo.width}×{photo.height}",
        )
    return rescaled(camera, *size)


def without_rays(posed: Collection[PosedPhoto]) -> dict[str, Note]:
    """Which photos have a camera without a ray for some of their pixels, by file, and what is to be said of it. Raises
    StageError, with a name, where half of them have: without these there is no scene."""
    lost = {camera: share_without_ray(native(camera)) for camera in {one.camera for one in posed}}
    bent = [one for one in posed if lost[one.camera]]
    if bent and 2 * len(bent) >= len(posed):
        raise no_ray(bent[0].camera, lost[bent[0].camera], of=bent[0].name)
    why = "its imported camera cannot be used"
    return {
        one.file: Note(
            "sfm.unregistered-no-ray",
            f"{why}: {why_no_ray(one.camera.model)} at {100 * lost[one.camera]:.3g}% of the pixels",
        )
        for one in bent
    }


def distinct(posed: Collection[PosedPhoto]) -> tuple[list[Camera], list[SparseImage]]:
    """Each camera once, and the images that have them."""
    cameras = list(dict.fromkeys(p.camera for p in posed))
    return cameras, [SparseImage(p.file, cameras.index(p.camera), p.world_from_camera) for p in posed]


def unusable(code: str, what: str, why: str) -> StageError:
    """The error for what stands in a file of cameras."""
    return StageError(code, f"cannot use {what}", why, HINT)
