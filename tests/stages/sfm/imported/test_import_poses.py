"""Imported poses without points get those that the matches of their photos tell, and are adjusted if inexact."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from nerf.geometry.alignment import align_poses
from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import still_life
from pipeline.demo.truth import Truth
from stages import ingest, sfm
from stages.contract import run_stage
from stages.io.files import read_json
from stages.io.sparse_model import SparseModel
from stages.io.transforms_export import intrinsics, opengl_matrix
from stages.sfm.colmap.models import read_model
from stages.sfm.imported import check_worker
from tests.conftest import RecordedProgress
from tests.synthetic_photos import SyntheticPhotos

Poses = dict[str, np.ndarray]
MOVED = "photo_003.jpg"

LEFT = {"registration.json", "sfm.log", "sparse", "worker.lock"}  # of a check, where no runner tidies up


class Import(NamedTuple):
    """The model, the account of each photo by its stem, and what was said: codes, live lines and notes."""

    model: SparseModel
    account: dict[str, dict[str, Any]]
    codes: list[str]
    updates: list[str]
    notes: list[str]

    @property
    def poses(self) -> np.ndarray:
        return np.array([image.sfm_from_camera for image in self.model.images])


def imported(
    folder: Path, photos: SyntheticPhotos, poses: Poses | None = None, tests: tuple[str, ...] = (), **options: Any
) -> Import:
    """What stage sfm makes of these poses (by name), without them of the exact ones."""
    frames = [
        {"file_path": name, "transform_matrix": opengl_matrix(pose)}
        for name, pose in (poses or photos.truth.poses).items()
    ]
    folder.mkdir(exist_ok=True)
    split = {"test_filenames": list(tests)} if tests else {}
    cameras, progress = folder / "transforms.json", RecordedProgress()
    cameras.write_text(json.dumps(intrinsics(photos.truth.camera) | {"frames": frames} | split))
    ingest.run(ingest.Config(photos=photos.folder, cameras=cameras), {}, folder / "ingest", progress)
    inputs = {"ingest": folder / "ingest"}
    run_stage(sfm.STAGE, sfm.Config(cameras=cameras, **options), inputs, folder / "sfm", progress)
    account = read_json(folder / "sfm/registration.json")["images"]
    by_stem = {Path(image["file"]).stem: image for image in account}
    updates = [text for text, _ in progress.updates]
    return Import(read_model(folder / "sfm/sparse"), by_stem, progress.codes, updates, progress.notes)


def inexact(photos: SyntheticPhotos, degrees: float, share: float) -> Poses:
    """The poses with random errors: of rotations, and of centres as a share of their distance from the middle."""
    random, noisy = np.random.default_rng(0), {}
    for name, pose in photos.truth.poses.items():
        turn = Rotation.from_rotvec(random.normal(0, np.radians(degrees), 3)).as_matrix()
        shift = random.normal(0, share * np.linalg.norm(pose[:, 3]), 3)
        noisy[name] = np.concatenate([pose[:, :3] @ turn, pose[:, 3:] + shift[:, None]], axis=1)
    return noisy


@pytest.fixture(scope="module")
def exact(synthetic_photos: SyntheticPhotos, tmp_path_factory: pytest.TempPathFactory) -> tuple[SparseModel, Path]:
    """The model of exact poses, and the folder of the run."""
    folder = tmp_path_factory.mktemp("exact")
    return imported(folder, synthetic_photos).model, folder


def test_points_lie_on_the_surface_and_poses_stay(exact, synthetic_photos: SyntheticPhotos) -> None:
    model, folder = exact
    facts = read_json(folder / "sfm/registration.json")
    assert facts["points"] == len(model.xyz) > 200 and 0 < facts["reprojection_px"] < 1
    off = still_life(0).distance(torch.from_numpy(model.xyz).float()).abs()
    assert off.median() < 0.005 and off.quantile(0.9) < 0.05  # of a table 2 wide
    poses = [image.sfm_from_camera for image in model.images]
    np.testing.assert_allclose(poses, list(synthetic_photos.truth.poses.values()), atol=1e-12)
    assert model.cameras[0].params == pytest.approx(synthetic_photos.truth.camera.params)
    assert {path.name for path in (folder / "sfm").iterdir()} == LEFT


def test_points_have_the_colours_of_their_photos(exact) -> None:
    model, folder = exact
    seen = model.view == 0
    photo = np.asarray(Image.open(folder / "ingest/images" / model.images[0].file).convert("RGB"), float)
    column, row = model.xy[seen].astype(int).T
    off = np.abs(photo[row, column] - model.rgb[model.point[seen]]).mean(axis=1)
    assert np.median(off) < 12  # of 255


def test_the_same_poses_give_the_same_bytes(exact, synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    imported(tmp_path, synthetic_photos)
    for file in sorted((exact[1] / "sfm/sparse").iterdir()):
        assert (tmp_path / "sfm/sparse" / file.name).read_bytes() == file.read_bytes()


def test_official_test_photos_tell_no_points(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    tests = ("photo_002.jpg", "photo_007.jpg")
    model, account, *_ = imported(tmp_path, synthetic_photos, tests=tests)
    seen = {name: image["observations"] for name, image in account.items()}
    assert [name for name, count in seen.items() if not count] == ["photo_002", "photo_007"]
    assert len(model.images) == 12 and all(image["registered"] for image in account.values())


def test_a_photo_that_contradicts_its_pose_tells_no_points(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    moved = synthetic_photos.truth.poses[MOVED] + np.array([[0, 0, 0, 0.15]] * 3)
    model, account, *_ = imported(tmp_path, synthetic_photos, {**synthetic_photos.truth.poses, MOVED: moved})
    assert [name for name, image in account.items() if not image["observations"]] == [Path(MOVED).stem]
    off = still_life(0).distance(torch.from_numpy(model.xyz).float()).abs()
    assert off.median() < 0.005


def test_photos_with_alpha_get_no_points(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    """What is cut out has edges that are no points of a surface, and shows the region without points."""
    (tmp_path / "photos").mkdir()
    for name in synthetic_photos.truth.poses:
        pixels = np.asarray(Image.open(synthetic_photos.folder / name).convert("RGBA")).copy()
        pixels[:, :30, 3] = 0
        Image.fromarray(pixels).save((tmp_path / "photos" / name).with_suffix(".png"))
    poses = {Path(name).with_suffix(".png").name: pose for name, pose in synthetic_photos.truth.poses.items()}
    truth = Truth(synthetic_photos.truth.camera, poses, 0)
    cut_out = SyntheticPhotos(tmp_path / "photos", truth)
    model, account, *_ = imported(tmp_path / "run", cut_out)
    assert not len(model.xyz) and all(image["agreement"] for image in account.values())


@pytest.mark.parametrize("offset", [0.0, 1e5])  # that of a map projection
def test_inexact_poses_are_adjusted_in_their_frame(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, offset: float
) -> None:
    noisy = {name: pose + np.array([0, 0, 0, offset]) for name, pose in inexact(synthetic_photos, 1.0, 0.01).items()}
    found = imported(tmp_path, synthetic_photos, noisy, tests=("photo_002.jpg",))
    assert "sfm.poses-adjusted" in found.codes and len(found.model.xyz) > 200
    assert found.account["photo_002"]["observations"] == 0  # it is adjusted all the same
    exact, given = np.array(list(synthetic_photos.truth.poses.values())), np.array(list(noisy.values()))
    exact[:, :, 3] += offset
    # Nothing but the given poses tells the frame: what their errors have in common stays.
    kept = align_poses(found.poses, given)
    assert kept.scale == pytest.approx(1, abs=2e-3) and np.trace(kept.rotation) == pytest.approx(3, abs=1e-4)
    off = [np.linalg.norm(align_poses(poses, exact).points(poses[:, :, 3]) - exact[:, :, 3], axis=1)
           for poses in (given, found.poses)]  # fmt: skip
    assert off[1].max() < 0.25 * np.median(off[0])


def test_inexact_poses_stay_if_asked_for(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    noisy = inexact(synthetic_photos, degrees=1.0, share=0.01)
    found = imported(tmp_path, synthetic_photos, noisy, adjust_poses=False)
    np.testing.assert_allclose(found.poses, list(noisy.values()), atol=1e-9)
    assert {"sfm.poses-contradict", "sfm.cameras-inexact"} & set(found.codes)
    assert "sfm.poses-adjusted" not in found.codes


def test_a_wrong_lens_does_not_bend_exact_poses(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    truth = synthetic_photos.truth
    wrong = Camera("RADIAL", truth.camera.width, truth.camera.height, (250.0, *truth.camera.params[2:4], 0.8, 0.0))
    found = imported(tmp_path, SyntheticPhotos(synthetic_photos.folder, Truth(wrong, truth.poses, 0)))
    np.testing.assert_allclose(found.poses, list(truth.poses.values()), atol=1e-12)
    assert "sfm.cameras-inexact" in found.codes and "sfm.poses-adjusted" not in found.codes


def test_a_check_that_dies_while_adjusting_has_judged(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dying = "import os; import stages.sfm.imported.check_worker as c; c.triangulate = lambda *_: os._exit(3); c.main()"
    monkeypatch.setattr(check_worker, "COMMAND", ["-c", dying])
    found = imported(tmp_path, synthetic_photos)
    assert found.codes == ["sfm.no-imported-points"] and not len(found.model.xyz)
    assert all(image["agreement"] for image in found.account.values())
    assert {path.name for path in (tmp_path / "sfm").iterdir()} == LEFT


def test_a_check_that_hangs_is_ended_in_time(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hanging = "import time; import stages.sfm.imported.check_worker as c; c.match_pairs = lambda *_: time.sleep(1e6)"
    monkeypatch.setattr(check_worker, "COMMAND", ["-c", f"{hanging}; c.main()"])
    found = imported(tmp_path, synthetic_photos, max_seconds=3.0)
    assert found.codes == ["sfm.poses-unchecked"]
    assert "--force and a longer --sfm.max-seconds" in found.notes[0], "a longer one alone leaves the result cached"
    assert all(image["agreement"] is None for image in found.account.values())
    assert {path.name for path in (tmp_path / "sfm").iterdir()} == LEFT


def test_a_check_says_where_it_is(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    poses = {name: pose.copy() for name, pose in synthetic_photos.truth.poses.items()}
    for pose in poses.values():
        pose[:, 3] += 0.02 * random.standard_normal(3)
    found = imported(tmp_path, synthetic_photos, poses)
    said = " · ".join(found.updates)
    where = ["features of", "matched", "adjusting the imported poses", "triangulating points"]
    assert sorted(where, key=said.index) == where and "sfm.poses-adjusted" in found.codes


def test_poses_of_another_scene_are_not_adjusted(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    names, poses = zip(*synthetic_photos.truth.poses.items(), strict=True)
    others = dict(zip(names, np.array(poses)[np.random.default_rng(1).permutation(len(names))], strict=True))
    found = imported(tmp_path, synthetic_photos, others)
    np.testing.assert_allclose(found.poses, list(others.values()), atol=1e-12)
    assert "sfm.poses-contradict" in found.codes and not len(found.model.xyz)
