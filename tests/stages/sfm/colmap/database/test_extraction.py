from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from stages.hardware import cluster
from stages.ingest.orientation import QUARTER_TURNS, turned_size, upright
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.colmap.database import extraction
from stages.sfm.colmap.database.extraction import MIN_FEATURES_SHARE, ExtractionOptions, extract_features, on_sensor
from stages.sfm.colmap.database.images import fill_database, turns_of_cameras

HELD = 1, 6, 3, 8  # EXIF's orientations that no mirror takes part in


def pictures(folder: Path, busy: int, plain: int) -> list[Photo]:
    """So many photos of 480 × 360 with large discs on grey, which are features of their own size, and with small faint
    ones, few of which are."""
    random, photos = np.random.default_rng(0), []
    v, u = np.mgrid[:360, :480]
    for number in range(busy + plain):
        sigma, contrast = (3.0, 90.0) if number < busy else (1.5, 40.0)
        light = np.full((360, 480), 100.0)
        for x, y in random.uniform((10, 10), (470, 350), (300, 2)):
            light += contrast * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
        name = f"{number}.png"
        Image.fromarray(light.clip(0, 255).astype(np.uint8)).convert("RGB").save(folder / name)
        photos.append(Photo(name, f"images/{name}", 480, 360, 0, None, None, False, 1.0))
    return photos


ASKED = ExtractionOptions(max_image_size=480, max_features=400, doubled_up_to=240)


def features_of(folder: Path, photos: list[Photo], name: str) -> list[np.ndarray]:
    """The keypoints of each photo, in a database of this name, which goes on where there is one."""
    database = folder / f"{name}.db"
    fill_database(database, photos, "SIMPLE_RADIAL")
    extract_features(database, folder, photos, ASKED)
    with pycolmap.Database.open(database) as db:
        ids = range(1, len(photos) + 1)
        assert all(db.num_descriptors_for_image(i) == db.num_keypoints_for_image(i) for i in ids)
        return [np.array(db.read_keypoints(i), float).reshape(-1, 6) for i in ids]


