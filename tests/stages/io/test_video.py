import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from stages.io.video import video_writer
from tests.refusals import refused
from tests.video_files import read_video

COLOURS = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (128, 128, 128), (255, 255, 255), (0, 0, 0)]


def plain_frames() -> list[np.ndarray]:
    return [np.broadcast_to(np.array(colour, np.uint8), (48, 64, 3)) for colour in COLOURS]


def write(path: Path, frames: list[np.ndarray], fps: int = 30) -> Path:
    height, width = frames[0].shape[:2]
    with video_writer(path, width, height, fps) as add:
        for frame in frames:
            add(frame)
    return path


def test_frames_come_back_in_order_with_their_colours(tmp_path: Path) -> None:
    frames, fps = read_video(write(tmp_path / "a.mp4", plain_frames(), fps=24))
    assert frames.shape == (6, 48, 64, 3)
    assert fps == 24
    assert np.abs(frames.astype(int) - np.stack(plain_frames())).max() <= 4


def test_its_colours_are_labelled(tmp_path: Path) -> None:
    asked = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(write(tmp_path / "a.mp4", plain_frames()))]
    words = subprocess.run(asked, capture_output=True, text=True).stderr
    assert "yuv420p(tv, bt709/bt709/iec61966-2-1" in words


def test_detail_survives_and_is_not_turned_over(tmp_path: Path) -> None:
    frame = np.zeros((48, 64, 3), np.uint8)
    frame[:24, :32] = 220
    frames, _ = read_video(write(tmp_path / "a.mp4", [frame] * 3))
    error = frames.astype(float) - frame
    assert 0 < np.sqrt((error**2).mean()) < 6


def test_equal_frames_give_equal_bytes(tmp_path: Path) -> None:
    one, other = (write(tmp_path / name, plain_frames()).read_bytes() for name in ("a.mp4", "b.mp4"))
    assert one == other


def test_a_browser_can_play_it_while_it_loads(tmp_path: Path) -> None:
    content = write(tmp_path / "a.mp4", plain_frames()).read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")
    assert b"avc1" in content  # H.264


def test_an_unwritable_video_ends_with_the_encoders_words(tmp_path: Path) -> None:
    with refused("io.cannot-write-video", "a.mp4", "No such file or directory"):
        write(tmp_path / "missing/a.mp4", plain_frames() * 200)


def test_an_exception_between_frames_stops_the_encoder(tmp_path: Path) -> None:
    with pytest.raises(KeyError), video_writer(tmp_path / "a.mp4", 64, 48, 30) as add:
        add(plain_frames()[0])
        raise KeyError


def test_a_folder_may_have_a_colon_in_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scan:1").mkdir()
    assert write(Path("scan:1/a.mp4"), plain_frames()).stat().st_size > 0
