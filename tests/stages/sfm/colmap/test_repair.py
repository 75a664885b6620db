"""COLMAP's synthetic matches and models, with known poses: check, repair, thinned matches, global mapping."""

import sqlite3
from collections.abc import Container
from contextlib import closing
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest
from PIL import Image

from stages.io.photos import Photo
from stages.sfm import global_mapping
from stages.sfm.checked_mapping import Runs, _most_steps, _with_pieces_joined
from stages.sfm.colmap.adjustment.bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.database.copies import copy_without_pairs
from stages.sfm.colmap.database.images import adopt_cameras
from stages.sfm.colmap.database.thinning import thin_matches
from stages.sfm.colmap.diagnosis import compare_models
from stages.sfm.colmap.mappers import incremental_options, map_incrementally
from stages.sfm.colmap.model_check import (
    Candidate,
    agreeing_pairs,
    better,
    check_model,
    facts,
    reasons,
    supported_runs,
    supported_steps,
)
from stages.sfm.colmap.repair import (
    copy_consistent_matches,
    deregister,
    drop_outside_main_segment,
    register_again,
    restricted,
)
from stages.sfm.matching import consecutive_pairs
from stages.sfm.retry_strategies import MappingOptions

PHOTOS, FOCAL_PX = 16, 1280.0


class Made(NamedTuple):
    database: Path
    model: Any


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Photos around 400 points, all matched with each other, half a pixel of noise; a model with the true poses."""
    return make(tmp_path)


def make(folder: Path, points: int = 400, cameras: int = 1) -> Made:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=cameras, num_frames_per_rig=PHOTOS // cameras, num_points3D=points, num_points2D_without_point3D=20
    )
    database = folder / "made.db"
    with pycolmap.Database.open(database) as db:
        model = pycolmap.synthesize_dataset(options, db)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model, db)
    return Made(database, model)


def turn(model: Any, image_id: int, degrees: float) -> None:
    """Turn a registered photo where it stands."""
    image = model.image(image_id)
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.radians([0.0, degrees, 0.0])), np.zeros(3))
    frame = model.frame(image.frame_id)
    frame.rig_from_world = turned * frame.rig_from_world


def test_true_poses_pass(made: Made) -> None:
    checked = check_model(made.model, made.database, 0)
    assert checked.check.passed.all() and not checked.failed() and not reasons(made.model, checked)
    said = facts(made.model, checked)
    assert said["doubtful"] == [] and said["pairs"] == said["agreeing"] == PHOTOS * (PHOTOS - 1) / 2
    assert 0.3 < said["error_px"] < 1.5
    assert {image["agreement"] for image in said["images"].values()} == {1.0}


def test_a_model_that_is_wrong_as_a_whole_loses(made: Made) -> None:
    """Its own tolerance is that of its errors: alone it would nearly pass."""
    wrong = pycolmap.Reconstruction(made.model)
    for image_id in range(1, PHOTOS + 1):
        turn(wrong, image_id, 0.15 * (-1) ** image_id)
    candidates = [Candidate(model, check_model(model, made.database, 0)) for model in (wrong, made.model)]
    assert candidates[0][1].check.tolerance_px > 1.5 * candidates[1][1].check.tolerance_px
    assert candidates[0][1].check.passed.sum() > PHOTOS / 2
    assert better(*candidates) is better(*candidates[::-1]) is candidates[1]
    pairs, wrong_pairs = agreeing_pairs(candidates[1], candidates[0], [made.model.image(5).name])
    assert wrong_pairs < pairs == PHOTOS - 1
    noise = candidates[0][1].matches.noise_px  # of the matches, whatever the poses
    assert 0.1 < noise < 0.6 and noise == candidates[1][1].matches.noise_px


def test_of_models_that_agree_as_well_the_first_is_taken(made: Made) -> None:
    same = pycolmap.Reconstruction(made.model)
    candidates = [Candidate(model, check_model(model, made.database, 0)) for model in (made.model, same)]
    assert better(*candidates) is candidates[0] and better(*candidates[::-1]) is candidates[1]


def test_a_turned_photo_is_named_and_registered_again(made: Made, tmp_path: Path) -> None:
    wrong = turned_alone(made, 5)
    checked = check_model(wrong, made.database, 0)
    assert checked.failed() == [5]
    assert list(reasons(wrong, checked)) == [wrong.image(5).name]
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=False)
    again = register_again(wrong, checked, made.database, tmp_path, tmp_path / "again", options)
    assert again.num_reg_images() == PHOTOS
    assert check_model(again, made.database, 0).check.passed.all()
    compared = compare_models(made.model, again)
    assert compared["agree"] == PHOTOS and compared["degrees"] < 0.2
    assert not (tmp_path / "again").exists()


def test_a_wholly_mismatched_photo_is_excluded_with_a_reason(made: Made) -> None:
    """Ten in a hundred photos with injected matches: here photo 5 has keypoints of others' points."""
    mismatch(made.database, {pair for pair in combinations(range(1, PHOTOS + 1), 2) if 5 in pair})
    checked = check_model(made.model, made.database, 0)
    assert checked.failed() == [5]
    (reason,) = reasons(made.model, checked).values()
    assert reason.code == "sfm.unregistered-misplaced" and reason.text.count("6,000") == 2
    deregister(made.model, checked.failed())
    assert made.model.num_reg_images() == PHOTOS - 1
    assert check_model(made.model, made.database, 0).check.passed.all()


