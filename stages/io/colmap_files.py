"""The files of a COLMAP model, binary or text, read without COLMAP.

COLMAP's own reader believes what it reads: a count that was damaged makes it allocate until the machine is full, loop
without end, or abort the process. https://colmap.github.io/format.html. Only cameras, images and points3D are read:
what rigs and frames say of poses is in images, too, and tracks are what images say of their points.
"""

import codecs
import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from nerf.geometry.scene import Camera
from stages.io.files import part_file, stand_in

# By COLMAP's number: the name and how many parameters it has.
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
PARAMETERS = dict(CAMERA_MODELS.values())
MAX_SIDE = 2**31 - 1
MAX_COORDINATE = 1e30  # of anything, in its units: squares and products of three such numbers are numbers, too
NO_POINT = -1
LINE_END = re.compile(r"\r\n|\r|\n")  # a lone \r is of old Macs; str.splitlines ends lines elsewhere, too
UNKNOWN_ERROR = "0"  # of a point in text that ends with its colour

Entry = TypeVar("Entry")


class FileImage(NamedTuple):
    """An image as it is in the file: ``pose`` is (qw, qx, qy, qz, tx, ty, tz) of camera_from_world, ``points`` the id
    of each of its keypoints' point, NO_POINT where it has none."""

    name: str
    camera: int
    pose: Float[np.ndarray, "7"]
    xy: Float[np.ndarray, "k 2"]
    points: Int[np.ndarray, "k"]


class FilePoint(NamedTuple):
    """A point as it is in the file."""

    xyz: tuple[float, ...]
    rgb: tuple[int, ...]
    error_px: float


class ModelFiles(NamedTuple):
    """What the files hold, by id."""

    cameras: dict[int, Camera]
    images: dict[int, FileImage]
    points: dict[int, FilePoint]


def read_model_files(folder: Path) -> ModelFiles:
    """The model in ``folder``, checked to be one: places somewhere, every id there once, every image with a camera and
    points that exist. Raises OSError, and ValueError or OverflowError with the reason."""
    binary = _is_binary(folder)
    readers = (
        {"cameras": _binary_cameras, "images": _binary_images, "points3D": _binary_points}
        if binary
        else {"cameras": _text_cameras, "images": _text_images, "points3D": _text_points}
    )
    files = {part: part_file(folder, f"{part}{'.bin' if binary else '.txt'}") for part in readers}
    if not files["points3D"].is_file():
        readers["points3D"] = lambda _: iter(())
    parts = []
    for part, path in files.items():
        try:
            parts.append(_by_id(readers[part](path)))
        except (struct.error, ValueError, OverflowError) as error:
            with path.open("rb") as file:
                why = stand_in(file.read(200))
            raise ValueError(f"{path.name}: {why}" if why else f"{path.name} is damaged: {error}") from error
    model = ModelFiles(*parts)
    if not model.points:  # what images see are then points that nobody knows
        images = {i: image._replace(points=np.full_like(image.points, NO_POINT)) for i, image in model.images.items()}
        model = model._replace(images=images)
    _check(model)
    return model


def image_names(folder: Path) -> list[str]:
    """The names of the images of the model in ``folder``; none where its file of images is damaged."""
    reader, name = (_binary_images, "images.bin") if _is_binary(folder) else (_text_images, "images.txt")
    images = reader(part_file(folder, name))
    try:
        return [image.name for _, image in images]
    except (OSError, struct.error, ValueError, OverflowError):
        return []


def _is_binary(folder: Path) -> bool:
    """Whether the model's binary files count, of which one alone does not stand in for text that is complete."""
    binary, text = (
        [part_file(folder, f"{part}{end}").is_file() for part in ("cameras", "images")] for end in (".bin", ".txt")
    )
    return all(binary) or (any(binary) and not all(text))


def _by_id(entries: Iterator[tuple[int, Entry]]) -> dict[int, Entry]:
    found: dict[int, Entry] = {}
    for number, entry in entries:
        if number in found:
            raise ValueError(f"the id {number} appears twice")
        found[number] = entry
    return found


