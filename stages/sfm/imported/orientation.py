"""Which imported cameras are of photos as their files store them.

Other programs take pixels as they are stored, ingest turns them upright (stages/ingest/orientation.py).
"""

from nerf.geometry.scene import Camera
from stages.ingest.orientation import turned_size
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import focal_lengths_and_centre

ASPECT_WITHIN = 0.01


def stored_size(photo: Photo) -> tuple[int, int]:
    """Width and height of the photo in its file, before it was turned upright."""
    return turned_size((photo.width, photo.height), photo.orientation)


def same_shape(camera: Camera, size: tuple[int, int]) -> bool:
    """Whether a picture of this width and height can be the camera's, made larger or smaller, of whole pixels."""
    wanted = size[0] * camera.height / camera.width
    return abs(wanted - size[1]) <= max(1.0, ASPECT_WITHIN * size[1])


def fits_only_upright(camera: Camera, photo: Photo) -> bool:
    """Whether the photo has the camera's shape once it is upright, and not as its file stores it."""
    return same_shape(camera, (photo.width, photo.height)) and not same_shape(camera, stored_size(photo))


def is_centred_upright(camera: Camera, photo: Photo) -> bool:
    """Whether the principal point is nearer the middle of the upright photo than of what its file stores: lenses are
    centred to a percent or two."""
    _, centre = focal_lengths_and_centre(camera)
    if not centre:  # a panorama
        return False
    off = [
        max(abs(at / side - 0.5) for at, side in zip(centre, size, strict=True))
        for size in ((photo.width, photo.height), stored_size(photo))
    ]
    return off[0] < off[1]


def is_of_stored_pixels(camera: Camera, photo: Photo, upright: bool) -> bool:
    """Whether an imported camera is one of the photo as its file stores it, turned or mirrored. The shape tells; where
    both would do (a half turn, a square), it is, unless it is known to be ``upright``."""
    if photo.orientation == 1 or not same_shape(camera, stored_size(photo)):
        return False
    return not (upright and same_shape(camera, (photo.width, photo.height)))
