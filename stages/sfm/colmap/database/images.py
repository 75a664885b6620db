"""Photos and their cameras, as they are entered into COLMAP's database."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import pycolmap

from nerf.geometry.scene import Camera
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import native
from stages.sfm.colmap.given_intrinsics import given_intrinsics

FOCAL_GUESS = 1.2  # focal length over the longer side where EXIF is silent: 45 degrees, a phone's main camera
MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
FISHEYE_ANGLE_DEG = 150.0  # from corner to corner where EXIF is silent

Turns = Mapping[str, int]
"""By image name the quarter turns clockwise that made a photo upright, of photos whose features are kept where their
sensor had them; all others are absent."""
NO_TURNS: Turns = MappingProxyType({})


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
    and one for each way in which it was held without. Of known ``camera_params`` all photos have their camera
    (given_intrinsics.py)."""
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        if db.num_images():
            return
        camera_ids: dict[tuple[int, int | None] | Camera, int] = {}
        known = given_intrinsics(photos, camera_model, camera_params) if camera_params else [None] * len(photos)
        for image_id, (photo, given) in enumerate(zip(photos, known, strict=True), start=1):
            group = given or (photo.camera_group, None if turns else photo.orientation)
            if group not in camera_ids:
                camera_ids[group] = camera_id = len(camera_ids) + 1
                size = size_on_sensor(photo, turns.get(photo.image_name, 0))
                camera = (
                    native(given, camera_id) if given else _first_guess(size, photo.focal_px, camera_model, camera_id)
                )
                camera.has_prior_focal_length |= given is not None
                enter_camera(db, camera)
            enter_image(db, photo.image_name, camera_ids[group], image_id)


def size_on_sensor(photo: Photo, turns: int) -> tuple[int, int]:
    return (photo.height, photo.width) if turns % 2 else (photo.width, photo.height)


def enter_camera(db: pycolmap.Database, camera: pycolmap.Camera) -> None:
    db.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    db.write_rig(rig, use_rig_id=True)


def enter_image(db: pycolmap.Database, name: str, camera_id: int, image_id: int) -> None:
    image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
    db.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    db.write_frame(frame, use_frame_id=True)


def _first_guess(size: tuple[int, int], focal_px: float | None, model: str, camera_id: int) -> pycolmap.Camera:
    """The camera of photos of this width and height: by EXIF's focal length, or by a guess."""
    fisheye = model.endswith("FISHEYE")
    guess = fisheye_focal_px(*size) if fisheye else FOCAL_GUESS * max(size)
    camera = pycolmap.Camera.create_from_model_name(camera_id, model, focal_px or guess, *size)
    # Two views through a fisheye have no fundamental matrix to do without a focal length: the guess has to serve.
    camera.has_prior_focal_length = fisheye or focal_px is not None
    return camera


def fisheye_focal_px(width: int, height: int) -> float:
    """Guess of an equidistant camera, r = f θ, with FISHEYE_ANGLE_DEG from corner to corner."""
    return math.hypot(width, height) / math.radians(FISHEYE_ANGLE_DEG)


def adopt_cameras(database: Path, model: pycolmap.Reconstruction, camera_ids: Iterable[int]) -> None:
    """Give these cameras the intrinsics that they have in the model, as known."""
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        for camera_id in sorted(camera_ids):
            camera = pycolmap.Camera(model.camera(camera_id).todict())
            camera.has_prior_focal_length = True
            db.update_camera(camera)
