"""The cameras of photos whose intrinsics are given for one size: turned and rescaled for photos of other sizes."""

from collections import Counter
from collections.abc import Sequence

from nerf.geometry.scene import Camera
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import focal_lengths_and_centre, rescaled, turned_camera
from stages.sfm.imported.orientation import same_shape

MAX_OFF_CENTRE = 0.1  # of a size, that a principal point may be off its middle: lenses are centred to a percent or two


def given_intrinsics(photos: Sequence[Photo], model: str, params: Sequence[float]) -> list[Camera | None]:
    """The camera of each photo, None of those of another shape than the one that has these parameters.

    They belong to the size, of a photo or of one that is turned, whose middle is nearest to the principal point. EXIF
    tells how photos of the other shape were turned; without it, that a phone is held upright by a quarter turn. Raises
    ValueError where the model takes another number of parameters.
    """
    own = _own_camera(photos, model, params)
    if own is None:
        return [None] * len(photos)
    held = Counter(_turns(photo) for photo in photos if same_shape(own, (photo.width, photo.height)))
    usual = held.most_common(1)[0][0] if held else 0
    return [_camera(photo, own, usual) for photo in photos]


def _own_camera(photos: Sequence[Photo], model: str, params: Sequence[float]) -> Camera | None:
    """The camera with the size that the parameters belong to; None where several would do as badly."""
    upright = list(dict.fromkeys((photo.width, photo.height) for photo in photos))
    sizes = dict.fromkeys([*upright, *((height, width) for width, height in upright)])
    cameras = [Camera(model, *size, tuple(params)) for size in sizes]
    nearest = min(cameras, key=_off_centre)
    return nearest if len(upright) == 1 or _off_centre(nearest) <= MAX_OFF_CENTRE else None


def _off_centre(camera: Camera) -> float:
    _, centre = focal_lengths_and_centre(camera)
    return max(abs(at / side - 0.5) for at, side in zip(centre, (camera.width, camera.height), strict=True))


def _turns(photo: Photo) -> int:
    return QUARTER_TURNS.get(photo.orientation, 0)


def _camera(photo: Photo, own: Camera, usual_turns: int) -> Camera | None:
    size = (photo.width, photo.height)
    for turns in ((_turns(photo) - usual_turns) % 4, 0, 1 if photo.height > photo.width else 3):
        camera = turned_camera(own, turns)
        if same_shape(camera, size):
            return camera if (camera.width, camera.height) == size else rescaled(camera, *size)
    return None
