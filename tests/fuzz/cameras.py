"""Cameras from elsewhere: transforms files, COLMAP models, camera paths; valid ones, and how each is read."""

import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from hypothesis import strategies as st

from nerf.geometry.normalisation import normalise
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.synthetic.scenes import ring_of_cameras
from pipeline.engine.display import SilentDisplay
from stages.contract import StageError
from stages.ingest.sources import find_source
from stages.io.photos import Photo, write_photos
from stages.io.sparse_model import SparseImage, SparseModel
from stages.normalise.scene_frame import _reconstruction
from stages.render.path import path_from_file, path_rays
from stages.sfm.colmap.cameras import project
from stages.sfm.colmap.models import read_model, write_model
from stages.sfm.imported.conventions import AS_DECLARED
from stages.sfm.imported.import_poses import write_imported_model
from tests.fuzz.inputs import H, W, json_files


@cache
def transforms() -> dict[str, Any]:
    """A valid transforms file of four photos."""
    frames = [
        {
            "file_path": f"p{index}.png",
            "transform_matrix": np.vstack([pose @ np.diag([1, -1, -1, 1]), [0, 0, 0, 1]]).tolist(),
        }
        for index, pose in enumerate(ring_of_cameras(4))
    ]
    lens = {"w": W, "h": H, "fl_x": 30.0, "fl_y": 31.0, "cx": 12.0, "cy": 10.0, "k1": 0.01, "camera_angle_x": 0.8}
    return {**lens, "camera_model": "OPENCV", "frames": frames}


def photos_of(frames: dict[str, str]) -> list:
    return [
        Photo(name, f"images/{i}.png", W, H, 0, None, None, False, 1.0)
        for i, name in enumerate(sorted(set(frames.values())))
    ]


def _load_cameras(given: Path, folder: Path) -> None:
    """From what is given to the finished stages ingest (photos.json) and sfm, less the photos."""
    for name in (frame["file_path"] for frame in transforms()["frames"]):
        (folder.parent / name).touch()
    source = find_source(given)
    assert all(file.is_relative_to(source.root) for file in source.files)
    photos = photos_of(dict(source.frames))
    folder.mkdir()
    write_photos(folder, photos, [], source.frames)
    assert source.cameras is not None
    _import_cameras(source.cameras, photos, folder)


def _import_cameras(cameras: Path, photos: list, folder: Path) -> None:
    """The end of stage sfm with given cameras, and the scene frame of them: finite, whatever they were."""
    write_imported_model(cameras, AS_DECLARED, photos, folder, folder / "sfm", SilentDisplay())
    model = read_model(folder / "sfm" / "sparse")
    try:
        found = normalise(_reconstruction(model, list(range(len(model.images)))), None)
    except ValueError as error:
        raise StageError("normalise.no-scale", "the scene has no scale", str(error), "-") from error
    assert (found.near > 0).all() and (found.near < found.far).all() and np.isfinite(found.far).all()
    assert np.isfinite(found.scene_from_sfm.matrix()).all()


def try_blender(folder: Path) -> None:
    _load_cameras(folder, folder / "out")


def try_transforms(folder: Path) -> None:
    _load_cameras(folder / "t.json", folder / "out")


@cache
def scene() -> Any:
    """A valid scene.json."""
    views = tuple(
        View(f"{i}.png", f"images/{i}.png", 0, pose, 0.1, 9.0, "train", None)
        for i, pose in enumerate(ring_of_cameras(4))
    )
    camera = Camera("PINHOLE", W, H, (30.0, 31.0, 12.0, 10.0))
    return Scene((camera,), views, Similarity(0.5, np.eye(3), np.zeros(3)), False, False, "object-centric", True)


def try_path(folder: Path) -> None:
    path = path_from_file(scene(), folder / "path.json").resized(8)
    rays = next(path_rays(path, scene()))
    assert bool(rays.directions.isfinite().all()) and bool(rays.origins.isfinite().all())


@cache
def colmap_models() -> dict[str, dict[str, bytes]]:
    """A valid COLMAP model as binary and as text files."""
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


def try_colmap(folder: Path) -> None:
    photos = photos_of({f"p{i}.png": f"p{i}.png" for i in range(3)})
    (folder / "out").mkdir()
    write_photos(folder / "out", photos, [], {})
    _import_cameras(folder, photos, folder / "out")


def blender() -> st.SearchStrategy[dict[str, bytes]]:
    halves = {"transforms_train.json": {**transforms(), "frames": transforms()["frames"][:3]}}
    halves["transforms_test.json"] = {**transforms(), "frames": transforms()["frames"][3:]}
    valid = {name: json.dumps(value).encode() for name, value in halves.items()}
    name = st.sampled_from(sorted(halves))
    return name.flatmap(lambda name: json_files(halves[name]).map(lambda text: {**valid, name: text}))
