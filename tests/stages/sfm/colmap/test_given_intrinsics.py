"""Given intrinsics turn and scale with photos of other sizes."""

from pathlib import Path

import pycolmap
import pytest

from nerf.geometry.scene import Camera
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import turned_camera
from stages.sfm.colmap.database.images import fill_database
from stages.sfm.colmap.given_intrinsics import given_intrinsics

W, H = 400, 300
PARAMS = (350.0, 352.0, 205.0, 148.0, -0.1, 0.03, 0.001, -0.002)
OWN = Camera("OPENCV", W, H, PARAMS)


def photo(name: str, width: int, height: int, orientation: int = 1) -> Photo:
    return Photo(name, f"images/{name}", width, height, 0, None, None, False, 1.0, orientation=orientation)


@pytest.mark.parametrize(
    ("orientation", "size", "turns"),
    [(6, (H, W), 1), (8, (H, W), 3), (3, (W, H), 2), (1, (H, W), 1), (2, (W, H), 0)],
    ids=["upright", "upside down", "half a turn", "without EXIF", "mirrored"],
)
def test_parameters_turn_with_photos_held_another_way(orientation: int, size: tuple[int, int], turns: int) -> None:
    photos = [photo("a", W, H), photo("b", *size, orientation), photo("c", W, H)]
    assert given_intrinsics(photos, "OPENCV", PARAMS) == [OWN, turned_camera(OWN, turns), OWN]


def test_parameters_of_upright_photos_turn_back() -> None:
    upright = turned_camera(OWN, 1)
    photos = [photo("a", W, H), photo("b", H, W, 6), photo("c", H, W, 6)]
    assert given_intrinsics(photos, "OPENCV", upright.params) == [turned_camera(upright, 3), upright, upright]


def test_parameters_of_stored_pixels_turn_with_upright_photos() -> None:
    assert given_intrinsics([photo("a", H, W, 6)] * 3, "OPENCV", PARAMS) == [turned_camera(OWN, 1)] * 3


def test_parameters_scale_and_other_shapes_have_none() -> None:
    photos = [photo("a", W, H), photo("b", W // 2, H // 2), photo("c", H // 2, W // 2, 6), photo("d", W, 225)]
    own, half, turned, other = given_intrinsics(photos, "SIMPLE_RADIAL", (350.0, 205.0, 148.0, -0.1))
    assert own and own.params == (350, 205, 148, -0.1)
    assert half and half.params == (175, 102.5, 74, -0.1)
    assert turned and turned.params == (175, 76, 102.5, -0.1)
    assert other is None


def test_parameters_of_no_size_of_several_have_no_photo() -> None:
    photos = [photo("a", W, H), photo("b", H, W)]
    assert given_intrinsics(photos, "SIMPLE_PINHOLE", (350.0, 100.0, 75.0)) == [None, None]
    assert given_intrinsics(photos[:1], "SIMPLE_PINHOLE", (350.0, 100.0, 75.0)) != [None], "a crop is off the centre"


def test_each_way_of_holding_is_a_known_camera(tmp_path: Path) -> None:
    photos = [photo("a", W, H), photo("b", H, W, 6), photo("c", W, H)]
    fill_database(tmp_path / "a.db", photos, "OPENCV", PARAMS)
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        cameras, images = {c.camera_id: c for c in db.read_all_cameras()}, db.read_all_images()
    assert [cameras[i.camera_id].width for i in sorted(images, key=lambda i: i.name)] == [W, H, W]
    assert len(cameras) == 2 and all(c.has_prior_focal_length for c in cameras.values())