def mismatch(database: Path, pairs: Container[tuple[int, int]]) -> None:
    """Let the matches of these pairs join keypoints of different points."""
    random = np.random.default_rng(0)
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            if (pair := pycolmap.pair_id_to_image_pair(pair_id)) in pairs:
                matches = np.array(geometry.inlier_matches)
                matches[:, 1] = random.permutation(matches[:, 1])
                geometry.inlier_matches = matches
                db.delete_two_view_geometry(*pair)
                db.write_two_view_geometry(*pair, geometry)


def test_mapping_of_thinned_matches_finds_the_same_cameras(tmp_path: Path) -> None:
    made = make(tmp_path, points=1000)
    thinned = tmp_path / "thinned.db"
    thin_matches(made.database, thinned, tracks=30)
    with pycolmap.Database.open(made.database) as db, pycolmap.Database.open(thinned) as few:
        before, after = db.num_inlier_matches(), few.num_inlier_matches()
    assert 0 < after < 0.6 * before
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True)
    (model,) = map_incrementally(thinned, tmp_path, tmp_path / "models", options)
    compared = compare_models(made.model, model)
    assert compared["agree"] == PHOTOS and 0 < compared["centre"] < 0.01
    assert check_model(model, made.database, 0).check.passed.all()


def test_points_of_thinned_matches_are_coloured_in_the_end(tmp_path: Path) -> None:
    made, random = make(tmp_path), np.random.default_rng(0)
    camera = made.model.camera(1)
    for image in made.model.images.values():
        spots = Image.fromarray(random.integers(1, 255, (9, 12, 3), dtype=np.uint8))
        spots.resize((camera.width, camera.height)).save(tmp_path / image.name)

    def mapped(coloured: bool) -> pycolmap.Reconstruction:
        options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=not coloured)
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3  # what else thinned matches change
        options.ba_global_max_refinements = 2
        return map_incrementally(made.database, tmp_path, tmp_path / "models", options)[0]

    def points(model: pycolmap.Reconstruction) -> bytes:
        model.write_binary(tmp_path)
        return (tmp_path / "points3D.bin").read_bytes()

    plain, coloured = mapped(False), mapped(True)
    assert not any(point.color.any() for point in plain.points3D.values())
    assert all(point.color.any() for point in coloured.points3D.values())
    for model in (plain, coloured):
        model.extract_colors_for_all_images(tmp_path)
    assert all(point.color.any() for point in plain.points3D.values())
    assert points(plain) == points(coloured)


def test_focal_lengths_are_held_while_mapping_and_then_released(tmp_path: Path) -> None:
    made = make(tmp_path, points=1000)
    set_focal_length(made.database, 1.1 * FOCAL_PX, by_exif=True)
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True, hold_focal=True)
    (model,) = map_incrementally(made.database, tmp_path, tmp_path / "models", options)
    assert model.camera(1).mean_focal_length() == 1.1 * FOCAL_PX and model.num_reg_images() == PHOTOS
    release_focal_lengths(model)
    assert abs(model.camera(1).mean_focal_length() / FOCAL_PX - 1) < 0.01
    assert check_model(model, made.database, 0).check.passed.all()


