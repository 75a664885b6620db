"""Cameras given for photos as their files store them, and what ingest turned upright of these."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerf.geometry.scene import Camera
from stages import ingest, normalise, sfm
from stages.contract import run_stage
from stages.ingest.orientation import QUARTER_TURNS, upright
from stages.io.colmap_files import PARAMETERS
from stages.io.photos import Photo, read_photos
from stages.io.pixels import load_pixels
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.cameras import camera_rays, pixel_map, project, turned_camera, turned_pose
from stages.sfm.colmap.models import read_model, write_model
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.orientation import same_shape
from stages.sfm.imported.pose_files import read_poses
from tests.camera_layouts import ring
from tests.refusals import codes, refused
from tests.stages.ingest.photo_files import exif_with

WIDTH, HEIGHT = 60, 40
OPENCV = Camera("OPENCV", WIDTH, HEIGHT, (50.0, 52.0, 31.0, 18.0, 0.05, -0.02, 0.01, -0.02))
TERMS = {"k1": 0.05, "k2": -0.02, "p1": 0.01, "p2": -0.02}
LENS = {"fl_x": 50.0, "fl_y": 52.0, "cx": 31.0, "cy": 18.0, **TERMS}


def places(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A picture whose first two channels say where each pixel was."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([x, y, 100 * ((x + y) % 2)], axis=-1).astype(np.uint8)


def lens(model: str, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """Any of COLMAP's lenses, with all terms different."""
    focal = (50.0,) if model.startswith(("SIMPLE", "RADIAL")) else (50.0, 52.0)
    rest = PARAMETERS[model] - len(focal) - 2
    terms = [0.5, 1.1] if model == "EUCM" else [0.02 * (-0.7) ** i for i in range(rest)]
    return Camera(model, width, height, (*focal, 31.0, 18.0, *terms))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("model", sorted(PARAMETERS.keys() - {"EQUIRECTANGULAR"}))
def test_a_turned_camera_sees_points_as_its_picture(model: str, orientation: int) -> None:
    camera, turns = lens(model), QUARTER_TURNS[orientation]
    rng = np.random.default_rng(7)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = np.concatenate([rotation * np.linalg.det(rotation), rng.normal(size=(3, 1))], axis=1)
    rays = camera_rays(camera, WIDTH, HEIGHT).astype(float)
    world = rays.reshape(-1, 3) @ pose[:, :3].T + pose[:, 3]
    turned, turned_to = turned_camera(camera, turns), turned_pose(pose, turns)
    seen = project(turned, (world - turned_to[:, 3]) @ turned_to[:, :3])
    shown = np.asarray(upright(Image.fromarray(places()), orientation))
    assert (turned.width, turned.height) == shown.shape[1::-1]
    column, row = np.floor(seen).astype(int).T
    expected = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(shown[row, column, :2], expected)
    mapped = (
        np.column_stack([expected + 0.5, np.ones(len(seen))]) @ pixel_map((WIDTH, HEIGHT), turns, *shown.shape[1::-1]).T
    )
    np.testing.assert_allclose(mapped, seen, atol=1e-3)
    assert np.linalg.det(turned_to[:, :3]) == pytest.approx(1)


def test_four_quarter_turns_change_nothing() -> None:
    pose = ring(3)[1]
    np.testing.assert_allclose(turned_camera(OPENCV, 4).params, OPENCV.params)
    np.testing.assert_allclose(turned_pose(pose, 4), pose)
    half = pixel_map((WIDTH, HEIGHT), 4, WIDTH // 2, HEIGHT)
    np.testing.assert_allclose(half, [[0.5, 0, 0], [0, 1, 0]])


def photo_set(folder: Path, orientation: int, count: int = 4, width: int = WIDTH, height: int = HEIGHT) -> list[str]:
    """Photos as a phone stores them, and their names."""
    folder.mkdir()
    names = [f"p{index}.png" for index in range(count)]
    for name in names:
        Image.fromarray(places(width, height)).save(folder / name, exif=exif_with(orientation))
    return names


def frames_of(names: list[str]) -> list[dict[str, Any]]:
    matrices = [np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1, -1, 1]) for pose in ring(len(names))]
    return [{"file_path": name, "transform_matrix": m.tolist()} for name, m in zip(names, matrices, strict=True)]


def imported(cameras: Path, photos: Path, folder: Path, progress: Any) -> tuple[SparseModel, np.ndarray]:
    """The cameras as stage sfm leaves them, and the first photo's pixels as ingest does."""
    ingest.run(ingest.Config(photos=photos, cameras=cameras), {}, folder / "ingest", progress)
    run_stage(sfm.STAGE, sfm.Config(cameras=cameras), {"ingest": folder / "ingest"}, folder / "sfm", progress)
    first = read_photos(folder / "ingest")[0]
    return read_model(folder / "sfm/sparse"), load_pixels(folder / "ingest" / first.file, first.width, first.height)