def _check(model: ModelFiles) -> None:
    for number, camera in model.cameras.items():
        if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
            raise ValueError(f"camera {number} has an impossible size of {camera.width:.6g}×{camera.height:.6g} pixels")
    ids = np.array(sorted(model.points), np.int64)
    for image in model.images.values():
        if image.camera not in model.cameras:
            raise ValueError(f"image {image.name} names camera {image.camera}, which does not exist")
        if not (
            np.isfinite(image.pose).all() and image.pose[:4].any() and np.abs(image.pose[4:]).max() <= MAX_COORDINATE
        ):
            raise ValueError(f"image {image.name} has no pose: {', '.join(f'{v:.6g}' for v in image.pose)}")
        seen = image.points != NO_POINT
        if not (np.abs(image.xy[seen]) <= MAX_COORDINATE).all():
            raise ValueError(f"image {image.name} has keypoints that are not finite or far outside")
        if (unknown := ~np.isin(image.points, ids) & seen).any():
            raise ValueError(f"image {image.name} names point {image.points[unknown][0]}, which does not exist")
    for number, point in model.points.items():
        if not (np.abs(point.xyz) <= MAX_COORDINATE).all():
            raise ValueError(f"point {number} has no usable position: {', '.join(f'{v:.6g}' for v in point.xyz)}")


def _camera(name: str, width: int, height: int, params: tuple[float, ...]) -> Camera:
    name = name.upper()
    if name not in PARAMETERS:
        raise ValueError(f"the camera model {name[:40]!r} does not exist")
    if len(params) != PARAMETERS[name]:
        raise ValueError(f"a {name} camera has {PARAMETERS[name]} parameters, but the file gives {len(params)}")
    return Camera(name, width, height, params)


# --- binary: little endian, a count and so many entries


class _Bytes:
    """A file's bytes, taken from the front; asking for more than are left raises ValueError."""

    def __init__(self, path: Path) -> None:
        self.data, self.place = path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        """The next numbers of this struct format."""
        end = self.place + struct.calcsize(f"<{form}")
        if end > len(self.data):
            raise ValueError(f"it ends after {len(self.data)} bytes, inside an entry")
        values = struct.unpack_from(f"<{form}", self.data, self.place)
        self.place = end
        return values

    def skip(self, count: int, size: int) -> memoryview:
        """The next ``count`` entries of ``size`` bytes."""
        end = self.place + count * size
        if end > len(self.data):
            raise ValueError(f"it promises {count} entries after byte {self.place} but ends at byte {len(self.data)}")
        part = memoryview(self.data)[self.place : end]
        self.place = end
        return part

    def text(self) -> str:
        """Up to the next zero byte."""
        end = self.data.index(b"\0", self.place)
        name = self.data[self.place : end].decode("utf-8", "backslashreplace")
        self.place = end + 1
        return name


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    file = _Bytes(path)
    for _ in range(*file.take("Q")):
        number, model, width, height = file.take("IiQQ")
        if model not in CAMERA_MODELS:
            raise ValueError(f"the camera model {model} does not exist")
        name, count = CAMERA_MODELS[model]
        yield number, _camera(name, width, height, file.take(f"{count}d"))


def _binary_images(path: Path) -> Iterator[tuple[int, FileImage]]:
    file = _Bytes(path)
    keypoint = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    for _ in range(*file.take("Q")):
        number, *pose, camera = file.take("I7dI")
        name = file.text()
        seen = np.frombuffer(file.skip(file.take("Q")[0], keypoint.itemsize), keypoint)
        yield number, FileImage(name, camera, np.array(pose), seen["xy"], seen["point"])


def _binary_points(path: Path) -> Iterator[tuple[int, FilePoint]]:
    file = _Bytes(path)
    for _ in range(*file.take("Q")):
        number, x, y, z, r, g, b, error, track = file.take("q3d3BdQ")
        file.skip(track, 8)
        yield number, FilePoint((x, y, z), (r, g, b), error)


# --- text: a line per entry, two per image


