"""Cameras of a few small photos, what became of each, and runs that were cut short: all of stage sfm at work."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerf.geometry.alignment import align
from pipeline.engine.display import SilentDisplay
from stages import ingest, sfm
from stages.contract import run_stage
from stages.ingest.orientation import QUARTER_TURNS
from stages.io.files import read_json, write_png
from stages.io.photos import read_photos, write_photos
from stages.io.pixels import load_pixels
from stages.io.sparse_model import SparseModel
from stages.sfm import worker_process
from stages.sfm.colmap.cameras import turned_pose
from stages.sfm.colmap.models import read_model
from stages.sfm.registration import count_done
from stages.sfm.retry_strategies import STRATEGIES, Outcome, StrategyLog
from tests.blots import blots
from tests.refusals import refused
from tests.small_scenes import write_blender_scene
from tests.stages.ingest.photo_files import exif_with
from tests.stages.sfm.sfm_inputs import SMALL, ingested
from tests.synthetic_photos import SyntheticPhotos

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def inputs(synthetic_photos: SyntheticPhotos, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The synthetic photos after ingest."""
    folder = tmp_path_factory.mktemp("ingest")
    ingest.run(ingest.Config(photos=synthetic_photos.folder), {}, folder, SilentDisplay())
    return {"ingest": folder}


