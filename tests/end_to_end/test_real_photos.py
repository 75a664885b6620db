"""Real photos through structure from motion: all that can be registered is, and what cannot is refused in words."""

import json
from pathlib import Path

import pytest

from pipeline.cli.commands import run_command
from stages.sfm.registration import OVERLAP_HINT


@pytest.mark.slow
@pytest.mark.parametrize(("name", "photos"), [("fountain_p11", 11), ("sceaux_castle", 11), ("fox", 25)])
def test_every_photo_is_registered(shared_data: Path, tmp_path: Path, name: str, photos: int):
    every = sorted(file for file in (shared_data / name / "images").iterdir() if file.suffix in {".jpg", ".JPG"})
    (tmp_path / "photos").mkdir()
    for file in every[:: len(every) // photos]:
        (tmp_path / "photos" / file.name).symlink_to(file)
    assert run_command(["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w.nerf"), "--until", "normalise"]) == 0
    (account,) = (tmp_path / "w.nerf/sfm").glob("*/registration.json")
    registration = json.loads(account.read_text())
    assert (registration["registered"], registration["photos"]) == (photos, photos)
    assert 0 < registration["reprojection_px"] < 1.2


@pytest.mark.slow
def test_photos_without_overlap_are_refused(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["run", str(shared_data / "room_no_overlap"), "-o", str(tmp_path / "w.nerf")]) == 11
    text = capsys.readouterr().err
    assert "28 pairs" in text and OVERLAP_HINT in text
    assert "Traceback" not in text
