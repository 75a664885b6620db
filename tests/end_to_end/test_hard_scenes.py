"""What the chain makes of scenes with hard cameras: a good result, or a refusal that names the reason."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from nerf.geometry.camera_paths import look_at
from tests.end_to_end.hard_scenes import RING, Poses, moved, over_white, run, write_set

UTM = (448_262.5, 5_411_932.25, 273.0)
NORMALISED = ("--until", "normalise")
EVALUATED = ("--until", "evaluate")


def one_far() -> Poses:
    """The fourth camera a thousand times as far from the middle."""
    poses = RING.copy()
    poses[3, :, 3] *= 1000
    return poses


def grid_of_cameras(x: float, y: float) -> np.ndarray:
    return np.stack([*np.meshgrid(np.linspace(-x, x, 4), np.linspace(-y, y, 3))], -1).reshape(-1, 2)


def coplanar() -> Poses:
    """Twelve places in one upright plane, all looking at the still life."""
    across, up = grid_of_cameras(1.2, 0.5).T
    return look_at(np.stack([across, np.full(12, -4.0), up + 1.1], axis=1), np.array([0, 0, 0.3]))


def collinear() -> Poses:
    """Twelve places on one line."""
    places = np.stack([np.linspace(-1.5, 1.5, 12), np.full(12, -4.0), np.ones(12)], axis=1)
    return look_at(places, np.array([0, 0, 0.3]))


def nadir() -> Poses:
    """A drone's grid: every camera looks straight down."""
    poses = np.zeros((12, 3, 4))
    poses[:, :, :3] = np.diag([1.0, -1.0, -1.0])
    poses[:, :, 3] = np.concatenate([grid_of_cameras(1.2, 0.8), np.full((12, 1), 4.0)], axis=1)
    return poses


def in_pairs() -> Poses:
    """Every place twice."""
    return np.repeat(RING[::2], 2, axis=0)


def check_good(done: Any) -> None:
    """Every figure finite, and test photos are better than a flat colour."""
    assert done.code == 0, done.events[-1]
    metrics = done.read("metrics.json")
    assert metrics["psnr_mean_image"] + 0.5 < metrics["psnr"] < 40
    for view in done.read("scene.json")["views"]:
        assert 0 < view["near"] < view["far"] < 1e5
        assert np.isfinite(view["scene_from_camera"]).all()


@pytest.mark.parametrize("poses", [one_far, coplanar, collinear, nadir, in_pairs])
def test_a_field_comes_of_it(poses: Any, tmp_path: Path) -> None:
    check_good(run(write_set(tmp_path / "set", poses()), tmp_path / "w.nerf", *EVALUATED))


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """scene.json of the set as it is."""
    folder = tmp_path_factory.mktemp("usual")
    return run(write_set(folder / "set"), folder / "w.nerf", *NORMALISED).read("scene.json")


@pytest.mark.parametrize(
    ("scale", "offset"),
    [(1, UTM), (1e-6, (0, 0, 0)), (1e6, (0, 0, 0)), (1e-25, (0, 0, 0)), (1e25, (0, 0, 0)), (1e6, UTM)],
)
def test_the_scene_does_not_depend_on_unit_and_origin(
    scale: float, offset: tuple[float, ...], usual: dict[str, Any], tmp_path: Path
) -> None:
    given = write_set(tmp_path / "set", told=moved(RING, scale, offset))
    scene = run(given, tmp_path / "w.nerf", *NORMALISED).read("scene.json")
    for view, expected in zip(scene["views"], usual["views"], strict=True):
        np.testing.assert_allclose(view["scene_from_camera"], expected["scene_from_camera"], atol=1e-7)
        assert (view["near"], view["far"]) == pytest.approx((expected["near"], expected["far"]), rel=1e-7)
    relative = scene["scene_from_sfm"]["scale"] * scale / usual["scene_from_sfm"]["scale"]
    assert relative == pytest.approx(1, rel=1e-7)