def stored_places(model: SparseModel, pixels: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Which stored pixel the first photo shows where its camera sees what the given one sees at each stored pixel."""
    world = camera_rays(camera, camera.width, camera.height).reshape(-1, 3).astype(float) @ pose[:, :3].T + pose[:, 3]
    image = model.images[0]
    seen = project(model.cameras[image.camera], (world - image.sfm_from_camera[:, 3]) @ image.sfm_from_camera[:, :3])
    column, row = np.floor(seen).astype(int).T
    return pixels[row, column, :2]


@pytest.mark.parametrize(("width", "height"), [(WIDTH, HEIGHT), (50, 50)])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_cameras_of_stored_pixels_turn_with_their_photos(
    orientation: int, width: int, height: int, tmp_path: Path, progress: Any
) -> None:
    names = photo_set(tmp_path / "photos", orientation, width=width, height=height)
    size = {"w": width, "h": height} if orientation != 8 else {}  # without, they are of the files as they are
    (tmp_path / "given.json").write_text(json.dumps({**LENS, **size, "frames": frames_of(names)}))
    model, pixels = imported(tmp_path / "given.json", tmp_path / "photos", tmp_path, progress)
    given = Camera("OPENCV", width, height, OPENCV.params)
    expected = places(width, height)[..., :2].reshape(-1, 2)
    np.testing.assert_array_equal(stored_places(model, pixels, given, ring(4)[0]), expected)
    assert ("sfm.turned-upright" in progress.codes) == (orientation != 1)


@pytest.mark.parametrize("orientation", [6, 8])
def test_the_principal_point_tells_of_upright_photos(orientation: int, tmp_path: Path, progress: Any) -> None:
    names = photo_set(tmp_path / "photos", orientation)
    given = LENS | {"cx": 18.0, "cy": 31.0}  # of pictures of 40 × 60
    (tmp_path / "given.json").write_text(json.dumps({**given, "frames": frames_of(names)}))
    model, _ = imported(tmp_path / "given.json", tmp_path / "photos", tmp_path, progress)
    (camera,) = model.cameras
    assert (camera.width, camera.height) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(camera.params[:4], (50.0, 52.0, 18.0, 31.0))
    np.testing.assert_allclose(model.images[0].sfm_from_camera, ring(4)[0], atol=1e-9)
    assert "sfm.turned-upright" not in progress.codes


@pytest.mark.parametrize("orientation", [3, 6])
def test_our_own_export_is_of_upright_photos_and_comes_back(orientation: int, tmp_path: Path, progress: Any) -> None:
    names = photo_set(tmp_path / "photos", orientation)
    given = tmp_path / "given.json"
    given.write_text(json.dumps({**LENS, "w": WIDTH, "h": HEIGHT, "frames": frames_of(names)}))
    first, _ = imported(given, tmp_path / "photos", tmp_path / "first", progress)
    folders = {name: tmp_path / "first" / name for name in ("ingest", "sfm", "normalise")}
    folders["normalise"].mkdir()
    normalise.run(normalise.Config(), folders, folders["normalise"], progress)
    again, _ = imported(folders["normalise"] / "transforms.json", tmp_path / "photos", tmp_path / "again", progress)
    np.testing.assert_allclose([c.params for c in again.cameras], [c.params for c in first.cameras], atol=1e-9)
    poses, as_before = ([image.sfm_from_camera for image in model.images] for model in (again, first))
    np.testing.assert_allclose(poses, as_before, atol=1e-9)


@pytest.mark.parametrize(("orientation", "width", "height"), [(3, WIDTH, HEIGHT), (6, WIDTH, HEIGHT), (8, 50, 50)])
def test_our_own_model_is_of_upright_photos_and_comes_back(
    orientation: int, width: int, height: int, tmp_path: Path, progress: Any
) -> None:
    names = photo_set(tmp_path / "photos", orientation, width=width, height=height)
    given = tmp_path / "given.json"
    given.write_text(json.dumps({**LENS, "w": width, "h": height, "frames": frames_of(names)}))
    first, _ = imported(given, tmp_path / "photos", tmp_path / "first", progress)
    again, _ = imported(tmp_path / "first/sfm/sparse", tmp_path / "photos", tmp_path / "again", progress)
    np.testing.assert_allclose([c.params for c in again.cameras], [c.params for c in first.cameras], atol=1e-9)
    poses, as_before = ([image.sfm_from_camera for image in model.images] for model in (again, first))
    np.testing.assert_allclose(poses, as_before, atol=1e-9)


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_one_camera_that_only_fits_upright_tells_it_of_all(kind: str, alone: bool, tmp_path: Path) -> None:
    turned = dataclasses.replace(turned_photo(3), file="images/p.jpg")
    photos = [turned] if alone else [turned, dataclasses.replace(turned_photo(6, "q.jpg"), file="images/q.jpg")]
    names, given = [photo.name for photo in photos], tmp_path
    if kind == "transforms":
        given = tmp_path / "given.json"
        sizes = [{"w": photo.width, "h": photo.height} for photo in photos]
        frames = [frame | size for frame, size in zip(frames_of(names), sizes, strict=True)]
        given.write_text(json.dumps({**LENS, "frames": frames}))
    else:
        cameras = [dataclasses.replace(OPENCV, width=photo.width, height=photo.height) for photo in photos]
        images = [SparseImage(name, i, pose) for i, (name, pose) in enumerate(zip(names, ring(5), strict=False))]
        write_model(tmp_path, SparseModel.without_points(cameras, images))
    known = read_poses(given, photos, {name: name for name in names})
    assert ("sfm.turned-upright" in codes(known.notes)) == alone


def turned_photo(orientation: int, name: str = "p.jpg") -> Photo:
    width, height = (HEIGHT, WIDTH) if orientation >= 5 else (WIDTH, HEIGHT)
    return Photo(name, "images/p.png", width, height, 0, None, None, False, 1.0, orientation=orientation)


def read_one(folder: Path, taken: Photo, **values: Any) -> ImportedPoses:
    file = folder / "given.json"
    frame = {"file_path": "p.jpg", "transform_matrix": np.eye(4).tolist()}
    file.write_text(json.dumps({**LENS, "frames": [frame | values]}))
    return read_poses(file, [taken], {"p.jpg": taken.name})


@pytest.mark.parametrize("factor", [1, 2, 4, 7])
def test_reduced_photos_have_whole_pixels(factor: int) -> None:
    camera = Camera("SIMPLE_PINHOLE", 400, 267, (300.0, 200.0, 133.5))
    width, height = 400 / factor, 267 / factor
    for size in ((math.floor(width), math.floor(height)), (round(width), math.ceil(height))):
        assert same_shape(camera, size)
    assert not same_shape(camera, (round(width), round(height) + math.ceil(10 / factor)))


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_no_camera_is_mirrored(orientation: int, tmp_path: Path) -> None:
    with refused("sfm.mirrored-photo", orientation, "p.jpg"):
        read_one(tmp_path, turned_photo(orientation), w=WIDTH, h=HEIGHT)
    photo = turned_photo(orientation)  # a camera of what ingest made of it needs no mirroring
    known = read_one(tmp_path, photo, w=photo.width, h=photo.height, photo="p.jpg")
    assert known.model.cameras[0].params == OPENCV.params


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_camera_of_the_upright_photo_fits_it(orientation: int, tmp_path: Path) -> None:
    known = read_one(tmp_path, turned_photo(orientation), w=2 * HEIGHT, h=2 * WIDTH, fl_x=100, fl_y=104)
    (camera,) = known.model.cameras
    assert camera.params == pytest.approx((50, 52, 15.5, 9, 0.05, -0.02, 0.01, -0.02))
    assert (camera.width, camera.height) == (HEIGHT, WIDTH)
    assert known.notes == []


def test_a_camera_that_fits_neither_orientation_is_refused(tmp_path: Path) -> None:
    with refused("sfm.photo-shape", "80×40", "40×60"):
        read_one(tmp_path, turned_photo(6), w=80, h=40)


@pytest.mark.parametrize("name", ["p.jpg", "p.png"])
def test_the_keypoints_of_a_colmap_model_turn_too(name: str, tmp_path: Path) -> None:
    """Under the name of the decoded photo, ``p.png``, the model is one of upright pixels."""
    pose = ring(5)[2]
    camera = Camera("OPENCV", 2 * WIDTH, 2 * HEIGHT, (100.0, 104.0, 62.0, 36.0, *TERMS.values()))
    rays = camera_rays(camera, 7, 5).reshape(-1, 3).astype(float)
    xyz, xy = 3 * rays @ pose[:, :3].T + pose[:, 3], project(camera, rays)
    count = len(xyz)
    points = {"xyz": xyz, "rgb": np.zeros((count, 3), np.uint8), "error_px": np.zeros(count), "xy": xy}
    seen = {"view": np.zeros(count, int), "point": np.arange(count)}
    write_model(tmp_path, SparseModel(cameras=[camera], images=[SparseImage(name, 0, pose)], **points, **seen))
    model = read_poses(tmp_path, [turned_photo(3)], {}).model
    (image,) = model.images
    inside = (model.xyz[model.point] - image.sfm_from_camera[:, 3]) @ image.sfm_from_camera[:, :3]
    np.testing.assert_allclose(project(model.cameras[0], inside), model.xy, atol=1e-3)
    stored = xy[model.point] / 2
    expected = stored if name == "p.png" else (WIDTH, HEIGHT) - stored
    np.testing.assert_allclose(model.xy, expected, atol=1e-3)
    assert math.dist(image.sfm_from_camera[:, 3], pose[:, 3]) < 1e-9
