"""Pixels to rays and back, for every camera model that COLMAP knows."""

from functools import lru_cache

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

from nerf.geometry.scene import Camera
from stages.contract import StageError

ROUND_TRIP_PX = 0.01  # a ray direction that does not project back to its pixel is a false root of the distortion
FOLD_STEP = 1e-3  # of the way from the axis to a ray: in this last step pixels move outwards, unless a distortion folds
BISECTIONS = 50
ANGLE_MARGIN = 0.02  # of cosines: a surface goes on beside the photos that show it
CHECKED_PIXELS = (33, 25)  # across and down, the very corners among them: there lenses bend most
AXIS = np.array([0.0, 0.0, 1.0])  # the optical axis, in the camera's frame
_CLOCKWISE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # of a picture, by a quarter turn
# Parameters of COLMAP's lenses that are the two parts of a vector in the picture, and turn with it. Tangential terms
# are 2 (q·u) u + |u|² q of u = (X, Y) / Z (of the angle for a fisheye), and OPENCV calls q (p2, p1).
_VECTORS = (("p2", "p1"), ("p0", "p1"), ("sx1", "sy1"), ("s0", "s2"), ("s1", "s3"))


def camera_rays(camera: Camera, width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    """Unit ray directions (float32) of the pixel centres of ``camera``'s image resized to width × height.

    Raises StageError where the camera model has no inverse at some pixels.
    """
    model = native(camera)
    # Centres are mapped to the camera's own pixels: Camera.rescale would average the two scales of one focal length.
    x = (np.arange(width) + 0.5) * (camera.width / width)
    rays = np.empty((height, width, 3), np.float32)
    lost = 0
    for row in range(height):
        pixels = np.stack([x, np.full(width, (row + 0.5) * (camera.height / height))], axis=1)
        rays[row], missing = _ray_directions(model, pixels)
        lost += missing
    if lost:
        raise no_ray(camera, lost / (width * height))
    return rays


def border_rays(camera: Camera) -> Float[np.ndarray, "border 3"]:
    """Unit ray directions of pixel centres along the outline of a camera's image, CHECKED_PIXELS of them a side."""
    sides = zip((camera.width, camera.height), CHECKED_PIXELS, strict=True)
    x, y = (np.linspace(0.5, length - 0.5, count) for length, count in sides)
    across = [np.stack([x, np.full_like(x, end)], axis=1) for end in (y[0], y[-1])]
    down = [np.stack([np.full_like(y, end), y], axis=1) for end in (x[0], x[-1])]
    return _ray_directions(native(camera), np.concatenate(across + down))[0]


def corner_chord_squared(camera: Camera) -> float:
    """4 sin²(θ/2) of the largest angle θ between the optical axis and a pixel of a camera's image: the squared length
    of the difference of their unit vectors."""
    away = border_rays(camera) - AXIS
    return float((away**2).sum(axis=1).max())


def share_without_ray(model: pycolmap.Camera) -> float:
    """Of a camera's pixels, seen at CHECKED_PIXELS of them, the share for which the camera model has no inverse."""
    sides = zip((model.width, model.height), CHECKED_PIXELS, strict=True)
    x, y = (np.linspace(0.5, length - 0.5, count) for length, count in sides)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return _ray_directions(model, pixels)[1] / len(pixels)


def ray_directions(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Unit ray directions of pixels of the camera's own size; where it has no inverse, those of other pixels or NaN."""
    return _ray_directions(native(camera), pixels)[0]


def _ray_directions(model: pycolmap.Camera, pixels: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], int]:
    """Unit ray directions of pixels, and how many of these they are not those of."""
    ray_directions = _before_fold(model, pixels, np.array(model.cam_ray_from_img(pixels)))
    miss = np.abs(np.asarray(model.img_from_cam(ray_directions)) - pixels).max(axis=1)
    return ray_directions, int(np.count_nonzero(~(miss < ROUND_TRIP_PX)))  # NaN counts as lost


def _before_fold(
    model: pycolmap.Camera, pixels: Float[np.ndarray, "n 2"], rays: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """The unit rays of pixels. Where the distortion folds back between the optical axis and a ray, it makes way for the
    first one on the way there that projects to the pixel.

    COLMAP looks for a ray from where the pixel would be without distortion. A distortion that folds back a little
    beyond the corners gives pixels there two rays, and that start may be nearer to the false one.
    """
    outward = pixels - np.asarray(model.img_from_cam(AXIS[None]))

    def on_the_way(share: Float[np.ndarray, "k"], of: np.ndarray) -> Float[np.ndarray, "k 3"]:
        return AXIS + share[:, None] * (rays[of] - AXIS)

    def is_beyond(share: Float[np.ndarray, "k"], of: np.ndarray) -> Bool[np.ndarray, "k"]:
        """Whether what lies at this share of the way from the axis to a ray projects farther out than its pixel."""
        projected = np.asarray(model.img_from_cam(on_the_way(share, of)))
        return ((projected - pixels[of]) * outward[of]).sum(axis=1) > 0

    ahead = np.flatnonzero(rays[:, 2] > 0)
    folded = ahead[is_beyond(np.full(len(ahead), 1 - FOLD_STEP), ahead)]
    near, far = np.zeros(len(folded)), np.ones(len(folded))
    for _ in range(BISECTIONS if len(folded) else 0):
        middle = (near + far) / 2
        beyond = is_beyond(middle, folded)
        near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
    first = on_the_way(far, folded)
    rays[folded] = first / np.linalg.norm(first, axis=1, keepdims=True)
    return rays


def no_ray(camera: Camera, share: float, of: str = "") -> StageError:
    """The error for a camera, given as that ``of`` this photo or of unknown origin, without a ray for this share of its
    pixels."""
    crop = "crop photos and cameras to the square inside the lens's circle"
    simpler = "give the photos without cameras" if of else "choose a simpler --sfm.camera-model"
    other = crop if is_fisheye(camera.model) else simpler
    return StageError(
        "sfm.no-ray",
        f"the {camera.model} camera{f' of {of!r}' * bool(of)} has no ray for {100 * share:.3g}% of its pixels",
        f"{why_no_ray(camera.model)} there (parameters {', '.join(f'{p:.5g}' for p in camera.params)})",
        f"Check the distortion of the imported cameras, or {other}.",
    )


def why_no_ray(model: str) -> str:
    """What may be the matter where a camera of this model has no ray: COLMAP's fisheyes end at 90° from the axis, and
    the ray directions that they give further out are of other pixels."""
    return f"{'it looks beyond 90° from its axis or ' if is_fisheye(model) else ''}its distortion has no inverse"


def is_fisheye(model: str) -> bool:
    """Whether a camera model is one of angles, which may be made for very wide lenses."""
    return model.endswith("FISHEYE")


def project(camera: Camera, points_camera: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Pixel coordinates of points in the camera's frame; NaN for points behind the camera and at wider angles to its
    axis than its corners and ANGLE_MARGIN, where distortions fold back into the image."""
    points = np.asarray(points_camera, np.float64)
    within = points[:, 2] >= (_min_cosine(camera) - ANGLE_MARGIN) * np.linalg.norm(points, axis=1)
    return np.where(within[:, None], np.asarray(native(camera).img_from_cam(points)), np.nan)


@lru_cache
def _min_cosine(camera: Camera) -> float:
    """Between the optical axis and any pixel's ray, where the camera model has one."""
    return float(np.fmin.reduce(border_rays(camera)[:, 2], initial=1.0))


def rescaled(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same image resized to width × height pixels."""
    model = native(camera)
    model.rescale(width, height)
    return plain(model)


def turned_camera(camera: Camera, turns: int) -> Camera:
    """The camera of the picture after so many quarter turns clockwise.

    One takes pixel (x, y) of a picture of height h to (h − y, x), and a camera's axes with it: X' = −Y, Y' = X.
    """
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


def pixel_map(size: tuple[int, int], turns: int, width: int, height: int) -> Float[np.ndarray, "2 3"]:
    """Takes pixels (x, y, 1) of a picture of this width and height to those after so many quarter turns clockwise and
    resized to width × height."""
    pixels = np.eye(3)
    for _ in range(turns):
        turn = _CLOCKWISE.copy()
        turn[0, 2] = size[1]
        pixels, size = turn @ pixels, (size[1], size[0])
    return np.diag([width / size[0], height / size[1]]) @ pixels[:2]


def is_valid(camera: Camera) -> bool:
    """Whether all parameters are finite and all focal lengths positive."""
    focal, _ = focal_lengths_and_centre(camera)
    return bool(np.isfinite(camera.params).all()) and all(f > 0 for f in focal)


def focal_lengths_and_centre(camera: Camera) -> tuple[list[float], list[float]]:
    """The parameters that are focal lengths, one or two, and the principal point's; a panorama has neither."""
    model = native(camera)
    focal, centre = model.focal_length_idxs(), model.principal_point_idxs()
    return [camera.params[i] for i in focal], [camera.params[i] for i in centre]


def mean_focal_and_centre(camera: Camera) -> tuple[float, tuple[float, float]]:
    """The mean focal length and the principal point, in pixels."""
    model = native(camera)
    return float(model.mean_focal_length()), (float(model.principal_point_x), float(model.principal_point_y))


def native(camera: Camera, camera_id: int = 1) -> pycolmap.Camera:
    """The same camera for COLMAP. Raises ValueError where the model takes another number of parameters."""
    model = pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )
    if not model.verify_params():
        raise ValueError(f"{camera.model} takes {model.params_info}, got {len(camera.params)} numbers")
    return model


def plain(camera: pycolmap.Camera) -> Camera:
    """The inverse of :func:`native`."""
    return Camera(camera.model_name, camera.width, camera.height, tuple(float(p) for p in camera.params))
