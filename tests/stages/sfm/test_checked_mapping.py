"""Intrinsics of a few photos, with which mapping of many begins; joined pieces; global mapping beside."""

import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from stages.io.photos import Photo
from stages.sfm import checked_mapping, global_mapping
from stages.sfm.checked_mapping import (
    Runs,
    _map_globally,
    _most_steps,
    _not_compared,
    _with_pieces_joined,
    calibrate_by_few,
)
from stages.sfm.colmap.database.calibration import Told, set_focal_length
from stages.sfm.colmap.database.copies import copy_without_pairs
from stages.sfm.colmap.database.images import fill_database
from stages.sfm.colmap.database.matching import best_linked, match_pairs
from stages.sfm.colmap.model_check import (
    supported_runs,
)
from stages.sfm.colmap.model_comparison import compare_models
from stages.sfm.colmap.repair import (
    restricted,
)
from stages.sfm.retry_strategies import STRATEGIES, MappingOptions, Outcome
from tests.stages.sfm.colmap.made_models import (
    FOCAL_PX,
    PHOTOS,
    Made,
    enter_focal_length,
    focal_length,
    make,
    mismatch,
    turn,
)
from tests.stages.sfm.pairs.test_feature_matching import random_descriptors

STRIP_PHOTOS, SIZE, FOCAL, DISTORTION = 14, (320, 240), 300.0, -0.05


