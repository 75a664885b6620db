"""Matching into COLMAP's database, on features that a synthetic scene of points would have."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from threading import get_ident
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image

import stages.sfm.colmap.database.extraction as database_module
from stages.hardware import cluster
from stages.ingest.orientation import QUARTER_TURNS, turned_size, upright
from stages.io.photos import Photo
from stages.sfm.colmap.cameras import pixel_map
from stages.sfm.colmap.database.extraction import (
    MIN_FEATURES_SHARE,
    ExtractionOptions,
    Features,
    extract_features,
    fill_database,
    image_similarity,
    keep_open,
    match_pairs,
    on_sensor,
    turns_of_cameras,
    verify_again,
)
from stages.sfm.colmap.diagnosis import links
from stages.sfm.pairs.pair_selection import exhaustive
from tests.stages.sfm.pairs.test_feature_matching import random_descriptors

COUNT = 6
PAIRS = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Six photos by a camera that moves sideways along a cloud of points; the last one sees another cloud."""
    path, random = tmp_path / "matches.db", np.random.default_rng(0)
    photos = [Photo(f"{i}.png", f"images/{i}.png", 320, 240, 0, None, None, False, 1.0) for i in range(COUNT)]
    fill_database(path, photos, "SIMPLE_RADIAL")
    points = random.uniform((-3, -1, 3), (3, 1, 6), (400, 3))
    alike = random_descriptors(400, 0)
    with pycolmap.Database.open(path) as db:
        for photo in range(COUNT):
            seen = points - np.array([0.3 * photo - 0.75, 0, 0])
            places = 300 * seen[:, :2] / seen[:, 2:] + (160, 120) + random.normal(scale=0.3, size=(400, 2))
            inside = ((places > 0) & (places < (320, 240))).all(axis=1)
            noisy = alike if photo < COUNT - 1 else random_descriptors(400, 1)
            noisy = np.rint(noisy + random.normal(scale=8, size=(400, 128))).clip(0, 255).astype(np.uint8)
            shapes = np.tile([1, 0, 0, 1], (int(inside.sum()), 1))
            db.write_keypoints(photo + 1, np.hstack([places[inside], shapes]).astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(photo + 1, pycolmap.FeatureDescriptors(data=noisy[inside], type=kind))
    return path


def copy_of(database: Path, name: str) -> Path:
    copy = database.with_name(name)
    for part in ("", "-wal", "-shm"):
        if (source := database.with_name(database.name + part)).exists():
            copy.with_name(copy.name + part).write_bytes(source.read_bytes())
    return copy


def found(database: Path) -> dict[tuple[int, int], tuple[bytes, bytes, int]]:
    """Matches, verified matches and kind of geometry of every pair that was tried."""
    result = {}
    with pycolmap.Database.open(database) as db:
        for i, j in PAIRS:
            if db.exists_two_view_geometry(i + 1, j + 1):
                geometry = db.read_two_view_geometry(i + 1, j + 1)
                verified = geometry.inlier_matches.tobytes()
                result[i, j] = db.read_matches(i + 1, j + 1).tobytes(), verified, int(geometry.config)
    return result


def test_a_list_of_pairs_gives_what_all_pairs_give(database: Path) -> None:
    some = np.array([[0, 1], [1, 4], [2, 3], [0, 5]])
    everything, listed = copy_of(database, "all.db"), copy_of(database, "some.db")
    match_pairs(everything, exhaustive(COUNT), 0, 0.8)
    match_pairs(listed, some, 0, 0.8)
    every = found(everything)
    assert list(every) == PAIRS
    assert found(listed) == {pair: every[pair] for pair in map(tuple, some.tolist())}
    verified = {pair: len(inliers) // 8 for pair, (_, inliers, _) in every.items()}
    assert all(verified[i, i + 1] > 50 for i in range(COUNT - 2))
    assert all(verified[i, COUNT - 1] == 0 for i in range(COUNT - 1)), "too few matches are no geometry"


def test_verified_matches_are_those_of_colmaps_own_verification(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    ours = found(database)
    with pycolmap.Database.open(database) as db:
        for i, j in PAIRS:
            db.delete_two_view_geometry(i + 1, j + 1)
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{i}.png {j}.png\n" for i, j in PAIRS))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    pycolmap.verify_matches(database, listed, options)
    theirs = found(database)
    assert {pair: rest for pair, (_, *rest) in ours.items()} == {pair: rest for pair, (_, *rest) in theirs.items()}


def test_the_number_of_cores_changes_nothing(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for cores in (1, 4):
        monkeypatch.setattr(database_module, "processors", lambda cores=cores: cores)
        copy = copy_of(database, f"{cores}.db")
        match_pairs(copy, exhaustive(COUNT), 0, 0.8)
        results.append(found(copy))
    assert results[0] == results[1]


def verified_again(database: Path) -> dict[tuple[int, int], tuple[bytes, bytes, int]]:
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        verify_again(db, seed=0)
    return found(database)


@pytest.mark.parametrize("cores", [1, 2, 4])
def test_verifying_again_gives_the_same_on_any_number_of_cores(
    cores: int, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    before, threads, real = found(database), set(), database_module._verified
    monkeypatch.setattr(database_module, "BLOCK_SIZE", 4)
    monkeypatch.setattr(database_module, "processors", lambda: cores)
    monkeypatch.setattr(database_module, "_verified", lambda *args: threads.add(get_ident()) or real(*args))
    assert verified_again(database) == before and list(before) == PAIRS
    assert get_ident() not in threads and len(threads) <= cores
    with pycolmap.Database.open(database) as db:
        camera = db.read_camera(1)
        camera.params = [3 * camera.params[0], *camera.params[1:]]
        camera.has_prior_focal_length = True
        db.update_camera(camera)
    monkeypatch.setattr(database_module, "_on_own_cores", lambda _, work, blocks: map(work, blocks))
    alone = verified_again(copy_of(database, "alone.db"))
    monkeypatch.undo()
    assert verified_again(database) == alone != before


def test_a_cluster_verifies_the_same(database: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    before = found(database)
    monkeypatch.setattr(database_module, "_on_own_cores", lambda *_: pytest.fail("verified here"))
    with cluster.joined(ray_cluster):
        assert verified_again(database) == before


@pytest.mark.parametrize(("least", "free_bytes", "read"), [(2, 0, 12), (2, 1e9, 6), (6, 0, 6)])
def test_features_stay_in_memory_as_long_as_there_is_room(
    least: int, free_bytes: float, read: int, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = np.random.default_rng(1).integers(0, 60, (8, 128)).astype(np.float32)
    monkeypatch.setattr(database_module, "MIN_CACHED_PHOTOS", least)
    monkeypatch.setattr(database_module, "available_bytes", lambda: free_bytes)
    indexed, real = [], database_module.index_features
    monkeypatch.setattr(database_module, "index_features", lambda *args: indexed.append(args) or real(*args))
    features = Features(words)
    with pycolmap.Database.open(database) as db:
        for photo in [*range(COUNT), *range(COUNT)]:
            assert len(features.read(db, photo)().keypoints) > 200
    assert len(indexed) == read


def test_the_bytes_of_features_are_counted(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_module, "MIN_CACHED_PHOTOS", 1)
    each = 400 * (128 + 2 * 8)  # at most: not all points are in all photos
    monkeypatch.setattr(database_module, "available_bytes", lambda: 3 * each / database_module.CACHE_SHARE)
    features, opened = Features(), []
    real = database_module.read_descriptors
    monkeypatch.setattr(database_module, "read_descriptors", lambda db, photo: opened.append(photo) or real(db, photo))
    with pycolmap.Database.open(database) as db:
        for photo in (0, 1, 2, 0, 3, 4, 0, 1):
            features.read(db, photo)
    assert opened == [0, 1, 2, 3, 4, 1]


@pytest.mark.parametrize("words", [None, np.random.default_rng(1).integers(0, 60, (8, 128)).astype(np.float32)])
def test_a_cluster_finds_the_same_matches(
    words: np.ndarray | None, database: Path, ray_cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database_module, "BLOCK_SIZE", 4)
    here = copy_of(database, "here.db")
    match_pairs(here, exhaustive(COUNT), 0, 0.8, features=Features(words))
    monkeypatch.setattr(database_module, "_on_own_cores", lambda *_: pytest.fail("matched here"))
    with cluster.joined(ray_cluster):
        match_pairs(database, exhaustive(COUNT), 0, 0.8, features=Features(words))
    assert list(found(here)) == PAIRS and found(database) == found(here)


def test_only_what_is_missing_is_matched(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = copy_of(database, "whole.db")
    match_pairs(whole, exhaustive(COUNT), 0, 0.8)
    match_pairs(database, exhaustive(COUNT)[::2], 0, 0.8)
    told, tried, real = [], [], database_module._match
    monkeypatch.setattr(database_module, "_match", lambda *args: tried.append(args) or real(*args))
    match_pairs(database, exhaustive(COUNT), 0, 0.8, lambda pairs, seconds: told.append((pairs, seconds)))
    assert len(tried) == 7  # 8 of 15 were there
    assert [pairs for pairs, _ in told] == [7] and told[0][1] > 0
    assert found(database) == found(whole)
    match_pairs(database, exhaustive(COUNT), 0, 0.8, lambda pairs, seconds: told.append((pairs, seconds)))
    assert len(tried) == 7 and len(told) == 1


def test_the_first_block_is_spread_over_all_pairs() -> None:
    pairs = [(i, j) for i in range(40) for j in range(i + 1, 40)]
    order = database_module._spread(pairs)
    assert sorted(order) == pairs
    firsts = [i for i, _ in order[: database_module.BLOCK_SIZE]]
    assert min(firsts) == 0 and max(firsts) > 30
    assert database_module._spread([]) == []


def test_photos_of_the_same_points_look_alike(database: Path) -> None:
    alike = image_similarity(database, COUNT, seed=0)
    assert alike.shape == (COUNT, COUNT)
    assert alike[:-1, -1].max() < alike[:-1, :-1].min()


def test_unregistered_photos_are_joined_by_their_matches(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    names = [f"{i}.png" for i in range(COUNT)]
    assert links(database, set(names[:-2])).join
    assert not links(database, set(names[:-1])).join
    assert not links(database, {names[-1]}).join, "five that share views with each other alone"
    assert links(database, set()).join, "none is registered: any pair may be the initial one"


def test_few_matches_with_each_of_several_photos_join_as_well(database: Path) -> None:
    match_pairs(database, exhaustive(COUNT), 0, 0.8)
    placed = {f"{i}.png" for i in range(COUNT - 1)}
    for photo, expected in ((1, False), (2, True)):
        with pycolmap.Database.open(database) as db:
            db.delete_two_view_geometry(photo, COUNT)
            few = pycolmap.TwoViewGeometry(inlier_matches=np.tile(np.arange(20, dtype=np.uint32)[:, None], 2), config=2)
            db.write_two_view_geometry(photo, COUNT, few)
        assert links(database, placed).join == expected


READER = """
import sys
from pathlib import Path
from stages.sfm.registration import count_done
print("ready", flush=True)
while True:
    count_done(Path(sys.argv[1]))
"""


def test_an_open_database_can_be_read_along(database: Path) -> None:
    reader = subprocess.Popen(
        [sys.executable, "-c", READER, str(database)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[5]
    )
    try:
        assert reader.stdout and reader.stdout.readline() == b"ready\n"
        held = keep_open(database)
        for _ in range(500):  # without it one in ten or twenty fails
            with pycolmap.Database.open(database) as db:
                assert db.num_images() == COUNT
        held.close()
    finally:
        reader.kill()
        reader.wait()


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
    monkeypatch.setattr(database_module, "MIN_FEATURES_SHARE", 0.0)
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
    monkeypatch.setattr(database_module, "time", SimpleNamespace(monotonic=partial(next, count())))
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
    monkeypatch.setattr(database_module, "COUNTED_PHOTOS", 1)

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


HELD = 1, 6, 3, 8  # EXIF's orientations that no mirror takes part in


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
    monkeypatch.setattr(database_module, "COUNTED_PHOTOS", 1)
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