@pytest.mark.parametrize(("busy", "plain", "enlarged"), [(2, 1, False), (1, 2, True)])
def test_photos_are_enlarged_where_most_yield_few_features(
    busy: int, plain: int, enlarged: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = pictures(tmp_path, busy, plain)
    found = features_of(tmp_path, photos, "found")
    monkeypatch.setattr(extraction, "MIN_FEATURES_SHARE", 0.0)
    own_size = features_of(tmp_path, photos, "own-size")
    if enlarged:
        assert all(len(own) < 100 < 400 < len(more) for own, more in zip(own_size[busy:], found[busy:], strict=True))
    else:
        assert all(np.array_equal(own, same) for own, same in zip(own_size, found, strict=True))


def test_contrast_is_made_even_where_most_photos_are_faint(tmp_path: Path) -> None:
    photos = pictures(tmp_path, 3, 0)
    clear = features_of(tmp_path, photos, "clear")
    for photo in photos:  # as through fog: a twentieth of the contrast
        light = np.asarray(Image.open(tmp_path / photo.name), float)
        Image.fromarray(np.rint(180 + (light - 100) / 20).astype(np.uint8)).save(tmp_path / photo.name)
    chosen: list[tuple[float, ExtractionOptions]] = []
    database = tmp_path / "faint.db"
    fill_database(database, photos, "SIMPLE_RADIAL")
    extract_features(database, tmp_path, photos, ASKED, lambda *few: chosen.append(few))
    assert chosen == [(0.0, ASKED._replace(even_contrast=True))]
    with pycolmap.Database.open(database) as db:
        for number, there in enumerate(clear, 1):
            found = np.array(db.read_keypoints(number), float)
            nearest = np.linalg.norm(found[:, None, :2] - there[:, :2], axis=2).min(axis=0)
            assert (nearest < 1.5).mean() > 0.6  # of blobs upon blobs others are found


def test_only_the_seconds_of_the_chosen_way_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = pictures(tmp_path, 1, 2)
    monkeypatch.setattr(extraction, "time", SimpleNamespace(monotonic=partial(next, count())))
    fill_database(tmp_path / "timed.db", photos, "SIMPLE_RADIAL")
    chosen: list[tuple[float, ExtractionOptions]] = []
    took = extract_features(tmp_path / "timed.db", tmp_path, photos, ASKED, lambda *few: chosen.append(few))
    assert len(chosen) == 1 and took == 2  # on some photos and on all, each from one reading of the clock to the next


def test_clear_photos_of_few_features_keep_their_contrast(tmp_path: Path) -> None:
    photos, chosen = pictures(tmp_path, 3, 0), list[tuple[float, ExtractionOptions]]()
    small = ASKED._replace(max_features=8000, doubled_up_to=480)
    fill_database(tmp_path / "small.db", photos, "SIMPLE_RADIAL")
    extract_features(tmp_path / "small.db", tmp_path, photos, small, lambda *few: chosen.append(few))
    assert chosen == []
    with pycolmap.Database.open(tmp_path / "small.db") as db:
        assert 0 < db.num_keypoints_for_image(1) < MIN_FEATURES_SHARE * small.max_features


def test_a_cluster_extracts_the_same_features(
    tmp_path: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos, masks = pictures(tmp_path, 4, 0), tmp_path / "masks"
    masks.mkdir()
    Image.fromarray(np.repeat(np.array([0, 255], np.uint8), 240)[None].repeat(360, 0)).save(masks / "1.png.png")
    monkeypatch.setattr(extraction, "COUNTED_PHOTOS", 1)

    def extracted(name: str) -> list[bytes]:
        database = tmp_path / f"{name}.db"
        fill_database(database, photos, "SIMPLE_RADIAL")
        extract_features(database, tmp_path, photos, ASKED._replace(masks=masks))
        with pycolmap.Database.open(database) as db:
            return [
                db.read_keypoints(i).tobytes() + np.array(db.read_descriptors(i).data).tobytes() for i in range(1, 5)
            ]

    here = extracted("here")
    with cluster.joined(ray_cluster):
        assert extracted("there") == here
    assert 0 < len(here[1]) < len(here[0]), "masked"


def test_extraction_that_was_interrupted_goes_on(tmp_path: Path) -> None:
    photos = pictures(tmp_path, 2, 0)
    whole = features_of(tmp_path, photos, "whole")
    fill_database(tmp_path / "again.db", photos, "SIMPLE_RADIAL")
    kind = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(tmp_path / "again.db") as db:  # the first photo is done, with features of its own
        db.write_keypoints(1, np.ones((3, 6), np.float32))
        db.write_descriptors(1, pycolmap.FeatureDescriptors(data=np.ones((3, 128), np.uint8), type=kind))
    done, other = features_of(tmp_path, photos, "again")
    assert len(done) == 3
    np.testing.assert_array_equal(other, whole[1])


def held(photo: Photo, orientation: int) -> Photo:
    """The photo after its camera was turned."""
    width, height = turned_size((photo.width, photo.height), orientation)
    return replace(photo, width=width, height=height, orientation=orientation)


@pytest.mark.parametrize("orientation", HELD)
def test_keypoints_go_back_to_where_the_sensor_has_them(orientation: int) -> None:
    random, turns = np.random.default_rng(0), QUARTER_TURNS[orientation]
    photo = held(Photo("a", "images/a", 60, 40, 0, None, None, False, 1.0), orientation)
    stored = np.concatenate([random.uniform(0, 40, (9, 2)), random.normal(size=(9, 4))], axis=1)
    turn = pixel_map((60, 40), turns, photo.width, photo.height)
    seen = stored.copy()
    seen[:, :2] = stored[:, :2] @ turn[:, :2].T + turn[:, 2]
    seen[:, 2:] = (turn[:, :2] @ stored[:, 2:].reshape(-1, 2, 2)).reshape(-1, 4)
    np.testing.assert_allclose(on_sensor(seen, photo, turns), stored, atol=1e-12)


@pytest.mark.parametrize("on_cluster", [False, True])
def test_features_of_a_turned_photo_are_those_of_its_sensor(
    on_cluster: bool, tmp_path: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extraction, "COUNTED_PHOTOS", 1)
    photos = pictures(tmp_path, 4, 0)
    stored = features_of(tmp_path, photos, "stored")
    photos = [held(photo, orientation) for photo, orientation in zip(photos, HELD, strict=True)]
    for photo in photos:
        with Image.open(tmp_path / photo.name) as picture:
            turned = upright(picture.copy(), photo.orientation)
        turned.save(tmp_path / photo.name)
    database, turns = tmp_path / "turned.db", turns_of_cameras(photos)
    assert list(turns.values()) == [1, 2, 3]
    fill_database(database, photos, "SIMPLE_RADIAL", turns=turns)
    with cluster.joined(ray_cluster if on_cluster else None):
        extract_features(database, tmp_path, photos, ASKED, turns=turns)
    with pycolmap.Database.open(database) as db:
        (camera,) = db.read_all_cameras()
        assert (camera.width, camera.height) == (480, 360)
        for number, here in enumerate(stored, 1):
            there = np.array(db.read_keypoints(number), float).reshape(-1, 6)
            nearest = np.linalg.norm(there[:, None, :2] - here[:, :2], axis=2).min(axis=0)
            assert np.median(nearest) < 0.05 and (nearest < 0.5).mean() > 0.85  # the weakest are others
            assert db.num_descriptors_for_image(number) == len(there)


def test_upright_photos_of_a_turned_camera_have_their_own(tmp_path: Path) -> None:
    photos = [
        held(photo, orientation) for photo, orientation in zip(pictures(tmp_path, 4, 0), (1, 1, 6, 6), strict=True)
    ]
    fill_database(tmp_path / "upright.db", photos, "SIMPLE_RADIAL")
    with pycolmap.Database.open(tmp_path / "upright.db") as db:
        assert sorted((camera.width, camera.height) for camera in db.read_all_cameras()) == [(360, 480), (480, 360)]
        assert len({db.read_image(number).camera_id for number in (1, 2)}) == 1


def test_photos_that_are_all_held_alike_stay_upright(tmp_path: Path) -> None:
    assert turns_of_cameras([held(photo, 6) for photo in pictures(tmp_path, 3, 0)]) == {}