class _Line(NamedTuple):
    """A line of a file, counted from 1."""

    number: int
    text: str

    def fields(self, least: int, what: str) -> list[str]:
        """What stands in it, divided by spaces. Raises ValueError where ``what`` stands there is not whole."""
        fields = self.text.split()
        if len(fields) < least:
            raise self.damaged(f"{what} needs {least} fields and has {len(fields)}")
        return fields

    def damaged(self, why: str) -> ValueError:
        return ValueError(f"line {self.number}: {why}: {self.text.strip()[:60]!r}")


def _lines(path: Path) -> list[_Line]:
    data = path.read_bytes()
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as PowerShell redirects text
    text = data.decode("utf-16" if is_utf16 else "utf-8-sig", "backslashreplace")
    return [_Line(i, line) for i, line in enumerate(LINE_END.split(text), 1) if not line.lstrip().startswith("#")]


def _filled(path: Path) -> list[_Line]:
    return [line for line in _lines(path) if line.text.strip()]


def _numbers(line: _Line, fields: Sequence[str], kind: Callable[[str], Any]) -> list[Any]:
    numbers = []
    for field in fields:
        try:
            numbers.append(kind(field))
        except ValueError as error:
            raise line.damaged(f"{field[:20]!r} is not a {'whole ' * (kind is _whole)}number") from error
    return numbers


def _whole(field: str) -> int:
    """A whole number, which may be written as 1.0."""
    number = float(field)
    if not number.is_integer():
        raise ValueError
    return int(number) if "." in field or "e" in field.lower() else int(field)


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for line in _filled(path):
        number, model, width, height, *params = line.fields(4, "a camera")
        number, *size = _numbers(line, (number, width, height), _whole)
        numbers = tuple(_numbers(line, params, float))
        try:
            yield number, _camera(model, size[0], size[1], numbers)
        except ValueError as error:
            raise line.damaged(str(error)) from error


def _text_images(path: Path) -> Iterator[tuple[int, FileImage]]:
    """Images, each followed by a line with its keypoints, which may be empty, or left out where the next line can only
    be an image: one of these ends in a name, and keypoints are triples of numbers."""
    lines = _lines(path)
    place = 0
    while place < len(lines):
        line = lines[place]
        place += 1
        if not line.text.strip():
            continue
        fields = line.fields(
            10, "an image (id, quaternion, translation, camera, name; below it a line of keypoints or none)"
        )
        number, camera = _numbers(line, (fields[0], fields[8]), _whole)
        pose = np.array(_numbers(line, fields[1:8], float))
        follows = lines[place] if place < len(lines) else _Line(place, "")
        is_left_out = _is_image(follows)
        seen = [] if is_left_out else follows.text.split()
        place += not is_left_out
        if len(seen) % 3:
            raise follows.damaged("keypoints are triples, x, y and the id of a point or -1")
        xy = np.array(_numbers(follows, [v for i, v in enumerate(seen) if i % 3 < 2], float)).reshape(-1, 2)
        points = np.array(_numbers(follows, seen[2::3], _whole), np.int64)
        yield number, FileImage(_unquoted(line.text.split(maxsplit=9)[9].strip()), camera, pose, xy, points)


def _unquoted(name: str) -> str:
    """A name without quotation marks around it: no photo's ending has one."""
    return name[1:-1] if len(name) > 2 and name[0] == name[-1] and name[0] in "\"'" else name


def _is_image(line: _Line) -> bool:
    fields = line.text.split()
    return len(fields) >= 10 and _are_numbers(fields[:9]) and not _are_numbers(fields[9:])


def _are_numbers(fields: Sequence[str]) -> bool:
    try:
        return all(math.isfinite(float(field)) for field in fields)
    except ValueError:
        return False


def _text_points(path: Path) -> Iterator[tuple[int, FilePoint]]:
    for line in _filled(path):
        number, *xyz_rgb, error = [*line.fields(7, "a point"), UNKNOWN_ERROR][:8]
        (number,), (x, y, z, *rgb, error_px) = (
            _numbers(line, (number,), _whole),
            _numbers(line, (*xyz_rgb, error), float),
        )
        if not all(0 <= value <= 255 for value in rgb):
            raise line.damaged("a colour is not between 0 and 255")
        yield number, FilePoint((x, y, z), tuple(map(round, rgb)), error_px)