def upright_from_file(glb: Path) -> np.ndarray:
    """The rotation (3, 3) of the root, which stands what is in the file upright."""
    content = glb.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    root = json.loads(content[20 : 20 + length])["nodes"][0]
    return np.array(root["matrix"]).reshape(4, 4).T[:3, :3]


@pytest.mark.parametrize(("scale", "offset"), [(1, UTM), (1e-6, (0, 0, 0))])
def test_the_mesh_lies_where_the_cameras_say(scale: float, offset: tuple[float, ...], tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", told=moved(RING, scale, offset)), tmp_path / "w.nerf")
    check_good(done)
    distinct = {}
    for kind in ("ply", "glb"):
        vertices = trimesh.load_mesh(done.output(f"mesh.{kind}"), process=False).vertices
        if kind == "glb":
            vertices = vertices @ upright_from_file(done.output("mesh.glb"))
        local = (vertices - offset) / scale
        assert 0.2 < np.ptp(local, axis=0).max() < 5, kind
        assert np.abs(np.median(local, axis=0)).max() < 1.5, kind
        distinct[kind] = len(np.unique(vertices, axis=0))  # charts of a texture repeat those at their borders in GLB
    assert distinct["ply"] > 0.9 * len(trimesh.load_mesh(done.output("mesh.ply"), process=False).vertices)
    assert distinct["glb"] > 0.9 * distinct["ply"], "coordinates of glb are too coarse"


def test_a_far_camera_sees_as_far_as_the_region(tmp_path: Path) -> None:
    given = write_set(tmp_path / "set", one_far(), develop=over_white)
    views = run(given, tmp_path / "w.nerf", *NORMALISED).read("scene.json")["views"]
    distance = np.linalg.norm(np.array([view["scene_from_camera"] for view in views])[:, :, 3], axis=1)
    assert distance.max() > 500 * np.median(distance)
    for view, away in zip(views, distance, strict=True):
        assert 0 < view["near"] < away < view["far"]


@pytest.mark.parametrize("offset", [(0, 0, 0), UTM])
def test_cameras_in_one_place_are_refused(offset: tuple[float, ...], tmp_path: Path) -> None:
    told = RING.copy()
    told[:, :, 3] = RING[0, :, 3] + offset
    done = run(write_set(tmp_path / "set", told=told), tmp_path / "w.nerf")
    assert (done.code, done.error_code) == (12, "normalise.no-scale")
    assert "--normalise.roi" in done.error[2]


def test_places_too_far_from_the_origin_for_numbers_are_refused(tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", told=moved(RING, 1, (1e15, 0, 0))), tmp_path / "w.nerf")
    assert (done.code, done.error_code) == (12, "normalise.no-scale")
    assert "1e+15" in done.error[1]


def test_a_scene_too_small_for_numbers_is_refused(tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", told=moved(RING, 1e-40)), tmp_path / "w.nerf")
    assert (done.code, done.error[1].split()[-1]) == (12, "1e-30")


def test_three_photos_of_which_one_is_held_out(tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", RING[::4]), tmp_path / "w.nerf", *EVALUATED)
    assert done.code == 0
    metrics = done.read("metrics.json")
    assert (metrics["photos_test"], metrics["psnr_interval"]) == (1, None)
    assert 8 < metrics["psnr"] < 40
    assert metrics["verdict"].startswith("Unusable") == (metrics["psnr"] <= metrics["psnr_mean_image"])


@pytest.mark.parametrize(
    ("photos", "code", "what"),
    [(1, 10, "there is only one photo"), (2, 12, "only 2 registered photos")],
)
def test_too_few_photos_are_refused(photos: int, code: int, what: str, tmp_path: Path) -> None:
    done = run(write_set(tmp_path / "set", RING[:photos]), tmp_path / "w.nerf")
    assert (done.code, done.error[0]) == (code, what)
