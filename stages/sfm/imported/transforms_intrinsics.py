"""Cameras of transforms files: nerfstudio's, instant-ngp's and Blender's names for intrinsics as COLMAP's models."""

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nerf.geometry.scene import Camera
from stages.contract import listed
from stages.io.colmap_files import MAX_SIDE
from stages.sfm.colmap.cameras import focal_lengths_and_centre

# Focal lengths in widths of the picture: from 179° across to 20 seconds of arc, a telescope's.
FOCAL_RATIOS = (0.005, 10_000.0)
MIN_FOCAL_PX = 10.0  # less is a length in widths, or in millimetres
MAX_CENTRE_OFFSET = 100.0  # in widths: where the principal point of the last corner cut out of a large picture may lie
MAX_LETTERS = 40  # of a value, in an error
FISHEYE, PRISM, RATIONAL, PANORAMA = "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "FULL_OPENCV", "EQUIRECTANGULAR"
PERSPECTIVES = ("", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", RATIONAL)
FISHEYES = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", FISHEYE, PRISM)
OTHER_CAMERA_MODELS = ("ftheta_p0", "latlong", "equirectangular")  # keys that declare them to instant-ngp
NERFSTUDIOS = ("k1", "k2", "k3", "k4", "p1", "p2")  # distortion_params, in nerfstudio's order
NO_PANORAMAS = "panoramas are not supported"
# Keys that tell one thing together: a frame that has one of a group has the group, and the file's count no more.
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
CENTRE = ("cx", "cy")
TERM_LISTS = ("distortion", "dist", "dist_coeffs", "distortion_coeffs", "distortion_coefficients", "D")
DISTORTION = (*TERM_LISTS, "distortion_params", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1")
CAMERA_MODEL = ("camera_model", "is_fisheye", *OTHER_CAMERA_MODELS)
SIZE = ("w", "h")
OF_INTRINSICS = {*FOCAL, *CENTRE, *DISTORTION, *CAMERA_MODEL, *SIZE}
IN_PIXELS = {"fl_x": "w", "fl_y": "h", "cx": "w", "cy": "h"}  # of a picture of that side
# How other programs spell these keys, in small letters without underscores: Fx, f_x, focal_length_x, image_width.
SPELLINGS = {key.replace("_", ""): key for key in OF_INTRINSICS - {*TERM_LISTS}} | {
    **{f"{name}{axis}": f"fl_{axis}" for name in ("f", "focal", "focallength") for axis in "xy"},
    **{f"{name}{axis}": f"c{axis}" for name in ("pp", "principal", "principalpoint") for axis in "xy"},
    **{f"{name}{side}": side[0] for name in ("", "image", "img", "camera") for side in ("width", "height")},
}
# Keys under which other programs say what camera_model says, and what they call camera models.
MODEL_KEYS = ("camera_type", "projection_type", "distortion_model")
MODEL_NAMES = {
    **dict.fromkeys(("PERSPECTIVE", "PLUMB_BOB", "RADTAN", "BROWN"), "OPENCV"),
    "EQUIDISTANT": FISHEYE,
    "RATIONAL_POLYNOMIAL": RATIONAL,
    **dict.fromkeys(("PANORAMIC", "SPHERICAL"), PANORAMA),
}
# Keys that say what is not read: terms in an order that nobody defines; what no camera model of COLMAP has; and how
# large the pictures are, in which order nobody knows.
UNREAD_TERMS = ("k", "p", "radial_distortion", "tangential_distortion", "radial", "tangential")
UNREAD_PIXELS = ("skew", "b1", "b2")
UNREAD_SHIFT = ("shift_x", "shift_y")
UNREAD_SIZES = ("resolution", "image_size", "imageSize", "img_size")
# The principal point lies at such a part of the way to the far corner as in pictures of another size.
OTHER_SIZE_FROM, ON_DIAGONAL_WITHIN = 1.4, 0.1
# Where they keep these keys: in a block of their own, or as a matrix.
BLOCKS = ("camera", "intrinsics", "camera_intrinsics", "distortion", "intrinsic_matrix", "camera_matrix", "K")
SAME_WITHIN = 0.01  # two focal lengths, relatively: files are rounded
MAX_SKEW = 1e-3  # of a focal length: what rounding leaves
MAX_KEYS = 5  # in an error
NOT_OF_CAMERAS = {"file_path", "transform_matrix", "frames", "photo", "mask_path"}


def intrinsics_of(frame: Mapping[str, Any], file: Mapping[str, Any]) -> dict[str, Any]:
    """The values that hold for one frame of a transforms file: its own, and the file's of each group of intrinsics that
    the frame does not have. A value that is null counts as absent.

    A frame's ``camera_angle_x`` so overrules the ``fl_x`` of its file. Distortion belongs to a camera model: where the
    frame declares another one than the file, the file's terms are not the frame's. Pixels are those of the file's ``w``
    and ``h``: a frame of another size and the same shape has them rescaled. Raises ValueError as
    :func:`with_usual_names` does.
    """
    own = with_usual_names(frame)
    return _rescaled(shared_intrinsics(frame, file), own) | own


def shared_intrinsics(frame: Mapping[str, Any], file: Mapping[str, Any]) -> dict[str, Any]:
    """The file's values of each group of intrinsics that the frame does not have. Raises ValueError as
    :func:`with_usual_names` does."""
    own, shared = with_usual_names(frame), with_usual_names(file)
    other_model = any(key in own and own[key] != shared.get(key, False) for key in CAMERA_MODEL)
    for group in (FOCAL, CENTRE, DISTORTION, CAMERA_MODEL):
        if not own.keys().isdisjoint(group) or (group is DISTORTION and other_model):
            shared = {key: value for key, value in shared.items() if key not in group}
    return shared


def is_one_angle(shared: Mapping[str, Any]) -> bool:
    """Whether these values tell the focal length by the angle across alone, which is as wide as the picture is."""
    given = shared.keys() & {*FOCAL}
    return bool(given) and given <= {"camera_angle_x", "x_fov"}


def _rescaled(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """What a file says in pixels, for a frame that has a size of its own."""
    try:
        scales = {side: float(own.get(side, shared[side])) / float(shared[side]) for side in SIZE}
        pixels = {key: float(shared[key]) * scales[side] for key, side in IN_PIXELS.items() if key in shared}
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # no size, or none that is one
        return dict(shared)
    is_same_shape = abs(scales["w"] - scales["h"]) <= SAME_WITHIN * abs(scales["h"])
    if not is_same_shape and not shared.keys().isdisjoint(CENTRE) and _is_turned(scales, shared):
        sizes = ("{}×{}".format(*(values[side] for side in SIZE)) for values in ({**shared, **own}, shared))
        raise ValueError(
            "its w and h are {}, and cx and cy of the file are of {}: write its own cx and cy".format(*sizes)
        )
    return {**shared, **pixels} if is_same_shape and scales["w"] != 1 else dict(shared)


def _is_turned(scales: Mapping[str, float], shared: Mapping[str, Any]) -> bool:
    """Whether a frame whose sides are so much larger than the file's is of its shape, but upright where that lies."""
    ratio = float(shared["h"]) / float(shared["w"])
    return abs(scales["w"] - scales["h"] * ratio**2) <= SAME_WITHIN * abs(scales["w"])


def with_usual_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """What a frame or a file holds but for nulls, with intrinsics under the names that nerfstudio and instant-ngp use.
    Raises ValueError for a matrix that is none of intrinsics."""
    blocks = [_of_block(name, values[name]) for name in BLOCKS if values.get(name) is not None]
    found: dict[str, Any] = {}
    for level in (*blocks, values):
        spelt = {name: value for key, value in level.items() if value is not None and (name := _usual_name(key))}
        found |= spelt | {key: value for key, value in level.items() if value is not None}
    if known := _known_model(found):
        found["camera_model"] = known
    return found


def _usual_name(key: str) -> str | None:
    return None if key in OF_INTRINSICS or key in BLOCKS else SPELLINGS.get(key.lower().replace("_", ""))


def _known_model(values: Mapping[str, Any]) -> str | None:
    """The name here of the camera model that the values declare, under whatever key; None where they declare none, or
    one that is not known."""
    for key in ("camera_model", *MODEL_KEYS):
        if isinstance(name := values.get(key), str):
            name = MODEL_NAMES.get(name.upper(), name.upper())
            return name if name in (*PERSPECTIVES[1:], *FISHEYES, PANORAMA) else None
    return None


def _of_block(name: str, block: Any) -> dict[str, Any]:
    """The intrinsics that a block of a file holds, or a matrix of them, row by row or column by column."""
    if isinstance(block, Mapping):
        known = {*OF_INTRINSICS, *MODEL_KEYS, *UNREAD_TERMS, *UNREAD_PIXELS, *UNREAD_SHIFT, *UNREAD_SIZES}
        return {key: value for key, value in block.items() if key in known or _usual_name(key)}
    if not isinstance(block, list) or name in TERM_LISTS:
        return {}
    numbers = [number for row in block for number in (row if isinstance(row, list) else [row])]
    values = np.array([_finite(number, name) for number in numbers])
    if len(values) == 4:
        fx, fy, cx, cy = values
        return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    if len(values) not in (9, 12, 16):
        raise ValueError(f"its {name} has {len(values)} numbers instead of the 3 × 3 of a camera matrix")
    matrix = values.reshape(len(values) // (3 if len(values) == 9 else 4), -1)[:3, :3]
    matrix = matrix.T if matrix[2, :2].any() else matrix
    if matrix[2].tolist() != [0, 0, 1] or matrix[1, 0] or abs(matrix[0, 1]) > MAX_SKEW * abs(matrix[0, 0]):
        rows = "; ".join(" ".join(f"{value:.4g}" for value in row) for row in matrix)
        raise ValueError(f"its {name} is no camera matrix (fx 0 cx; 0 fy cy; 0 0 1): {rows}")
    return {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}


def contradictions(values: Mapping[str, Any], width: int, height: int) -> list[str]:
    """What a frame or a file says twice and not alike, and which is taken. Values that are no numbers are not compared:
    :func:`read_intrinsics` refuses those that it reads."""
    found = []
    values = with_usual_names(values)
    for axis, size in (("x", values.get("w") or width), ("y", values.get("h") or height)):
        try:
            focal = _focal_lengths(values, axis, float(size))
        except (TypeError, ValueError):
            continue
        (taken, pixels), *others = focal.items() or [("", 0.0)]
        for name, other in others:
            if abs(other - pixels) > SAME_WITHIN * abs(pixels):
                found.append(f"{taken} is {pixels:.5g} pixels but {name} gives {other:.5g}; {taken} is used")
        if taken == (name := f"{axis}_fov") and (angle := float(values[name])) < math.pi:
            found.append(
                f"{name} is {angle:.4g} and is read in degrees; a value in radians belongs in camera_angle_{axis}"
            )
    try:
        centre, sides = (tuple(float(values[key]) for key in keys) for keys in (CENTRE, SIZE))
        found += [
            f"{other}; this is right only if they were cropped" for other in [_of_other_size(centre, sides)] if other
        ]
    except (KeyError, TypeError, ValueError):
        pass
    terms = values.get("distortion_params")
    if isinstance(terms, list) and len(terms) == len(NERFSTUDIOS):
        other = [name for name, term in zip(NERFSTUDIOS, terms, strict=True) if values.get(name, term) != term]
        found += [f"{', '.join(other)} and distortion_params differ; distortion_params is used"] * bool(other)
    if values.get("is_fisheye") and values.get("camera_model", FISHEYE) not in (*FISHEYES, "", None):
        found.append(f"camera_model is {values['camera_model']} but is_fisheye is true; a fisheye is used")
    return found


def read_intrinsics(values: Mapping[str, Any], width: int, height: int, focal: float = 0.0) -> Camera:
    """The camera of a frame from ``w``, ``h``, ``fl_x``, ``fl_y`` or ``camera_angle_x``, ``camera_angle_y`` (radians)
    or ``x_fov``, ``y_fov`` (degrees), ``cx``, ``cy``, ``k1`` …, ``p1``, ``p2``, ``sx1``, ``sy1`` or
    ``distortion_params``, and ``camera_model``; a focal length across one side serves for both. ``width``, ``height``
    (pixels) and ``focal`` (in longer sides of the picture; 0 for unknown) stand where the file has none.

    Raises ValueError, saying what is wrong, for numbers that are not finite, for what no camera or crop could have, and
    for camera models that are not known here.
    """
    declared = _declared(values)
    values = _with_named_terms(values)

    def number(key: str, default: float) -> float:
        return _finite(values.get(key, default), key)

    w, h = number("w", width), number("h", height)
    if not all(1 <= side <= MAX_SIDE and side.is_integer() for side in (w, h)):
        raise ValueError(f"its w and h are {w:g} and {h:g}, which no image has")
    along = _focal_length(values, "x", w), _focal_length(values, "y", h)
    given = [one for one in along if one is not None] or [focal * max(w, h)] * (focal > 0)
    if not given:
        raise ValueError(_why_no_focal_length(values))
    fx, fy = (given[0] if one is None else one for one in along)
    pinhole = (fx, fy, number("cx", w / 2), number("cy", h / 2))
    if not {*SIZE} <= values.keys() and (other := _of_other_size(pinhole[2:], (w, h))):
        raise ValueError(f"{other}; write the w and h that they are of")
    k = [number(f"k{i}", 0.0) for i in range(1, 7)]
    p, s = [number("p1", 0.0), number("p2", 0.0)], [number("sx1", 0.0), number("sy1", 0.0)]
    model, distortion = _distortion(k, p, s, declared)
    camera = Camera(model, int(w), int(h), (*pinhole, *distortion))
    if why_degenerate := why_unusable(camera):
        raise ValueError(why_degenerate)
    return camera


def _of_other_size(centre: Sequence[float], size: Sequence[float]) -> str | None:
    """Words for a principal point that lies where it would in pictures of the same shape and another size."""
    if not min(size) > 0:
        return None
    across, down = (2 * at / side for at, side in zip(centre, size, strict=True))
    is_on_diagonal = across > 0 and abs(down / across - 1) <= ON_DIAGONAL_WITHIN
    if not is_on_diagonal or 1 / OTHER_SIZE_FROM < across < OTHER_SIZE_FROM:
        return None
    at = ", ".join(f"{value:.5g}" for value in centre)
    photo, other = ("×".join(f"{side:.5g}" for side in sides) for sides in (size, [2 * value for value in centre]))
    return f"its principal point ({at}) is far from the middle of {photo} pixels, as in pictures of about {other}"


def _why_no_focal_length(values: Mapping[str, Any]) -> str:
    wide = [(key, values[key]) for key in FOCAL if key in values]
    if wide:
        key, angle = wide[0]
        most = (
            "radians, between 0 and π (degrees belong in x_fov)" if key.startswith("camera") else "degrees, below 180"
        )
        return f"its {key} is {repr(angle)[:MAX_LETTERS]}; it must be in {most}"
    others = sorted(values.keys() - OF_INTRINSICS - NOT_OF_CAMERAS)
    there = f"; it has {listed(others, MAX_KEYS)}" if others else ""
    return f"it has no focal length: no fl_x (pixels), camera_angle_x (radians) or x_fov (degrees){there}"


def why_unusable(camera: Camera) -> str | None:
    """What is wrong with intrinsics that no camera and no crop could have."""
    if camera.model == PANORAMA:
        return NO_PANORAMAS
    if not np.isfinite(camera.params).all():
        return f"its parameters are not finite: {', '.join(f'{value:.5g}' for value in camera.params)}"
    focal, centre = focal_lengths_and_centre(camera)
    longer = max(camera.width, camera.height)
    if not all(FOCAL_RATIOS[0] <= value / longer <= FOCAL_RATIOS[1] for value in focal):
        pixels = " × ".join(f"{value:.5g}" for value in focal)
        why = f"a focal length of {pixels} pixels is impossible for a photo of {camera.width}×{camera.height}"
        return f"{why}; it may be in image widths or in millimetres" if 0 < max(focal) < MIN_FOCAL_PX else why
    if centre and all(0 < value <= 1 < longer / MIN_FOCAL_PX for value in centre):
        at = ", ".join(f"{value:.5g}" for value in centre)
        return (
            f"its principal point ({at}) is in a corner of the photo; it may be in image widths, and belongs in pixels"
        )
    if max(map(abs, centre), default=0.0) > MAX_CENTRE_OFFSET * longer:
        at = ", ".join(f"{value:.5g}" for value in centre)
        return f"its principal point ({at}) is far outside its {camera.width}×{camera.height} pixels"
    return None


def _with_named_terms(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """``values`` with ``distortion_params`` under the names of its terms. Raises ValueError for distortion in a list
    of another order, which nobody defines."""
    for name in TERM_LISTS:
        terms = values.get(name)
        if terms is not None and not isinstance(terms, Mapping) and np.array(terms, dtype=object).any():
            raise ValueError(
                f"it has distortion as {name}, a list of no defined order; write k1, k2, p1, p2, k3 instead"
            )
    if unread := _unread(values):
        raise ValueError(unread)
    if "distortion_params" not in values:
        return values
    terms = values["distortion_params"]
    if not (isinstance(terms, list) and len(terms) == len(NERFSTUDIOS)):
        raise ValueError(
            f"its distortion_params are not the six numbers {', '.join(NERFSTUDIOS)}, in nerfstudio's order"
        )
    return {**values, **dict(zip(NERFSTUDIOS, terms, strict=True))}


def _unread(values: Mapping[str, Any]) -> str | None:
    """Words for a key that says something of the camera and is not read here; None where there is none, and where it
    says nothing, as 0 does."""
    for name in UNREAD_TERMS:
        if isinstance(terms := values.get(name), list) and np.array(terms, dtype=object).any():
            return f"it has {name}, which is not read; write k1, k2, p1, p2, k3 instead"
    for name in UNREAD_PIXELS:
        if abs(_finite(values.get(name) or 0, name)) > MAX_SKEW * abs(_finite(values.get("fl_x") or 1000, "fl_x")):
            return f"its {name} is {values[name]}, which no supported camera model has; undistort the photos with it"
    if values.keys().isdisjoint(CENTRE):
        for name in UNREAD_SHIFT:
            if _finite(values.get(name) or 0, name):
                return f"its {name} is {values[name]}, which is not read; write cx and cy in pixels"
    for name in UNREAD_SIZES:
        if isinstance(values.get(name), list) and values.keys().isdisjoint(SIZE):
            return f"its {name} is {repr(values[name])[:MAX_LETTERS]}, which is not read; write w and h instead"
    return None


def _declared(values: Mapping[str, Any]) -> str:
    """The camera model that the values declare, "" without; one of PERSPECTIVES or FISHEYES."""
    declared = values.get("camera_model") or ""
    if declared == PANORAMA:
        raise ValueError(NO_PANORAMAS)
    if declared not in PERSPECTIVES + FISHEYES:
        known = ", ".join((*PERSPECTIVES[1:], *FISHEYES))
        raise ValueError(f"its camera_model is {repr(declared)[:MAX_LETTERS]}, which is none of {known}")
    if other := next((key for key in OTHER_CAMERA_MODELS if values.get(key, False) is not False), None):
        raise ValueError(f"it has {other}, whose camera model is not supported")
    return FISHEYE if values.get("is_fisheye") and declared not in FISHEYES else declared


def _distortion(k: list[float], p: list[float], s: list[float], declared: str) -> tuple[str, list[float]]:
    """COLMAP's model for these terms and its parameters after fx, fy, cx, cy."""
    if declared in FISHEYES:
        if any(k[4:]):
            raise ValueError("it is a fisheye with k5 or k6, which is not supported")
        return (PRISM, [k[0], k[1], *p, k[2], k[3], *s]) if any(p) or any(s) else (FISHEYE, k[:4])
    if any(s):
        raise ValueError(f"it has sx1 or sy1, but its camera_model is not {PRISM}")
    if any(k[3:]) and declared != RATIONAL:
        # In such files k4 multiplies r⁸, which no model of COLMAP has; FULL_OPENCV's k4 is a denominator's r².
        raise ValueError("it has k4, but its camera_model is not FULL_OPENCV")
    if any(k[2:]):
        return RATIONAL, [k[0], k[1], *p, *k[2:]]
    if any(k) or any(p):
        return "OPENCV", [k[0], k[1], *p]
    return "PINHOLE", []


def _focal_length(values: Mapping[str, Any], axis: str, size: float) -> float | None:
    """Focal length in pixels along "x" or "y", where the picture has ``size`` pixels; None without one. Of a full
    viewing angle that is in radians or, as instant-ngp's ``x_fov``, in degrees."""
    return next(iter(_focal_lengths(values, axis, size).values()), None)


def _focal_lengths(values: Mapping[str, Any], axis: str, size: float) -> dict[str, float]:
    """By the key that says so, the one that counts first."""
    found = {}
    if values.get(name := f"fl_{axis}") is not None:
        found[name] = _finite(values[name], name)
    for name, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.radians(1))):
        if values.get(name) is not None and 0 < (angle := _finite(values[name], name) * unit) < math.pi:
            found[name] = 0.5 * size / math.tan(0.5 * angle)
    return found


def _finite(value: Any, name: str) -> float:
    """A number, or one as text: nerfstudio's converter for RealityCapture writes distortion so."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) <= sys.float_info.max:
        raise ValueError(f"its {name} is {repr(value)[:MAX_LETTERS]}, not a finite number")
    return float(number)