@pytest.mark.parametrize("ratio", [0.5, 0.9, 1.2, 2.0])
@pytest.mark.parametrize("by_exif", [True, False])
def test_focal_lengths_are_calibrated_where_exif_is_far_off(tmp_path: Path, ratio: float, by_exif: bool) -> None:
    made = make(tmp_path)
    look_apart(made)
    set_focal_length(made.database, ratio * FOCAL_PX, by_exif=by_exif)
    assert thin_matches(made.database, tmp_path / "thinned.db") and not list(tmp_path.glob("*calibration*"))
    found = focal_length(tmp_path / "thinned.db") / FOCAL_PX
    assert found == ratio if by_exif and 0.8 < ratio < 1.3 else abs(found - 1) < 0.1


@pytest.mark.parametrize("by_exif", [True, False])
def test_photos_whose_axes_meet_calibrate_nothing(tmp_path: Path, by_exif: bool) -> None:
    made = make(tmp_path)
    set_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=by_exif)
    assert not thin_matches(made.database, tmp_path / "thinned.db")
    assert focal_length(tmp_path / "thinned.db") == 0.5 * FOCAL_PX


def test_known_cameras_and_fisheyes_are_not_calibrated(tmp_path: Path) -> None:
    made = make(tmp_path)
    look_apart(made)
    set_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=True)
    assert not thin_matches(made.database, tmp_path / "known.db", camera_is_known=True)
    set_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=True, model="OPENCV_FISHEYE")
    assert not thin_matches(made.database, tmp_path / "fisheye.db")
    assert focal_length(tmp_path / "known.db") == focal_length(tmp_path / "fisheye.db") == 0.5 * FOCAL_PX


