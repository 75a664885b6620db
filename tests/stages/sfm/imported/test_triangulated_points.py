"""Imported poses without points get those that the matches of their photos tell."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerf.synthetic.scenes import still_life
from pipeline.engine.display import SilentDisplay
from stages import ingest, sfm
from stages.contract import run_stage
from stages.io.files import read_json
from stages.io.sparse_model import SparseModel
from stages.io.transforms_export import intrinsics, opengl_matrix
from stages.sfm.colmap.models import read_model
from tests.synthetic_photos import SyntheticPhotos

MOVED = "photo_003.jpg"


def imported(
    folder: Path, photos: SyntheticPhotos, tests: tuple[str, ...] = (), moved: str = ""
) -> tuple[SparseModel, dict[str, dict]]:
    """The model of exact poses (but for that of the photo ``moved``), and the account of each photo."""
    frames = []
    for name, pose in photos.truth.poses.items():
        offset = np.array([[0, 0, 0, 0.15]] * 3) if name == moved else 0
        frames.append({"file_path": name, "transform_matrix": opengl_matrix(pose + offset)})
    folder.mkdir(exist_ok=True)
    split = {"test_filenames": list(tests)} if tests else {}
    cameras = folder / "transforms.json"
    cameras.write_text(json.dumps(intrinsics(photos.truth.camera) | {"frames": frames} | split))
    ingest.run(ingest.Config(photos=photos.folder, cameras=cameras), {}, folder / "ingest", SilentDisplay())
    inputs = {"ingest": folder / "ingest"}
    run_stage(sfm, sfm.Config(cameras=cameras), inputs, folder / "sfm", SilentDisplay())
    account = read_json(folder / "sfm/registration.json")["images"]
    return read_model(folder / "sfm/sparse"), {Path(image["file"]).stem: image for image in account}


@pytest.fixture(scope="module")
def exact(synthetic_photos: SyntheticPhotos, tmp_path_factory: pytest.TempPathFactory) -> tuple[SparseModel, Path]:
    """The model of exact poses, and the folder of the run."""
    folder = tmp_path_factory.mktemp("exact")
    return imported(folder, synthetic_photos)[0], folder


def test_points_lie_on_the_surface_and_poses_stay(exact, synthetic_photos: SyntheticPhotos) -> None:
    model, folder = exact
    facts = read_json(folder / "sfm/registration.json")
    assert facts["points"] == len(model.xyz) > 200 and 0 < facts["reprojection_px"] < 1
    off = still_life(0).distance(torch.from_numpy(model.xyz).float()).abs()
    assert off.median() < 0.005 and off.quantile(0.9) < 0.05  # of a table 2 wide
    poses = [image.sfm_from_camera for image in model.images]
    np.testing.assert_allclose(poses, list(synthetic_photos.truth.poses.values()), atol=1e-12)
    assert model.cameras[0].params == pytest.approx(synthetic_photos.truth.camera.params)
    assert sorted(path.name for path in (folder / "sfm").iterdir()) == ["registration.json", "sfm.log", "sparse"]


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
    model, account = imported(tmp_path, synthetic_photos, tests)
    seen = {name: image["observations"] for name, image in account.items()}
    assert [name for name, count in seen.items() if not count] == ["photo_002", "photo_007"]
    assert len(model.images) == 12 and all(image["registered"] for image in account.values())


def test_a_photo_that_contradicts_its_pose_tells_no_points(synthetic_photos: SyntheticPhotos, tmp_path: Path) -> None:
    model, account = imported(tmp_path, synthetic_photos, moved=MOVED)
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
    truth = synthetic_photos.truth.__class__(synthetic_photos.truth.camera, poses, 0)
    cut_out = SyntheticPhotos(tmp_path / "photos", truth)
    model, account = imported(tmp_path / "run", cut_out)
    assert not len(model.xyz) and all(image["agreement"] for image in account.values())
