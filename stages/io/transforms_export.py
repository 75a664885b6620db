"""transforms.json for nerfstudio and instant-ngp: OpenGL camera axes, sfm frame, one frame per photo."""

from typing import Any

import numpy as np

from nerf.geometry.scene import Camera, Scene

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])  # x right, y up, z backward; its own inverse
# As k1 of a fisheye without terms: instant-ngp takes one for a pinhole where all of them are 0. No pixel moves by it.
TINY_TERM = 1e-12

# The parameters of COLMAP's camera models under the format's names, and the format's model that reads them.
_MODELS = {
    "SIMPLE_PINHOLE": ("OPENCV", "f cx cy"),
    "PINHOLE": ("OPENCV", "fl_x fl_y cx cy"),
    "SIMPLE_RADIAL": ("OPENCV", "f cx cy k1"),
    "RADIAL": ("OPENCV", "f cx cy k1 k2"),
    "OPENCV": ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("FULL_OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", "f cx cy"),
    "FISHEYE": ("OPENCV_FISHEYE", "fl_x fl_y cx cy"),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", "f cx cy k1"),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
}
# Models that the format cannot express: their leading parameters, the rest is left out and said.
_NEAREST = {
    "FOV": ("OPENCV", "fl_x fl_y cx cy"),
    "SIMPLE_DIVISION": ("OPENCV", "f cx cy"),
    "DIVISION": ("OPENCV", "fl_x fl_y cx cy"),
    "EUCM": ("OPENCV", "fl_x fl_y cx cy"),
    "THIN_PRISM_FISHEYE": ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
}


def transforms(scene: Scene) -> dict[str, Any]:
    """The content of transforms.json. Intrinsics stand once if all photos share them, else in every frame; a model that
    all have stands at the top, too: nerfstudio reads ``camera_model`` nowhere else.

    ``file_path`` is the decoded photo, ``photo`` its own name, ``mask_path`` its mask, if every photo has one, as
    nerfstudio wants it. ``scale`` and ``offset`` place the region of interest in instant-ngp's unit cube. A camera
    model that the format lacks is written as the nearest one, with a ``note``.
    Raises ValueError for a model without any counterpart.
    """
    cameras = [intrinsics(camera) for camera in scene.cameras]
    used = {view.camera for view in scene.views}
    models = {cameras[camera]["camera_model"] for camera in used}
    shared = len(used) == 1
    masks = [view.mask or view.alpha for view in scene.views]
    sfm_from_scene = scene.scene_from_sfm.inverse()
    frames = []
    for view, mask in zip(scene.views, masks, strict=True):
        own = {} if shared else dict(cameras[view.camera])
        pose = opengl_matrix(sfm_from_scene.pose(view.scene_from_camera))
        own |= {"mask_path": mask} if all(masks) else {}
        frames.append(own | {"file_path": view.file, "photo": view.name, "transform_matrix": pose})
    scale = scene.scene_from_sfm.scale / 2  # of instant-ngp: [-1, 1] to [0, 1]
    common = {"camera_model": models.pop()} if len(models) == 1 else {}
    return (cameras[scene.views[0].camera] if shared else common) | {
        "frames": frames,
        "scale": scale,
        "offset": (0.5 - scale * sfm_from_scene.points(np.zeros(3))).tolist(),
        "aabb_scale": 1 if scene.bounded else 16,
        "train_filenames": [view.file for view in scene.of_split("train")],
        "test_filenames": [view.file for view in scene.of_split("test")],
        "val_filenames": [view.file for view in scene.of_split("test")],
    }


def opengl_matrix(from_camera: np.ndarray) -> list[list[float]]:
    """A pose (3, 4) with OpenCV axes as the format's 4 x 4 matrix with OpenGL axes."""
    matrix = np.eye(4)
    matrix[:3] = from_camera
    matrix[:3, :3] = from_camera[:, :3] @ OPENGL_FROM_OPENCV
    return matrix.tolist()


def intrinsics(camera: Camera) -> dict[str, Any]:
    """One camera under the format's names. Raises ValueError for a model without any counterpart."""
    if camera.model not in _MODELS | _NEAREST:
        raise ValueError(f"camera model {camera.model} has no counterpart in transforms.json")
    model, names = (_MODELS | _NEAREST)[camera.model]
    if camera.model == "FULL_OPENCV" and not any(camera.params[9:]):
        model = "OPENCV"  # with a k3, which nerfstudio reads, too
    values: dict[str, Any] = dict(zip(names.split(), camera.params, strict=camera.model in _MODELS))
    if (focal := values.pop("f", None)) is not None:
        values |= {"fl_x": focal, "fl_y": focal}
    if camera.model in _NEAREST:
        values["note"] = f"approximation: {camera.model} with parameters {list(camera.params)} has no counterpart here"
    fisheye = {"is_fisheye": True} if model == "OPENCV_FISHEYE" else {}  # instant-ngp reads no camera_model
    if fisheye and not any(values.get(f"k{i}") for i in range(1, 5)):
        values["k1"] = TINY_TERM
    return {"camera_model": model, **fisheye, "w": camera.width, "h": camera.height} | values