def look_apart(made: Made) -> None:
    """Turn the photos so that their axes do not meet, with the keypoints and matches that they then have."""
    random = np.random.default_rng(0)
    for image_id in range(1, PHOTOS + 1):
        turn(made.model, image_id, random.uniform(-15, 15))
    with pycolmap.Database.open(made.database) as db, pycolmap.DatabaseTransaction(db):
        camera, keypoints = made.model.camera(1), {}
        for image_id in range(1, PHOTOS + 1):
            image = made.model.image(image_id)
            seen = [point.point3D_id if point.has_point3D() else None for point in image.points2D]
            projected = [None if one is None else image.project_point(made.model.point3D(one).xyz) for one in seen]
            keypoints[image_id] = np.array([(-1.0, -1.0) if one is None else one for one in projected])
            db.update_keypoints(image_id, np.pad(keypoints[image_id], ((0, 0), (0, 4))))
        for pair_id, matches in zip(*db.read_all_matches(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            geometry = pycolmap.estimate_two_view_geometry(
                camera, keypoints[first], camera, keypoints[second], np.asarray(matches, np.uint32)
            )
            db.delete_two_view_geometry(first, second)
            db.write_two_view_geometry(first, second, geometry)


def set_focal_length(database: Path, focal_px: float, by_exif: bool, model: str | None = None) -> None:
    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        old = db.read_camera(1)
        name = model or old.model_name
        camera = pycolmap.Camera.create_from_model_name(1, name, focal_px, old.width, old.height)
        camera.has_prior_focal_length = by_exif
        db.update_camera(camera)


def focal_length(database: Path) -> float:
    with pycolmap.Database.open(database) as db:
        return db.read_camera(1).mean_focal_length()


def test_matches_consistent_with_trusted_pairs_are_kept(made: Made, tmp_path: Path) -> None:
    wrong = turned_alone(made, 5)
    photos = [Photo(f"{i:02}.jpg", f"images/{i:02}.jpg", 8, 8, 0, None, None, False, 1.0) for i in range(PHOTOS)]
    state: Any = SimpleNamespace(database=made.database, photos=photos)
    steps = consecutive_pairs(state)
    assert steps == {(i, i + 1) for i in range(1, PHOTOS)}
    copy = tmp_path / "consecutive.db"
    copy_consistent_matches(wrong, made.database, copy, {step for step in steps if 5 not in step} | {(4, 6)})
    assert verified_pairs(copy) == {pair for pair in combinations(range(1, PHOTOS + 1), 2) if 5 not in pair}
    copy_consistent_matches(wrong, made.database, copy, steps)  # trusted matches stay unless they are clearly off
    assert verified_pairs(copy) & {(4, 5), (5, 6)} == set()


def test_steps_are_judged_by_all_their_matches(made: Made, tmp_path: Path) -> None:
    wrong, steps = turned_alone(made, 5), {(i, i + 1) for i in range(1, PHOTOS)}
    copy = tmp_path / "consecutive.db"
    copy_consistent_matches(wrong, made.database, copy, steps)
    supported = supported_steps(wrong, made.database, steps)
    assert steps - supported == {(3, 4), (4, 5), (5, 6), (6, 7)}, "depths are in doubt a step farther"
    assert supported_runs(wrong, made.database, steps) == [[*range(7, 17)], [1, 2, 3], [4], [5], [6]]
    assert supported_runs(made.model, made.database, steps) == [[*range(1, PHOTOS + 1)]]
    checked = check_model(wrong, copy, 0)
    outside = drop_outside_main_segment(wrong, checked, [*range(1, PHOTOS + 1)], supported)
    failed = {wrong.image(image_id).name for image_id in checked.failed()}
    assert outside.keys() | failed == {wrong.image(image_id).name for image_id in range(1, 7)}


def test_joined_pieces_replace_models_that_have_nothing_else(made: Made) -> None:
    steps = {(i, i + 1) for i in range(1, PHOTOS)}
    state: Any = SimpleNamespace(database=made.database, job=SimpleNamespace(camera_params=None))
    models = [
        restricted(made.model, range(1, 10)),
        restricted(made.model, range(6, 15)),
        restricted(made.model, [1, 2, *range(12, 17)]),
    ]
    models[1].transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0.3, 1, 2])), np.array([1.0, 2, 3])))
    runs = [[*range(1, 10)]], [[*range(6, 15)]], [[*range(13, 17)], [1, 2], [12]]
    ranked = [Runs(*pair) for pair in zip(models, runs, strict=True)]
    joined, *others = _with_pieces_joined(ranked, state, steps)
    assert sorted(joined.reg_image_ids()) == [*range(1, 15)] and others == models[2:]
    assert supported_runs(joined, made.database, steps) == [[*range(1, 15)]]
    assert compare_models(made.model, joined)["agree"] == 14
    turn(models[1], 8, degrees=3.0)  # both have it
    assert _with_pieces_joined(ranked, state, steps) == models


def test_joined_pieces_have_to_hold_together(made: Made) -> None:
    """Pieces that agree are joined in vain where the matches of a step contradict it all the same."""
    steps = {(i, i + 1) for i in range(1, PHOTOS)}
    state: Any = SimpleNamespace(database=made.database, job=SimpleNamespace(camera_params=None))
    runs = [[*range(6, 17)], [*range(1, 11)]]
    models = [restricted(made.model, run) for run in runs]
    ranked = [Runs(model, [run]) for model, run in zip(models, runs, strict=True)]
    (joined,) = _with_pieces_joined(ranked, state, steps)
    assert joined.num_reg_images() == PHOTOS
    mismatch(made.database, {(8, 9)})
    assert _with_pieces_joined(ranked, state, steps) == models


def test_mapping_again_holds_the_cameras_of_the_longest_piece(made: Made, tmp_path: Path) -> None:
    steps, matches = {(i, i + 1) for i in range(1, PHOTOS)}, tmp_path / "matches.db"
    copy_without_pairs(made.database, matches, [])
    set_focal_length(matches, 0.9 * FOCAL_PX, by_exif=False)
    job = SimpleNamespace(camera_params=None, seed=0, folder=str(tmp_path))
    state: Any = SimpleNamespace(database=made.database, images=tmp_path, thinned=True, send=lambda **_: None, job=job)
    piece = restricted(made.model, range(1, 12))
    (model,) = _most_steps([piece], matches, MappingOptions(), False, state, steps)
    assert supported_runs(model, made.database, steps) == [[*range(1, PHOTOS + 1)]]
    assert model.camera(1).mean_focal_length() == FOCAL_PX == focal_length(matches)
    short = restricted(made.model, range(1, 9))
    assert _most_steps([short], matches, MappingOptions(), False, state, steps) == [short], "too few tell no camera"