@pytest.fixture(scope="module")
def reconstructed(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run on the synthetic photos."""
    folder = tmp_path_factory.mktemp("sfm")
    run_stage(sfm.STAGE, SMALL, inputs, folder, SilentDisplay())
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    files = [*(folder / "sparse").iterdir(), folder / "registration.json"]
    return {file.name: file.read_bytes() for file in files}


def largest_errors(model: SparseModel, truth: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Of the centres, in units of the truth, and of the rotations, in degrees, after the best similarity."""
    true = np.stack([truth[image.file] for image in model.images])
    found = np.stack([image.sfm_from_camera for image in model.images])
    truth_from_sfm = align(found[:, :, 3], true[:, :, 3])
    aligned = np.stack([truth_from_sfm.pose(pose) for pose in found])
    cosines = (np.einsum("nij,nij->n", aligned[:, :, :3], true[:, :, :3]) - 1) / 2
    distances = np.linalg.norm(aligned[:, :, 3] - true[:, :, 3], axis=1)
    return float(distances.max()), float(np.degrees(np.arccos(cosines)).max())


def test_cameras_of_synthetic_photos_are_found(reconstructed: Path, synthetic_photos: SyntheticPhotos) -> None:
    model, truth = read_model(reconstructed / "sparse"), synthetic_photos.truth.poses
    assert [image.file for image in model.images] == sorted(truth)
    distance, degrees = largest_errors(model, truth)
    assert 0 < distance < 0.015  # 3 from the table
    assert 0 < degrees < 1


def found_for(photos: Path, folder: Path) -> dict[str, Path]:
    """The folders of stages ingest and sfm, which have run."""
    found = {"ingest": folder / "ingest", "sfm": folder / "sfm"}
    for each in found.values():
        each.mkdir()
    ingest.run(ingest.Config(photos=photos), {}, found["ingest"], SilentDisplay())
    run_stage(sfm.STAGE, SMALL, found, found["sfm"], SilentDisplay())
    return found


@pytest.mark.parametrize("every", [1, 4], ids=["all", "some"])
def test_photos_in_fog_have_cameras(every: int, synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    truth = synthetic_photos.truth.poses
    (tmp_path / "photos").mkdir()
    for number, name in enumerate(sorted(truth)):
        light = np.asarray(Image.open(synthetic_photos.folder / name).convert("RGB"), float)
        seen = 150 + 0.08 * (light - 110) if number % every == every - 1 else light
        Image.fromarray(np.rint(seen).astype(np.uint8)).save(tmp_path / "photos" / name, quality=98, subsampling=0)
    model = read_model(found_for(tmp_path / "photos", tmp_path)["sfm"] / "sparse")
    assert [image.file for image in model.images] == sorted(truth), "all are registered"
    distance, degrees = largest_errors(model, truth)
    assert distance < 0.05 and degrees < 2


def test_a_camera_held_in_several_ways_is_one(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    orientations = dict(zip(sorted(synthetic_photos.truth.poses), [1, 6, 1, 8, 1, 1, 3, 1, 6, 1, 1, 1], strict=True))
    (tmp_path / "photos").mkdir()
    for name, orientation in orientations.items():
        with Image.open(synthetic_photos.folder / name) as stored:
            exif = exif_with(orientation, Make="A", Model="1")
            stored.save(tmp_path / "photos" / name, quality=98, subsampling=0, exif=exif)
    found = found_for(tmp_path / "photos", tmp_path)
    model = read_model(found["sfm"] / "sparse")
    assert [image.file for image in model.images] == sorted(orientations), "all are registered"
    assert len({camera.model for camera in model.cameras}) == 1
    focal = [camera.params[0] for camera in model.cameras]
    assert len(focal) == 4 and focal == pytest.approx([focal[0]] * 4, rel=1e-9), "one lens"
    truth = synthetic_photos.truth.poses
    true = {name: turned_pose(truth[name], QUARTER_TURNS[turned]) for name, turned in orientations.items()}
    distance, degrees = largest_errors(model, true)
    assert distance < 0.015
    assert degrees < 1
    photos = {photo.image_name: photo for photo in read_photos(found["ingest"])}
    for index, image in enumerate(model.images):  # colours are those of the upright photos
        photo, mine = photos[image.file], model.view == index
        pixels = load_pixels(found["ingest"] / photo.file, photo.width, photo.height)
        column, row = np.floor(model.xy[mine]).astype(int).clip(0, [photo.width - 1, photo.height - 1]).T
        off = np.abs(pixels[row, column].astype(float) - model.rgb[model.point[mine]]).mean()
        assert off < 25, image.file


def test_the_account_says_what_became_of_each_photo(reconstructed: Path) -> None:
    account, model = read_json(reconstructed / "registration.json"), read_model(reconstructed / "sparse")
    assert (account["source"], account["photos"], account["registered"]) == ("sfm", 12, 12)
    assert account["test_files"] is None
    # So few points say next to nothing about distortion: which of the two it is differs between processors.
    assert account["camera_model"] in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL")
    (chosen,) = (row for row in account["camera_models"] if row["chosen"])
    assert (chosen["model"], chosen["principal_point"], chosen["photos"]) == (account["camera_model"], "fixed", 12)
    assert 0 < chosen["held_out_px"] < 1
    assert all(0 < image["uncertainty_px"] < 1 for image in account["images"])
    assert account["points"] == len(model.xyz) > 100
    assert account["reprojection_px"] == pytest.approx(model.error_px.mean())
    assert [image["observations"] for image in account["images"]] == np.bincount(model.view).tolist()
    assert all(image["keypoints"] > image["observations"] > 20 for image in account["images"])


PROGRAM = """
import sys
from pathlib import Path
from stages import sfm
from stages.contract import run_stage
from pipeline.engine.display import SilentDisplay
run_stage(sfm.STAGE, sfm.Config(max_features=1000), {"ingest": Path(sys.argv[1])}, Path(sys.argv[2]), SilentDisplay())
"""


def wait_for(condition: Callable[[], object], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


def is_gone(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for the child in /proc")
def test_a_killed_run_ends_its_worker_and_resumes_identically(
    inputs: dict[str, Path], reconstructed: Path, tmp_path: Path, progress
) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PROGRAM, str(inputs["ingest"]), str(tmp_path)], cwd=ROOT)
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    wait_for(lambda: any(count_done(database)[1] for database in tmp_path.glob("matches-*.db")))
    (child,) = map(int, children.read_text().split())
    parent.kill()
    parent.wait()
    wait_for(lambda: is_gone(child))
    run_stage(sfm.STAGE, SMALL, inputs, tmp_path, progress)
    assert progress.codes[0] == "sfm.resumes" and progress.names("sfm.resumes", "12 photos")
    assert contents(tmp_path) == contents(reconstructed)


def test_a_damaged_database_is_made_anew(
    inputs: dict[str, Path], reconstructed: Path, tmp_path: Path, progress
) -> None:
    (tmp_path / f"matches-{version('pycolmap')}.db").write_bytes(b"SQLite format 3\0 and then nothing of use")
    run_stage(sfm.STAGE, SMALL, inputs, tmp_path, progress)
    assert progress.codes[0] == "sfm.damaged-matches"
    assert contents(tmp_path) == contents(reconstructed)


@pytest.mark.parametrize(
    ("child", "message"),
    [
        ("import os; os.abort()", ("worker-killed", "SIGABRT", "extracting features", "COLMAP crashed")),
        ("import os; os.kill(os.getpid(), 9)", ("worker-killed", "SIGKILL", "memory")),
        ("raise ValueError('no such thing')", ("worker-failed", "extracting features", "ValueError: no such thing")),
        ("import time; time.sleep(60)", ("timeout", "extracting features", "0.5 s")),
    ],
)
def test_however_the_child_ends_it_is_an_error_with_words(
    child: str,
    message: tuple[str, ...],
    inputs: dict[str, Path],
    tmp_path: Path,
    progress,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", child])
    with refused(f"sfm.{message[0]}", *message[1:]):
        run_stage(sfm.STAGE, sfm.Config(max_seconds=0.5 if "sleep" in child else 60), inputs, tmp_path, progress)
    assert (tmp_path / "sfm.log").exists()


def test_an_error_of_the_child_arrives_as_it_was(
    inputs: dict[str, Path], tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = "StageError('hardware.cluster-lost', 'the cluster is gone', 'it is silent', 'Resume.')"
    code = f"import stages.sfm.worker as c\nc.reconstruct = lambda *_: (_ for _ in ()).throw(c.{lost})\nc.main()"
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", code])
    with refused("hardware.cluster-lost", "gone", "silent", "Resume."):
        run_stage(sfm.STAGE, SMALL, inputs, tmp_path / "sfm", progress)


def test_strangers_are_named_alpha_and_mixed_sizes_work(inputs: dict[str, Path], tmp_path: Path, progress) -> None:
    images = {path.name: np.asarray(Image.open(path)) for path in sorted((inputs["ingest"] / "images").iterdir())[:8]}
    alpha = {f"{n}.png": np.dstack([i, np.full(i.shape[:2], 255, np.uint8)]) for n, i in list(images.items())[:6]}
    plain = dict(list(images.items())[6:]) | {"stranger.png": blots(1, 300, 200)}
    result = run_stage(sfm.STAGE, SMALL, ingested(tmp_path / "ingest", alpha | plain), tmp_path / "sfm", progress)
    assert result.line.startswith("8/9 registered, ")
    assert [code.removeprefix("sfm.") for code in progress.codes if code != "sfm.camera-model"] == [
        "matching-time",
        "strategy",
        "matching-time",
        "strategy-useless",
        "strategy-useless",
        "unregistered",
        "unregistered-no-match",
    ]
    assert progress.names("sfm.matching-time", "36 pairs") and progress.names("sfm.matching-time", "8 pairs")
    assert progress.names("sfm.strategy", "1 of 9 photos", "relaxed ratio test")
    assert progress.names("sfm.strategy-useless", "1 of 9 photos", "fisheye", "features")
    assert progress.names("sfm.strategy-useless", "initial pair", "another seed", "global mapping")
    assert progress.names("sfm.unregistered", "1 of 9 photos")
    assert progress.names("sfm.unregistered-no-match", "stranger.png")
    account = read_json(tmp_path / "sfm/registration.json")
    assert [image["file"] for image in account["images"] if not image["registered"]] == ["stranger.png"]
    tried = {row["strategy"]: row["skipped"] for row in account["strategies"]}
    assert list(tried) == [strategy.name for strategy in STRATEGIES if strategy.matches != "consecutive"]
    assert [name for name, skipped in tried.items() if skipped is None] == ["default", "missing photos"]
    assert "1 of 9 photos" in tried["fisheye"]
    assert [row["strategy"] for row in account["strategies"] if row["kept"]] == ["default"]
    assert account["repeated_structure"] is None


def test_near_duplicates_are_unmatched_and_masks_exclude_features(
    inputs: dict[str, Path], tmp_path: Path, progress
) -> None:
    images = {path.name: np.asarray(Image.open(path)) for path in sorted((inputs["ingest"] / "images").iterdir())[:9]}
    ingested(tmp_path / "ingest", images)
    photos = read_photos(tmp_path / "ingest")
    photos[1] = replace(photos[1], near_duplicate_of=photos[0].name)
    mask = np.full((180, 240), 255, np.uint8)
    mask[:, :80] = 0
    photos[5] = replace(photos[5], mask="masks/m.png")
    write_png(tmp_path / "ingest/masks/m.png", mask)
    write_photos(tmp_path / "ingest", photos, [], {})
    result = run_stage(sfm.STAGE, SMALL, {"ingest": tmp_path / "ingest"}, tmp_path / "sfm", progress)
    account = read_json(tmp_path / "sfm/registration.json")
    model = read_model(tmp_path / "sfm/sparse")
    assert result.line.startswith("8/8 registered, 1 near-duplicate left out, ")
    assert [account[count] for count in ("photos", "registered", "near_duplicates")] == [8, 8, 1]
    assert [image["file"] for image in account["images"]] == list(images)
    assert photos[0].name in account["images"][1].pop("reason")
    assert account["images"][1].pop("reason_code") == "sfm.unregistered-near-duplicate"
    assert account["images"][1] == {
        "file": photos[1].image_name,
        "registered": False,
        "keypoints": 0,
        "observations": 0,
        "agreement": None,
        "transfer_px": None,
        "uncertainty_px": None,
    }
    place = {image.file: index for index, image in enumerate(model.images)}
    seen_at = model.xy[model.view == place[photos[5].image_name]]
    others = model.xy[model.view == place[photos[4].image_name]]
    assert len(seen_at) > 20 and seen_at[:, 0].min() > 79
    assert (others[:, 0] < 79).sum() > 5
    assert not (tmp_path / "sfm/masks").exists()


def test_a_known_camera_is_kept(
    inputs: dict[str, Path], synthetic_photos: SyntheticPhotos, tmp_path: Path, progress
) -> None:
    lens = synthetic_photos.truth.camera
    config = SMALL.model_copy(update={"camera_model": lens.model, "camera_params": lens.params})
    result = run_stage(sfm.STAGE, config, inputs, tmp_path, progress)
    assert result.line.startswith("12/12 registered, ") and " · OPENCV · " in result.line
    assert read_model(tmp_path / "sparse").cameras == [lens]
    assert "sfm.camera-kept" in progress.codes
    assert read_json(tmp_path / "registration.json")["camera_models"] == []


def test_photos_with_gps_tell_metres_and_directions(
    inputs: dict[str, Path], synthetic_photos: SyntheticPhotos, tmp_path: Path, progress
) -> None:
    """The walk around the table, as if a unit were 40 m, at the equator, where degrees east and north are metres."""
    ingest_folder = tmp_path / "ingest"
    shutil.copytree(inputs["ingest"], ingest_folder)
    centres = {name: 40 * pose[:, 3] for name, pose in synthetic_photos.truth.poses.items()}
    photos = [
        replace(photo, longitude=x / 111_319.49, latitude=y / 110_574.28, altitude_m=float(z))
        for photo in read_photos(ingest_folder)
        for x, y, z in [centres[photo.name]]
    ]
    write_photos(ingest_folder, photos, [], {})
    run_stage(sfm.STAGE, SMALL, {"ingest": ingest_folder}, tmp_path / "sfm", progress)
    found = read_json(tmp_path / "sfm/registration.json")["georeference"]
    assert found["photos"] == 12 and 0 < found["error_m"] < 0.5
    images = read_model(tmp_path / "sfm/sparse").images
    matrix = np.array(found["enu_from_sfm"])
    enu = np.array([matrix[:3, :3] @ image.sfm_from_camera[:, 3] + matrix[:3, 3] for image in images])
    true = np.array([centres[image.file] for image in images])
    np.testing.assert_allclose(enu - enu[0], true - true[0], atol=1.5)  # of walks of 120 m
    assert progress.names("sfm.gps-scale", "12 photos")


@pytest.mark.parametrize("always", [False, True], ids=["mended", "left out"])
def test_one_degenerate_camera_does_not_end_the_run(
    always: bool, inputs: dict[str, Path], tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = {path.name: np.asarray(Image.open(path)) for path in sorted((inputs["ingest"] / "images").iterdir())[:8]}
    images["photo_003.jpg"] = np.ascontiguousarray(images["photo_003.jpg"][:, 10:230])  # another size, another camera
    degenerate = "camera.width == 220" if always else "camera.width == 220 and camera.model_name != 'SIMPLE_PINHOLE'"
    child = (
        "import stages.sfm.colmap.adjustment.intrinsics as lenses, stages.sfm.worker as c\n"
        f"lenses.why_degenerate = lambda camera: 'it is wrong' if {degenerate} else None\n"
        "c.main()"
    )
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", child])
    run_stage(sfm.STAGE, SMALL, ingested(tmp_path / "ingest", images), tmp_path / "sfm", progress)
    assert progress.names("sfm.camera-replaced", "1 photo", "it is wrong", "SIMPLE_PINHOLE")
    account, model = read_json(tmp_path / "sfm/registration.json"), read_model(tmp_path / "sfm/sparse")
    reasons = {image["file"]: image["reason_code"] for image in account["images"] if not image["registered"]}
    assert reasons == ({"photo_003.jpg": "sfm.unregistered-degenerate-camera"} if always else {})
    assert [camera.model for camera in model.cameras if camera.width == 220] == ([] if always else ["SIMPLE_PINHOLE"])
    assert len(model.images) == account["registered"] == 8 - len(reasons)
    assert [image["observations"] for image in account["images"] if image["registered"]] == (
        np.bincount(model.view).tolist()
    )


def with_a_stranger(inputs: dict[str, Path], folder: Path) -> dict[str, Path]:
    """Six photos and one of another scene: the default strategy leaves it unregistered."""
    images = {path.name: np.asarray(Image.open(path)) for path in sorted((inputs["ingest"] / "images").iterdir())[:6]}
    return ingested(folder, images | {"stranger.png": blots(1, 300, 200)})


@pytest.mark.parametrize(
    ("end", "became"),
    [
        ("os.abort()", "ended the program"),
        ("os.kill(os.getpid(), 9)", "was killed"),
        ("int('x')", "ended the program"),
    ],
)
def test_a_run_goes_on_without_a_strategy_that_crashed(
    end: str, became: str, inputs: dict[str, Path], tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = with_a_stranger(inputs, tmp_path / "ingest")
    crash = (
        "import sys, stages.sfm.worker as c, os\n"
        "first = c.match_photos\n"
        f"c.match_photos = lambda a, m, w: {end} if a.name == 'missing photos' else first(a, m, w)\n"
        "c.main()"
    )
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", crash])
    result = run_stage(sfm.STAGE, SMALL, folders, tmp_path / "sfm", progress)
    assert result.line.startswith("6/7 registered, ")
    assert progress.names("sfm.strategy-crashed", became, "'missing photos'")
    assert progress.names("sfm.strategy-failed-before", became, "registering them in the model")
    tried = {row["strategy"]: row["skipped"] for row in read_json(tmp_path / "sfm/registration.json")["strategies"]}
    assert became in tried["missing photos"]


def test_a_strategy_for_which_no_time_is_left_is_skipped(
    inputs: dict[str, Path], tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = (
        "import stages.sfm.worker as c\n"
        "end = c.JobState.end\n"
        "def slowly(state, phase):\n"
        "    end(state, phase)\n"
        "    state.seconds[phase] += 100\n"
        "c.JobState.end = slowly\n"
        "c.main()"
    )
    monkeypatch.setattr(worker_process, "COMMAND", ["-c", slow])
    config = SMALL.model_copy(update={"max_seconds": 240.0})
    result = run_stage(sfm.STAGE, config, with_a_stranger(inputs, tmp_path / "ingest"), tmp_path / "sfm", progress)
    assert result.line.startswith("6/7 registered, ")
    assert result.line.endswith(" · 1 retry strategy skipped for time: sfm --force")
    # Of the first time's 100 s of mapping 0.4, of those of matching 4 / 7; twice 100 s are for the adjustment.
    values = ("about 2 min", "4 min of --sfm.max-seconds", "registering them in the model")
    assert progress.names("sfm.strategy-too-slow", *values)
    tried = {row["strategy"]: row["skipped"] for row in read_json(tmp_path / "sfm/registration.json")["strategies"]}
    assert "--sfm.max-seconds" in tried["missing photos"]
    assert "too few matches" in tried["weaker initial pair"]


def test_outcomes_whose_matches_are_gone_are_removed(
    inputs: dict[str, Path], reconstructed: Path, tmp_path: Path, progress
) -> None:
    StrategyLog(tmp_path / "strategies").add(Outcome("default", "matches-0.db", [["photo_000.jpg"] * 12], 500, 0.1))
    run_stage(sfm.STAGE, SMALL, inputs, tmp_path, progress)
    assert contents(tmp_path) == contents(reconstructed)


def test_the_screen_never_stands_still(inputs: dict[str, Path], tmp_path: Path, progress) -> None:
    run_stage(sfm.STAGE, SMALL, inputs, tmp_path, progress)
    shares = [done for _, done in progress.updates if done is not None]
    assert shares == sorted(shares)
    assert 0 <= shares[0] < shares[-1] <= 1
    assert len(progress.updates) >= 3


def test_known_cameras_go_through_without_points(tmp_path: Path, progress) -> None:
    write_blender_scene(tmp_path / "blender", train=4, test=1)
    config = ingest.Config(photos=tmp_path / "blender")
    ingest.run(config, {}, tmp_path / "ingest", progress)
    result = run_stage(
        sfm.STAGE, sfm.Config(cameras=tmp_path / "blender"), {"ingest": tmp_path / "ingest"}, tmp_path / "sfm", progress
    )
    account = read_json(tmp_path / "sfm/registration.json")
    assert result.line == "5/5 poses imported · PINHOLE"
    assert (account["source"], account["reprojection_px"], account["points"]) == ("import", None, 0)
    assert account["test_files"] == ["test/r_4.png"]
    assert account["camera_models"] == []
    assert {image["uncertainty_px"] for image in account["images"]} == {None}
    assert read_model(tmp_path / "sfm/sparse").cameras[0].params[0] == pytest.approx(52.0)


def test_photos_that_look_alike_are_enough(inputs: dict[str, Path], tmp_path: Path, progress) -> None:
    config = sfm.Config(max_features=1000, matcher="retrieval", neighbours=3)
    result = run_stage(sfm.STAGE, config, inputs, tmp_path, progress)
    assert result.line.startswith("12/12 registered")
    graph = read_json(tmp_path / "registration.json")["match_graph"]
    assert 12 * 3 / 2 <= graph["verified"] <= graph["tried"] < 12 * 11 / 2
    assert graph["order"]


def test_all_points_have_colours(reconstructed: Path) -> None:
    rgb = read_model(reconstructed / "sparse").rgb
    assert len(rgb) > 100 and rgb.any(axis=1).mean() > 0.99


def test_every_photo_is_checked_and_global_mapping_agrees(reconstructed: Path) -> None:
    account = read_json(reconstructed / "registration.json")
    check, other = account["check"], account["global_mapping"]
    assert check["doubtful"] == [] and check["weak_links"] == []
    assert 0.9 * check["pairs"] < check["agreeing"] <= check["pairs"] <= 12 * 11 / 2
    assert 0 < check["error_px"] < check["tolerance_px"] < 4
    assert min(image["agreement"] for image in account["images"]) > 0.9
    assert 0 < max(image["transfer_px"] for image in account["images"]) < check["tolerance_px"]
    assert (other["photos"], other["agree"], other["different"], other["failed"]) == (12, 12, [], None)
    assert 0 < other["centre"] < 0.02
