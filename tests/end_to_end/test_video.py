"""A video goes in and a scene comes out."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from stages.io.files import read_json
from stages.io.video import video_writer
from tests.synthetic_photos import SyntheticPhotos


def test_a_video_becomes_a_scene(
    synthetic_photos: SyntheticPhotos, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The synthetic photos as frames of a video, each held for three frames."""
    files = sorted(synthetic_photos.folder.glob("*.jpg"))
    with video_writer(tmp_path / "clip.mp4", 240, 180, 10) as write:
        for file in files:
            for _ in range(3):
                write(np.asarray(Image.open(file)))
    words = ["run", str(tmp_path / "clip.mp4"), "-o", str(tmp_path / "w.nerf"), "--until", "normalise"]
    assert run_command([*words, "--sfm.max-features", "1000"]) == 0
    photos = read_json(tmp_path / "w.nerf/output/photos.json")["photos"]
    held = [round(10 * photo["time_s"]) // 3 for photo in photos]
    assert held == sorted(set(held)) and 10 <= len(held) <= len(files)  # one frame of each photo that has moved enough
    views = read_json(tmp_path / "w.nerf/output/scene.json")["views"]
    assert 10 <= len(views) <= len(held)
    line = f"{len(held)} frames 240×180, one camera, no EXIF focal length, {photos[-1]['time_s']:.1f} s of video"
    assert line in capsys.readouterr().out
