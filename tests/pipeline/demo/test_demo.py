from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerf.geometry.rays import rays_of_view
from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import still_life
from pipeline import demo
from pipeline.cli.commands import run_command
from pipeline.demo.truth import Truth
from stages.sfm.colmap.cameras import camera_rays
from tests.refusals import refused
from tests.synthetic_photos import SyntheticPhotos

TINY = Camera("OPENCV", 48, 36, (50.0, 50.0, 24.0, 18.0, -0.08, 0.03, 0.001, -0.001))


@pytest.fixture(autouse=True)
def few_small_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "PHOTOS", 3)
    monkeypatch.setattr(demo, "LENS", TINY)


def test_photos_are_remade_when_one_is_missing(tmp_path: Path, progress):
    photos = tmp_path / "photos"
    line, seconds = demo.photograph(photos, progress)
    assert line.startswith("3 photos 48×36 of a still life")
    assert seconds > 0
    assert sorted(path.name for path in photos.iterdir()) == ["photo_000.jpg", "photo_001.jpg", "photo_002.jpg"]
    assert [message for message, _ in progress.updates] == [f"photo {n} of 3" for n in (1, 2, 3)]
    first = (photos / "photo_001.jpg").read_bytes()
    assert demo.photograph(photos, progress) == (line, 0.0)
    (photos / "photo_001.jpg").unlink()
    assert demo.photograph(photos, progress)[1] > 0
    assert (photos / "photo_001.jpg").read_bytes() == first


@pytest.mark.parametrize("content", ["", "{", "{}"])
def test_an_interrupted_set_of_photos_is_made_again(tmp_path: Path, progress, content: str):
    demo.photograph(tmp_path / "photos", progress)
    (tmp_path / "truth.json").write_text(content)
    assert demo.photograph(tmp_path / "photos", progress)[1] > 0
    assert len(Truth.read(tmp_path / "truth.json").poses) == 3


def test_photos_of_the_user_are_left_alone(tmp_path: Path, progress):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "holiday.jpg").write_bytes(b"mine")
    with refused("pipeline.demo-not-written", photos, "holiday.jpg", "an empty folder"):
        demo.photograph(photos, progress)
    assert [path.name for path in photos.iterdir()] == ["holiday.jpg"]


def test_a_place_that_cannot_be_written_is_said_to_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("no folder")
    assert run_command(["demo", "-o", str(tmp_path / "file")]) == 3
    said = capsys.readouterr().err
    assert f"cannot write the demo's photos to {tmp_path / 'file/photos'}\n  why: Not a directory\n" in said
    assert said.endswith(": pipeline demo -o FOLDER\n")


def test_a_photo_shows_what_the_true_camera_sees(synthetic_photos: SyntheticPhotos):
    """The lens distortion included: each pixel against one ray through its centre."""
    folder, truth = synthetic_photos
    name, pose = list(truth.poses.items())[5]
    with Image.open(folder / name) as image:
        photo = np.asarray(image) / 255
    assert photo.shape == (180, 240, 3)
    ray_directions = torch.from_numpy(camera_rays(truth.camera, 240, 180))
    rays = rays_of_view(ray_directions, torch.tensor(pose, dtype=torch.float32), near=0.0, far=9.0)
    error = np.abs(still_life(truth.seed).trace(rays).colour.numpy() - photo)
    assert 0 < np.median(error) < 0.02
    shifted = np.abs(np.roll(photo, 2, axis=1) - still_life(truth.seed).trace(rays).colour.numpy())
    assert error.mean() < 0.5 * shifted.mean()


def test_the_demo_trains_for_a_bounded_time():
    assert demo.default_settings().train.seconds == demo.TRAIN_SECONDS < 200
