"""Cameras of photos as their files store them, turned upright with the photos, as EXIF's orientation asks.

Other programs take pixels as they are stored, ingest turns them upright (stages/ingest/orientation.py). One quarter
turn clockwise takes pixel (x, y) of a picture of height h to (h − y, x), and a camera's axes with it: X' = −Y, Y' = X.
"""

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Camera
from stages.ingest.orientation import turned_size
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import native

QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}  # clockwise, by EXIF's orientation; the others mirror
ASPECT_WITHIN = 0.01
_CLOCKWISE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Parameters of COLMAP's lenses that are the two parts of a vector in the picture, and turn with it. Tangential terms
# are 2 (q·u) u + |u|² q of u = (X, Y) / Z (of the angle for a fisheye), and OPENCV calls q (p2, p1).
_VECTORS = (("p2", "p1"), ("p0", "p1"), ("sx1", "sy1"), ("s0", "s2"), ("s1", "s3"))


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


def is_of_stored_pixels(camera: Camera, photo: Photo, upright: bool) -> bool:
    """Whether an imported camera is one of the photo as its file stores it, turned or mirrored. The shape tells; where
    both would do (a half turn, a square), it is, unless it is known to be ``upright``."""
    if photo.orientation == 1 or not same_shape(camera, stored_size(photo)):
        return False
    return not (upright and same_shape(camera, (photo.width, photo.height)))


def turned_camera(camera: Camera, turns: int) -> Camera:
    """The camera of the picture after so many quarter turns clockwise."""
    names = native(camera).params_info.split(", ")
    for _ in range(turns):
        old = dict(zip(names, camera.params, strict=True))
        new = old | {"cx": camera.height - old["cy"], "cy": old["cx"]}
        if "fx" in old:
            new |= {"fx": old["fy"], "fy": old["fx"]}
        for across, down in _VECTORS:
            if across in old and down in old:
                new |= {across: -old[down], down: old[across]}
        camera = Camera(camera.model, camera.height, camera.width, tuple(new[name] for name in names))
    return camera


def turned_pose(world_from_camera: Float[np.ndarray, "3 4"], turns: int) -> Float[np.ndarray, "3 4"]:
    """The pose of a camera after so many quarter turns clockwise of its picture."""
    rotation = world_from_camera[:, :3] @ np.linalg.matrix_power(_CLOCKWISE, turns).T
    return np.concatenate([rotation, world_from_camera[:, 3:]], axis=1)


def pixel_map(camera: Camera, turns: int, width: int, height: int) -> Float[np.ndarray, "2 3"]:
    """Takes pixels (x, y, 1) of the camera to those of its picture after so many quarter turns clockwise and resized to
    width × height."""
    pixels, size = np.eye(3), (camera.width, camera.height)
    for _ in range(turns):
        turn = _CLOCKWISE.copy()
        turn[0, 2] = size[1]
        pixels, size = turn @ pixels, size[::-1]
    return np.diag([width / size[0], height / size[1]]) @ pixels[:2]
