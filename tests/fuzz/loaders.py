"""Every loader of files that strangers may have made: what it is given, and how it is called.

A loader may answer, or refuse in words (``REFUSALS``). Anything else that it raises is a defect, and so is a case that
takes more than ``SECONDS`` of processor time.
"""

import contextlib
import hashlib
import io
import json
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

from pipeline.manifests import BadManifest
from pipeline.settings import UsageError
from stages.contract import StageError
from stages.decoding import DecodeError
from tests.fuzz.inputs import damaged, json_files

REFUSALS = (StageError, UsageError, DecodeError, BadManifest)
SECONDS = 20
W, H = 24, 20


class Loader(NamedTuple):
    """``files()``: the content of each file, by name; ``load`` reads them from a folder."""

    files: Callable[[], st.SearchStrategy[dict[str, bytes]]]
    load: Callable[[Path], object]


def attempt(loader: Loader, files: dict[str, bytes]) -> bool:
    """Whether the files were taken; False where they were refused in words. Raises whatever else happens."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        try:
            loader.load(Path(folder))
        except REFUSALS as refusal:
            words = str(refusal)
            assert words.strip(), "a refusal without words"
            assert len(words) < 2000, f"a refusal of {len(words)} letters"
            return False
        return True


def one_of(files: dict[str, bytes]) -> st.SearchStrategy[dict[str, bytes]]:
    """Valid files of which one is damaged."""
    return st.sampled_from(sorted(files)).flatmap(
        lambda name: damaged(files[name]).map(lambda new: {**files, name: new})
    )


def single(name: str, content: st.SearchStrategy[bytes]) -> st.SearchStrategy[dict[str, bytes]]:
    """One file."""
    return content.map(lambda data: {name: data})


# --- pictures


@cache
def pictures() -> dict[str, bytes]:
    """One valid picture of every format and of most modes."""
    from PIL import Image

    x, y = np.meshgrid(np.linspace(0, 1, W), np.linspace(0, 1, H))
    rgb = np.rint(255 * np.stack([x, y, x * y], -1)).astype(np.uint8)
    image = Image.fromarray(rgb)
    alpha = Image.fromarray(np.dstack([rgb, rgb[..., :1]]))
    exif = Image.Exif()
    exif.update({271: "maker", 272: "model", 274: 6})
    exif.get_ifd(34665).update({37386: 4.2, 41989: 28, 40962: W, 40963: H})
    exif.get_ifd(34853).update({1: "N", 2: (47.0, 22.0, 1.5), 3: "E", 4: (8.0, 32.0, 3.0)})
    variants: dict[str, tuple[Image.Image, str, dict[str, Any]]] = {
        "jpeg": (image, "JPEG", {"exif": exif}),
        "grey": (image.convert("L"), "JPEG", {"progressive": True}),
        "cmyk": (image.convert("CMYK"), "JPEG", {}),
        "png": (alpha, "PNG", {"exif": exif}),
        "palette": (image.convert("P"), "PNG", {"transparency": 3}),
        "deep": (Image.fromarray(rgb[..., 0].astype(np.uint16) * 257), "PNG", {}),
        "tiff": (image, "TIFF", {"compression": "tiff_lzw"}),
        "float": (Image.fromarray(rgb[..., 0].astype(np.float32) / 255), "TIFF", {}),
        "webp": (alpha, "WEBP", {"exif": exif}),
        "bmp": (image, "BMP", {}),
        "gif": (image.convert("P"), "GIF", {"save_all": True, "append_images": [image.convert("P")]}),
        "ppm": (image, "PPM", {}),
        "jpeg2000": (image, "JPEG2000", {}),
    }
    written = {}
    for name, (picture, kind, options) in variants.items():
        buffer = io.BytesIO()
        picture.save(buffer, kind, **options)
        written[name] = buffer.getvalue()
    return written


MAGIC = (
    b"\xff\xd8\xff\xe0",
    b"\x89PNG\r\n\x1a\n",
    b"II*\0",
    b"MM\0*",
    b"RIFF\x40\0\0\0WEBPVP8 ",
    b"BM",
    b"GIF89a",
    b"P6 ",
)


def any_picture() -> st.SearchStrategy[bytes]:
    """A damaged picture, or noise behind the mark of a format."""
    noise = st.tuples(st.sampled_from(MAGIC), st.binary(max_size=400)).map(b"".join)
    return st.one_of(*(damaged(picture) for picture in pictures().values()), noise)


def _load_photo(folder: Path) -> None:
    from stages.decoding import decode
    from stages.near_duplicates import thumbnail
    from stages.sharpness import one_colour, sharpness

    decoded = decode(folder / "a.png")
    assert decoded.pixels.dtype == np.uint8 and decoded.pixels.shape[2] in (3, 4)
    for measure in (sharpness, one_colour, thumbnail):
        measure(decoded.pixels)


def _load_mask(folder: Path) -> None:
    from stages.masks import read_mask

    mask = read_mask(folder / "a.png", H, W, 6).pixels
    assert mask.shape == (W, H) and set(np.unique(mask)) <= {0, 255}


@cache
def clip() -> bytes:
    """A short video whose picture moves."""
    from stages.video import video_writer

    noise = np.random.default_rng(0).integers(0, 256, (48, 160, 3), np.uint8).repeat(2, 0).repeat(2, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        with video_writer(path, 96, 96, 8) as append:
            for k in range(8):
                append(np.ascontiguousarray(noise[:, 8 * k : 8 * k + 96]))
        return path.read_bytes()


def _load_video(folder: Path) -> None:
    from stages.video_frames import take_frames

    (folder / "out").mkdir()
    assert len(take_frames(folder / "a.mp4", 5, folder / "out", Quiet())) >= 3


class Quiet:
    """A Progress that says nothing."""

    def update(self, message: str, done: float | None = None) -> None:
        """Nothing."""

    def note(self, message: str) -> None:
        """Nothing."""


# --- cameras


@cache
def transforms() -> dict[str, Any]:
    """A valid transforms file of four photos."""
    from nerf.synthetic import ring_of_cameras

    frames = [
        {
            "file_path": f"p{index}.png",
            "transform_matrix": np.vstack([pose @ np.diag([1, -1, -1, 1]), [0, 0, 0, 1]]).tolist(),
        }
        for index, pose in enumerate(ring_of_cameras(4))
    ]
    lens = {"w": W, "h": H, "fl_x": 30.0, "fl_y": 31.0, "cx": 12.0, "cy": 10.0, "k1": 0.01, "camera_angle_x": 0.8}
    return {**lens, "camera_model": "OPENCV", "frames": frames}


def _photos(frames: dict[str, str]) -> list:
    from stages.photos import Photo

    return [
        Photo(name, f"images/{i}.png", W, H, 0, None, None, False, 1.0)
        for i, name in enumerate(sorted(set(frames.values())))
    ]


def _load_cameras(given: Path, folder: Path) -> None:
    """From what is given to the finished stages ingest (photos.json) and sfm, less the photos."""
    from stages.photos import write_photos
    from stages.sources import find_source

    source = find_source(given)
    assert all(file.is_relative_to(source.root) for file in source.files)
    photos = _photos(dict(source.frames))
    folder.mkdir()
    write_photos(folder, photos, [], source.frames)
    assert source.cameras is not None
    _import_cameras(source.cameras, photos, folder)


def _import_cameras(cameras: Path, photos: list, folder: Path) -> None:
    """The end of stage sfm with given cameras, and the scene frame of them: finite, whatever they were."""
    from nerf.normalisation import normalise
    from stages.colmap.models import read_model
    from stages.normalise import _reconstruction
    from stages.sfm import _import

    assert _import(cameras, photos, folder, folder / "sfm", Quiet()).outputs
    model = read_model(folder / "sfm" / "sparse")
    try:
        found = normalise(_reconstruction(model, list(range(len(model.images))), None), None)
    except ValueError as error:
        raise StageError("the scene has no scale", str(error), "-") from error
    assert (found.near > 0).all() and (found.near < found.far).all() and np.isfinite(found.far).all()
    assert np.isfinite(found.scene_from_sfm.matrix()).all()


def _load_blender(folder: Path) -> None:
    _load_cameras(folder, folder / "out")


def _load_transforms(folder: Path) -> None:
    _load_cameras(folder / "t.json", folder / "out")


@cache
def scene() -> Any:
    """A valid scene.json."""
    from nerf.scene import Camera, Scene, Similarity, View
    from nerf.synthetic import ring_of_cameras

    views = tuple(
        View(f"{i}.png", f"images/{i}.png", 0, pose, 0.1, 9.0, "train", None)
        for i, pose in enumerate(ring_of_cameras(4))
    )
    camera = Camera("PINHOLE", W, H, (30.0, 31.0, 12.0, 10.0))
    return Scene((camera,), views, Similarity(0.5, np.eye(3), np.zeros(3)), False, False, "around", True)


def _load_path(folder: Path) -> None:
    from stages.render_path import path_from_file, path_rays

    path = path_from_file(scene(), folder / "path.json").resized(8)
    rays = next(path_rays(path, scene()))
    assert bool(rays.directions.isfinite().all()) and bool(rays.origins.isfinite().all())


@cache
def colmap_models() -> dict[str, dict[str, bytes]]:
    """A valid COLMAP model as binary and as text files."""
    import pycolmap

    from nerf.scene import Camera
    from nerf.synthetic import ring_of_cameras
    from stages.colmap.cameras import project
    from stages.colmap.models import write_model
    from stages.sparse_model import SparseImage, SparseModel

    camera, points = Camera("OPENCV", W, H, (30.0, 31.0, 12.0, 10.0, 0.01, 0.0, 0.0, 0.0)), np.eye(3) / 4
    poses = ring_of_cameras(3)
    xy = [project(camera, (points - pose[:, 3]) @ pose[:, :3]) for pose in poses]
    images = [SparseImage(f"p{i}.png", 0, pose) for i, pose in enumerate(poses)]
    view, point = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    grey = np.full((3, 3), 128, np.uint8)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_model(
            folder / "bin", SparseModel([camera], images, points, grey, np.zeros(3), view, point, np.concatenate(xy))
        )
        (folder / "txt").mkdir()
        pycolmap.Reconstruction(folder / "bin").write_text(folder / "txt")
        return {kind: {path.name: path.read_bytes() for path in (folder / kind).iterdir()} for kind in ("bin", "txt")}


def _load_colmap(folder: Path) -> None:
    from stages.photos import write_photos

    photos = _photos({f"p{i}.png": f"p{i}.png" for i in range(3)})
    (folder / "out").mkdir()
    write_photos(folder / "out", photos, [], {})
    _import_cameras(folder, photos, folder / "out")


# --- settings and workspaces

TOML = b"""[train]
steps = 500
preset = "draft"
learning_rate = 0.01
[normalise]
roi = [0.0, 1.0, 2.0, 3.0]
[sfm]
camera_params = [500.0, 320.0, 240.0, 0.1]
[mesh]
formats = ["ply", "glb"]
"""


def _load_toml(folder: Path) -> None:
    from pipeline.settings import read_toml, settings_from

    settings_from(read_toml(folder / "a.toml"), "--config a.toml")


def _load_run(folder: Path) -> None:
    from pipeline import status
    from pipeline.cli import _reader

    with contextlib.chdir(folder):  # where relative paths in it lead
        status.all_statuses(*_reader(folder))


@cache
def run_file() -> dict[str, Any]:
    """A valid run.json."""
    from pipeline.settings import Settings

    options = Settings().model_dump(mode="json")
    keys = dict.fromkeys(options, "0" * 64)
    return {
        "version": 1,
        "options": options,
        "plans": {"train": {"0": {"steps": 5}}},
        "keys": keys,
        "stages": ["ingest"],
    }


@cache
def manifest() -> dict[str, Any]:
    """A valid manifest.json of one output."""
    from dataclasses import asdict

    from pipeline.manifests import Manifest, outputs_digest

    outputs = {"a.json": {"size": 2, "sha256": hashlib.sha256(b"{}").hexdigest()}}
    digest = outputs_digest(outputs)
    return asdict(Manifest("mesh", 1, "0" * 64, {}, {}, outputs, digest, {}, {}, "line", 1.0, "2026", {}))


def _sealed(text: bytes) -> bytes:
    """An object with the seal that it would have: what is behind the seal is to be read, too."""
    from pipeline.manifests import sealed

    try:
        value = json.loads(text)
        return json.dumps(sealed(value)).encode() if isinstance(value, dict) else text
    except (ValueError, RecursionError):
        return text


def _load_manifest(folder: Path) -> None:
    from pipeline import manifests

    manifests.check_outputs(folder, manifests.read(folder), deep=True)


def _load_photos(folder: Path) -> None:
    from stages.photos import read_frame_names, read_photos

    for photo in read_photos(folder):
        assert not Path(photo.file).is_absolute() and ".." not in Path(photo.file).parts
    read_frame_names(folder)


@cache
def photos_file() -> bytes:
    """A valid photos.json."""
    from stages.photos import write_photos

    with tempfile.TemporaryDirectory() as folder:
        write_photos(Path(folder), _photos({"a": "p0.png", "b": "p1.png"}), [], {"a": "p0.png"})
        return (Path(folder) / "photos.json").read_bytes()


def _load_scene(folder: Path) -> None:
    from stages.files import read_scene

    read_scene(folder)


# --- tensors


def _load_points(folder: Path) -> None:
    from stages.files import read_tensors

    read_tensors(folder / "points.safetensors")


@cache
def points() -> bytes:
    """A valid points.safetensors."""
    from safetensors.numpy import save

    return save({"xyz": np.zeros((3, 3), np.float32), "rgb": np.zeros((3, 3), np.uint8), "view": np.arange(3)})


@cache
def field() -> dict[str, bytes]:
    """A valid, tiny trained field."""
    from nerf.paper import PaperNerf, PaperSettings
    from stages.field_files import save_field

    model = PaperNerf(PaperSettings(depth=2, width=8, position_frequencies=2, direction_frequencies=1), seed=0)
    exposure = {"neutral": [0.0, 0.0, 0.0], "photos": {"p0.png": [0.1, 0.0, 0.0]}}
    info = {"background": [1, 1, 1], "downscale": 1.0, "steps": 5, "rays": 50, "exposure": exposure}
    with tempfile.TemporaryDirectory() as folder:
        save_field(Path(folder), model, info)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _fields() -> st.SearchStrategy[dict[str, bytes]]:
    valid = field()
    settings = json_files(json.loads(valid["field.json"]))
    return st.one_of(one_of(valid), settings.map(lambda text: {**valid, "field.json": text}))


def _load_field(folder: Path) -> None:
    from stages.field_files import load_field

    load_field(folder)


@cache
def checkpoint() -> dict[str, bytes]:
    """A valid checkpoint."""
    import torch

    from stages.checkpoints import Checkpoint, save_checkpoint

    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder), Checkpoint(7, {"w": torch.zeros(3)}, {"lr": 0.1}))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _load_checkpoint(folder: Path) -> None:
    from stages.checkpoints import latest_checkpoint

    if latest_checkpoint(folder, lambda _: None) is None:
        raise StageError("no checkpoint", "the only one is damaged", "-")


def _blender() -> st.SearchStrategy[dict[str, bytes]]:
    halves = {"transforms_train.json": {**transforms(), "frames": transforms()["frames"][:3]}}
    halves["transforms_test.json"] = {**transforms(), "frames": transforms()["frames"][3:]}
    valid = {name: json.dumps(value).encode() for name, value in halves.items()}
    name = st.sampled_from(sorted(halves))
    return name.flatmap(lambda name: json_files(halves[name]).map(lambda text: {**valid, name: text}))


LOADERS = {
    "photo": Loader(lambda: single("a.png", any_picture()), _load_photo),
    "mask": Loader(lambda: single("a.png", any_picture()), _load_mask),
    "video": Loader(lambda: single("a.mp4", damaged(clip())), _load_video),
    "transforms": Loader(lambda: single("t.json", json_files(transforms())), _load_transforms),
    "blender": Loader(_blender, _load_blender),
    "colmap binary": Loader(lambda: one_of(colmap_models()["bin"]), _load_colmap),
    "colmap text": Loader(lambda: one_of(colmap_models()["txt"]), _load_colmap),
    "camera path": Loader(lambda: single("path.json", json_files(transforms())), _load_path),
    "toml": Loader(lambda: single("a.toml", damaged(TOML)), _load_toml),
    "run.json": Loader(lambda: single("run.json", json_files(run_file())), _load_run),
    "manifest.json": Loader(
        lambda: json_files(manifest()).map(lambda text: {"manifest.json": _sealed(text), "a.json": b"{}"}),
        _load_manifest,
    ),
    "photos.json": Loader(lambda: single("photos.json", json_files(json.loads(photos_file()))), _load_photos),
    "scene.json": Loader(lambda: single("scene.json", json_files(scene().to_json())), _load_scene),
    "points": Loader(lambda: single("points.safetensors", damaged(points())), _load_points),
    "field": Loader(_fields, _load_field),
    "checkpoint": Loader(lambda: one_of(checkpoint()), _load_checkpoint),
}