def turned_alone(made: Made, image_id: int) -> Any:
    """The true model but for one photo that is turned."""
    wrong = pycolmap.Reconstruction(made.model)
    turn(wrong, image_id, degrees=3.0)
    return wrong


def verified_pairs(database: Path) -> set[tuple[int, int]]:
    with pycolmap.Database.open(database) as db:
        ids, _ = db.read_two_view_geometries()
    return {pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids}


def test_a_killed_copys_log_is_not_reused(made: Made, tmp_path: Path) -> None:
    copy, log = tmp_path / "thinned.db", tmp_path / "thinned.db-wal"
    thin_matches(made.database, copy)
    with closing(sqlite3.connect(copy)) as killed:
        killed.execute("pragma journal_mode=wal")
        killed.execute("create table left_behind as select * from matches")
        killed.commit()
        left = log.read_bytes()
    log.write_bytes(left)
    thin_matches(made.database, copy)
    with closing(sqlite3.connect(copy)) as database:
        assert database.execute("pragma integrity_check").fetchall() == [("ok",)]
        assert not database.execute("select name from sqlite_master where name = 'left_behind'").fetchall()


def test_global_mapping_runs_beside_and_agrees(made: Made, tmp_path: Path) -> None:
    started = global_mapping.start(
        made.database, tmp_path / "thinned.db", tmp_path, tmp_path / "global", 0, camera_is_known=False
    )
    assert global_mapping.failure(started) is None
    compared = compare_models(made.model, pycolmap.Reconstruction(tmp_path / "global"))
    assert compared["agree"] == PHOTOS and compared["centre"] < 0.02 and compared["different"] == []


def test_what_global_mapping_dies_of_is_told(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.db"
    damaged.write_bytes(b"no database" * 100)
    started = global_mapping.start(
        damaged, tmp_path / "thinned.db", tmp_path, tmp_path / "global", 0, camera_is_known=False
    )
    assert "code" in (global_mapping.failure(started) or "")


def test_models_that_disagree_name_images_with_different_poses(made: Made) -> None:
    other = pycolmap.Reconstruction(made.model)
    for image_id in (3, 9):
        turn(other, image_id, degrees=40.0)
    names = [made.model.image(i).name for i in (3, 9)]
    compared = compare_models(made.model, other)
    assert (compared["photos"], compared["agree"]) == (PHOTOS, PHOTOS - 2)
    assert sorted(compared["different"]) == sorted(names)


def test_adopted_cameras_are_those_of_the_model(made: Made) -> None:
    model = pycolmap.Reconstruction(made.model)
    model.camera(1).focal_length = 1.5 * FOCAL_PX
    assert adopt_cameras(made.database, model, [3, 4]) == {1}
    with pycolmap.Database.open(made.database) as db:
        (camera,) = db.read_all_cameras()
    assert camera.mean_focal_length() == 1.5 * FOCAL_PX and camera.has_prior_focal_length


def test_only_adopted_cameras_are_held(tmp_path: Path) -> None:
    made = make(tmp_path, cameras=PHOTOS)
    with pycolmap.Database.open(made.database) as db, pycolmap.DatabaseTransaction(db):
        for camera in db.read_all_cameras():
            camera.focal_length = 1.1 * FOCAL_PX
            db.update_camera(camera)
    held = adopt_cameras(made.database, made.model, range(1, 12))
    assert len(held) == 11
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True, held_cameras=held)
    (model,) = map_incrementally(made.database, tmp_path, tmp_path / "models", options)
    assert model.num_reg_images() == PHOTOS
    focal = {i: model.camera(i).mean_focal_length() for i in model.cameras}
    assert {focal[i] for i in held} == {FOCAL_PX}
    assert all(0 < abs(focal[i] / FOCAL_PX - 1) < 0.02 for i in focal.keys() - held), "found, though wrong at first"