def rotation_matrix(axis_angle: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(axis_angle)[0]


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos along a wall in relief, by hand; the last one sees nothing of it. The focal length in the
    database is a tenth too long, and nothing there tells the distortion."""
    path, random = tmp_path_factory.mktemp("strip") / "matches.db", np.random.default_rng(0)
    photos = [Photo(f"{i}.png", f"images/{i}.png", *SIZE, 0, None, None, False, 1.0) for i in range(STRIP_PHOTOS)]
    fill_database(path, photos, "SIMPLE_RADIAL")
    points = random.uniform((-2, -1, 2.0), (9, 1, 3.0), (2500, 3))
    looks = random_descriptors(len(points), 0)
    with pycolmap.Database.open(path) as db:
        for number in range(STRIP_PHOTOS):
            away = (0.5 * number, 0.1 * (number % 3), 0.0) if number < STRIP_PHOTOS - 1 else (-50.0, 0.0, 0.0)
            seen = (points - away) @ rotation_matrix(random.uniform(-0.15, 0.15, 3))
            flat = seen[:, :2] / seen[:, 2:]
            xy = FOCAL * flat * (1 + DISTORTION * (flat**2).sum(axis=1, keepdims=True)) + np.array(SIZE) / 2
            xy += random.normal(scale=0.1, size=xy.shape)
            inside = ((xy > 0) & (xy < SIZE)).all(axis=1)
            shapes = np.tile([1, 0, 0, 1], (int(inside.sum()), 1))
            db.write_keypoints(number + 1, np.hstack([xy[inside], shapes]).astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(number + 1, pycolmap.FeatureDescriptors(data=looks[inside], type=kind))
        camera = db.read_camera(1)
        set_focal_length(camera, 1.1 * FOCAL)
        camera.has_prior_focal_length = True
        db.update_camera(camera)
    pairs = np.array([(i, j) for i in range(STRIP_PHOTOS) for j in range(i + 1, min(i + 4, STRIP_PHOTOS))])
    match_pairs(path, pairs, 0, 0.8)
    return path


def test_the_best_linked_images_hang_together(strip: Path) -> None:
    numbers = sorted(int(name.removesuffix(".png")) for name in best_linked(strip, 5, {1}))
    assert numbers == list(range(numbers[0], numbers[0] + 5))
    assert len(best_linked(strip, 50, {1})) == STRIP_PHOTOS - 1, "the one that sees nothing is linked with none"


def test_few_photos_tell_focal_length_and_distortion(strip: Path, tmp_path: Path) -> None:
    job: Any = SimpleNamespace(seed=0, folder=str(tmp_path))
    state = SimpleNamespace(job=job, images=tmp_path, thinned=True, send=lambda **_: None)
    state.photos = [SimpleNamespace(camera_group=0)] * STRIP_PHOTOS
    assert calibrate_by_few(strip, MappingOptions(), Told(frozenset({1}), True), cast(Any, state)) == {1}
    with pycolmap.Database.open(strip) as db:
        camera = db.read_camera(1)
    assert camera.has_prior_focal_length
    focal_px, _, _, distortion = camera.params
    assert focal_px == pytest.approx(FOCAL, rel=0.005) and distortion == pytest.approx(DISTORTION, abs=0.005)


@pytest.mark.parametrize(("photos", "told", "held"), [(8, True, {1}), (8, False, set()), (12, False, {1})])
def test_beside_untold_cameras_only_those_of_many_photos_are_held(
    photos: int, told: bool, held: set[int], strip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checked_mapping, "CALIBRATING_PHOTOS", photos)
    job: Any = SimpleNamespace(seed=0, folder=str(tmp_path))
    state = cast(Any, SimpleNamespace(job=job, images=tmp_path, thinned=True, send=lambda **_: None))
    assert calibrate_by_few(strip, MappingOptions(), Told(frozenset({1}), told), state) == held
    assert best_linked(strip, 50, {2})[1:] == [], "links with photos of other cameras do not count"


@pytest.mark.parametrize("everything", [True, False])
def test_an_untold_camera_leaves_the_others_held(
    everything: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped = []
    monkeypatch.setattr(checked_mapping, "thin_matches", lambda *_, **__: Told(frozenset({1}), everything))
    monkeypatch.setattr(checked_mapping, "calibrate_by_few", lambda *_: {1})
    monkeypatch.setattr(checked_mapping, "_start_global_mapping", lambda *_: None)
    monkeypatch.setattr(checked_mapping, "_map_incrementally", lambda _, options, __: mapped.append(options))
    job = SimpleNamespace(seed=0, camera_params=None, folder=str(tmp_path))
    ways: Any = dict.fromkeys(("begin", "end"), lambda *_, **__: None) | {"sibling": lambda name: tmp_path / name}
    state: Any = SimpleNamespace(job=job, thinned=True, photos=[SimpleNamespace(camera_group=0)], **ways)
    checked_mapping.run_mapping(STRATEGIES[0], tmp_path / "a.db", state)
    (options,) = mapped
    assert options.ba_refine_focal_length != everything
    assert options.constant_cameras == options.mapper.constant_cameras == (set() if everything else {1})


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """A model with the true poses and its matches."""
    return make(tmp_path)


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
    enter_focal_length(matches, 0.9 * FOCAL_PX, by_exif=False)
    job = SimpleNamespace(camera_params=None, seed=0, folder=str(tmp_path))
    state: Any = SimpleNamespace(database=made.database, images=tmp_path, thinned=True, send=lambda **_: None, job=job)
    piece = restricted(made.model, range(1, 12))
    (model,) = _most_steps([piece], matches, MappingOptions(), False, state, steps)
    assert supported_runs(model, made.database, steps) == [[*range(1, PHOTOS + 1)]]
    assert model.camera(1).mean_focal_length() == FOCAL_PX == focal_length(matches)
    short = restricted(made.model, range(1, 9))
    assert _most_steps([short], matches, MappingOptions(), False, state, steps) == [short], "too few tell no camera"


def test_global_mapping_runs_beside_and_agrees(made: Made, tmp_path: Path) -> None:
    started = global_mapping.start(
        made.database, tmp_path / "thinned.db", tmp_path, tmp_path / "global", 0, camera_is_known=False
    )
    assert global_mapping.failure(started, 600.0) is None
    (model,) = global_mapping.found_models(started)
    compared = compare_models(made.model, model)
    assert compared["agree"] == PHOTOS and compared["centre"] < 0.02 and compared["different"] == []


def test_global_mapping_stands_in_where_incremental_mapping_fails(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checked_mapping, "_map_incrementally", lambda *_: [])
    monkeypatch.setattr(checked_mapping, "capture_sequence", lambda *_: [])
    notes, job = list[str](), SimpleNamespace(seed=0, camera_params=None, folder=str(tmp_path))
    kept: Any = {"log": SimpleNamespace(folder=tmp_path / "log"), "images": tmp_path, "photos": [made] * PHOTOS}
    ways = dict.fromkeys(("begin", "end"), lambda *_, **__: None) | {"send": lambda note: notes.append(note.code)}
    ways |= {"sibling": lambda name: tmp_path / f"{name}.db", "left_at_most": lambda: 1000.0}
    kept["photos"] = [SimpleNamespace(camera_group=0)] * PHOTOS
    state: Any = SimpleNamespace(job=job, thinned=False, **kept, **ways)
    mapped = checked_mapping.run_mapping(STRATEGIES[0], made.database, state)
    assert mapped and compare_models(made.model, mapped.checked.model)["agree"] == PHOTOS
    assert notes == ["sfm.global-mapping-alone"] and mapped.global_mapping is None


def test_what_global_mapping_dies_of_is_told(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.db"
    damaged.write_bytes(b"no database" * 100)
    started = global_mapping.start(
        damaged, tmp_path / "thinned.db", tmp_path, tmp_path / "global", 0, camera_is_known=False
    )
    assert "code" in (global_mapping.failure(started, 600.0) or "")


@pytest.mark.parametrize(
    ("mapped_for", "left", "seconds"),
    [(5.0, 1000.0, 55.0), (100.0, 1000.0, 300.0), (100.0, 210.0, 10.0), (100.0, 50.0, 0.0)],
    ids=["a minute", "as mapping took", "the adjustment comes first", "none is left"],
)
def test_global_mapping_that_does_not_end_is_given_up(
    mapped_for: float, left: float, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited, notes = [], []
    process: Any = SimpleNamespace(wait=lambda timeout=None: waited.append(timeout), kill=lambda: waited.append("kill"))
    started = global_mapping.Started(process, Path("absent"), time.monotonic() - mapped_for)
    state: Any = SimpleNamespace(left_at_most=lambda: left, send=lambda note: notes.append(note))
    _not_compared(started, state)
    assert waited == [pytest.approx(seconds, abs=1.0)]
    monkeypatch.setattr(process, "wait", lambda timeout=None: waited.append(timeout) if timeout is None else late())
    assert "given up" in (_not_compared(started, state) or "")
    assert waited[1:] == ["kill", None] and [note.code for note in notes] == ["sfm.not-compared"] * 2


def retry(folder: Path, mapped_for: float, notes: list[str]) -> Any:
    """What the retry by global mapping needs of the worker, where incremental mapping took so many seconds."""
    log = SimpleNamespace(folder=folder, outcomes=[Outcome("default", "x.db", seconds={"mapping": mapped_for})])
    return SimpleNamespace(
        log=log,
        images=folder,
        job=SimpleNamespace(seed=0),
        left_at_most=lambda: 1000.0,
        send=lambda note: notes.append(note.code),
    )


def test_a_retry_by_global_mapping_finds_the_model(made: Made, tmp_path: Path) -> None:
    (model,) = _map_globally(made.database, False, retry(tmp_path, 5.0, []))
    assert compare_models(made.model, model)["agree"] == PHOTOS


def test_a_retry_by_global_mapping_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes, began = list[str](), time.monotonic()
    monkeypatch.setattr(global_mapping, "COMMAND", ["-c", "import time; time.sleep(600)"])
    monkeypatch.setattr(global_mapping, "MIN_SECONDS", 1.0)
    assert _map_globally(tmp_path / "x.db", False, retry(tmp_path, 0.5, notes)) == []
    assert 2.0 <= time.monotonic() - began < 20.0 and notes == ["sfm.no-global-model"]


def late() -> None:
    raise subprocess.TimeoutExpired("global mapping", 1.0)
