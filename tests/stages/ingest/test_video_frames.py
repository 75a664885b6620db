"""Which frames of a video are taken, and what is said where there are none."""

import subprocess
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stages.contract import StageError
from stages.ingest.video_frames import (
    LONG_STEP,
    LOST,
    PLENTY,
    STEP,
    Frame,
    TakenFrame,
    choose_frames,
    expected_frames,
    lacks_frames,
    take_frames,
)
from stages.io.video import video_writer
from tests.blots import blots, cut_out

WIDTH, HEIGHT, FPS = 160, 120, 10
WALL = blots(0, 800, 200)


def clip(path: Path, frames: list[np.ndarray]) -> Path:
    with video_writer(path, WIDTH, HEIGHT, FPS) as write:
        for frame in frames:
            write(np.ascontiguousarray(frame))
    return path


def panned(*ways: float) -> list[np.ndarray]:
    """Frames that have moved so many widths along the wall."""
    return [cut_out(WALL, 20 + way * WIDTH, 30, WIDTH, HEIGHT) for way in ways]


def taken(path: Path, folder: Path, progress: Any, most: int = 300) -> list[TakenFrame]:
    folder.mkdir()
    return take_frames(path, most, folder, progress)


def test_frames_are_picture_steps_apart_and_pauses_one(tmp_path: Path, progress: Any) -> None:
    ways = [*[0.0] * 8, *np.arange(1, 41) / 50, *[0.8] * 8]
    frames = taken(clip(tmp_path / "a.mp4", panned(*ways)), tmp_path / "out", progress)
    steps = np.diff([ways[frame.number] for frame in frames])
    assert steps.min() >= STEP / 2 - 1e-6 and steps.max() <= 1.5 * STEP + 1e-6
    assert ways[frames[0].number] < STEP / 2 and ways[frames[-1].number] > 0.8 - STEP / 2
    assert progress.notes == [
        f"{len(frames)} of 56 frames taken: the sharpest of each step of about {0.8 / (len(frames) - 1):.0%} of the "
        "picture's width, 0.8 widths in all"
    ]
    assert progress.updates[0] == ("looked at 10 frames of a.mp4", pytest.approx(10 / 112))
    assert progress.updates[-1] == (f"writing the {len(frames)} frames taken", 1.0)


def test_what_is_written_is_the_frame_and_its_time(tmp_path: Path, progress: Any) -> None:
    pictures = panned(*np.arange(12) / 12)
    frames = taken(clip(tmp_path / "a.mp4", pictures), tmp_path / "out", progress)
    assert [frame.number for frame in frames] == list(range(12))  # each step is larger than those asked for
    for frame in frames:
        assert frame.time_s == pytest.approx(frame.number / FPS)
        assert (frame.width, frame.height, frame.file) == (WIDTH, HEIGHT, tmp_path / f"out/{frame.number:06d}")
        errors = [np.abs(np.asarray(Image.open(frame.file)).astype(int) - one).mean() for one in pictures]
        assert np.argmin(errors) == frame.number and errors[frame.number] < 12


def test_blurred_frames_are_passed_over(tmp_path: Path, progress: Any) -> None:
    pictures = panned(*np.arange(58) / 60)
    blurred = [index for index in range(58) if index % 3]
    for index in blurred:
        pictures[index] = cv2.GaussianBlur(pictures[index], (0, 0), 2)
    frames = taken(clip(tmp_path / "a.mp4", pictures), tmp_path / "out", progress)
    assert len(frames) > 10 and not {frame.number for frame in frames} & set(blurred)


def test_long_ways_are_taken_in_longer_steps(tmp_path: Path, progress: Any) -> None:
    path = clip(tmp_path / "a.mp4", panned(*np.arange(60) / 20))
    assert len(taken(path, tmp_path / "all", progress)) > 30
    few = taken(path, tmp_path / "few", progress, most=9)
    assert 6 <= len(few) <= 9
    assert len(list((tmp_path / "few").iterdir())) == len(few)


def test_large_frames_are_shrunk_once(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wall, sizes = blots(0, 1800, 100), []
    with video_writer(tmp_path / "a.mp4", 1200, 64, FPS) as write:
        for step in range(4):
            write(cut_out(wall, 100 * step, 10, 1200, 64))
    monkeypatch.setattr("stages.ingest.video_frames.sharpness", lambda picture: float(sizes.append(picture.shape) or 0))
    assert len(taken(tmp_path / "a.mp4", tmp_path / "out", progress)) == 4
    assert sizes == [(53, 1000)] * 4


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_video_gives_the_same_bytes(threads: int, tmp_path: Path, progress: Any) -> None:
    path, before = clip(tmp_path / "a.mp4", panned(*np.arange(20) / 40)), cv2.getNumThreads()
    first = taken(path, tmp_path / "1", progress)
    try:
        cv2.setNumThreads(threads)
        second = taken(path, tmp_path / "2", progress)
    finally:
        cv2.setNumThreads(before)
    assert [frame.file.read_bytes() for frame in first] == [frame.file.read_bytes() for frame in second]


@pytest.mark.parametrize(("turn", "quarters"), [(90, 1), (180, 2), (270, 3)])
def test_a_turned_video_stands_upright(turn: int, quarters: int, tmp_path: Path, progress: Any) -> None:
    pictures = panned(*np.arange(6) / 6)
    stored, turned = clip(tmp_path / "a.mp4", pictures), tmp_path / "b.mp4"
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-display_rotation", str(turn)]
    subprocess.run([*ffmpeg, "-i", str(stored), "-c", "copy", str(turned)], check=True)
    frames = taken(turned, tmp_path / "out", progress)
    first, expected = np.asarray(Image.open(frames[0].file)).astype(int), np.rot90(pictures[0], quarters)
    assert (frames[0].height, frames[0].width) == expected.shape[:2]
    assert np.abs(first - expected).mean() < 12


@pytest.mark.parametrize(
    ("aspect", "turn", "size"),
    [
        ("4/3", 0, (213, 120)),  # HDV, which stores 1440 × 1080 for 1920 × 1080
        ("4/3", 90, (120, 213)),
        ("8/11", 0, (116, 120)),
        ("0", 0, (160, 120)),  # not known
        ("100/1", 0, (160, 120)),  # not believed
    ],
)
def test_pixels_become_square(aspect: str, turn: int, size: tuple[int, int], tmp_path: Path, progress: Any) -> None:
    pictures = panned(*np.arange(6) / 6)
    square, stored = clip(tmp_path / "a.mp4", pictures), tmp_path / "b.mp4"
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-display_rotation", str(turn), "-i", str(square)]
    subprocess.run(
        [*ffmpeg, "-c", "copy", "-bsf:v", f"h264_metadata=sample_aspect_ratio={aspect}", str(stored)], check=True
    )
    assert expected_frames(stored, 300)[1:] == size
    frames = taken(stored, tmp_path / "out", progress)
    assert {(frame.width, frame.height) for frame in frames} == {size}
    first = np.asarray(Image.open(frames[0].file)).astype(int)
    expected = cv2.resize(np.rot90(pictures[0], turn // 90), size, interpolation=cv2.INTER_CUBIC)
    assert np.abs(first - expected).mean() < 12


def test_a_cut_is_a_step_and_black_frames_are_none(tmp_path: Path, progress: Any) -> None:
    other = blots(5, 800, 200)
    black = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 5
    elsewhere = [cut_out(other, 20 + 2 * step, 30, WIDTH, HEIGHT) for step in range(6)]
    frames = taken(clip(tmp_path / "a.mp4", [*black, *panned(*[0.0] * 5), *elsewhere]), tmp_path / "out", progress)
    numbers = [frame.number for frame in frames]
    assert len([number for number in numbers if number < 10]) == 1 and 10 <= numbers[1] <= 11


frames_of_a_video = st.lists(
    st.tuples(st.sampled_from([0.0, 0.002, 0.01, 0.03, 0.2, LOST]), st.floats(0, 100)), min_size=1, max_size=60
)


@given(frames_of_a_video, st.integers(3, 40))
def test_laws_of_the_choice(steps: list[tuple[float, float]], most: int) -> None:
    paths = np.cumsum([way for way, _ in steps])
    frames = [Frame(0.1 * i, float(path), sharp) for i, (path, (_, sharp)) in enumerate(zip(paths, steps, strict=True))]
    chosen = choose_frames(frames, most)
    assert 1 <= len(chosen) <= most and chosen == sorted(set(chosen))
    assert (np.diff(paths[chosen]) >= STEP / 2 - 1e-9).all()
    every = choose_frames(frames, 1000)
    assert paths[-1] - paths[every[-1]] < STEP / 2
    assert len(every) > most or chosen == every  # steps grow only where they must


@pytest.mark.parametrize(
    ("way", "most", "step"),
    [
        (2, 300, STEP),
        (5, 300, STEP),
        (8, 300, 8 / PLENTY),
        (12, 300, LONG_STEP),
        (30, 300, LONG_STEP),
        (30, 60, 30 / 60),
        (60, 300, 60 / 300),
        (8, 50, 8 / 50),
    ],
)
def test_steps_are_longer_where_there_are_plenty_of_frames(way: float, most: int, step: float) -> None:
    random = np.random.default_rng(0)
    frames = [Frame(0.0, float(path), float(random.random())) for path in np.arange(0, way, 0.005)]
    chosen = choose_frames(frames, most)
    assert len(chosen) <= most and 0.8 * way / step < len(chosen) < 1.1 * way / step + 2
    steps = np.diff([frames[number].path for number in chosen])
    assert steps.max() <= 1.5 * 1.25 * step


@pytest.mark.parametrize(
    ("frames", "most", "expected"), [(20, 300, 8), (400, 300, 100), (900, 300, 150), (900, 120, 120)]
)
def test_frames_are_foretold_from_the_length(frames: int, most: int, expected: int, tmp_path: Path) -> None:
    still = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert expected_frames(clip(tmp_path / "a.mp4", [still] * frames), most) == (expected, WIDTH, HEIGHT)


def refusal(path: Path, folder: Path, progress: Any) -> StageError:
    with pytest.raises(StageError) as error:
        taken(path, folder, progress)
    return error.value


def test_words_for_a_video_that_gives_no_photos(tmp_path: Path, progress: Any, capfd: Any) -> None:
    error = refusal(clip(tmp_path / "still.mp4", panned(*[0.001, 0.0] * 10)), tmp_path / "1", progress)
    assert error.what == "cannot take photos from still.mp4"
    assert error.why.startswith("the camera hardly moves: in 20 frames the picture shifts by 0.")
    assert error.hint.startswith("Walk around the scene while filming, slowly")
    error = refusal(clip(tmp_path / "short.mp4", panned(0.0, 0.5)), tmp_path / "2", progress)
    assert error.why == "it has only 2 frames"
    assert error.hint == "Film for ten seconds and more, walking around the scene."
    (tmp_path / "text.mp4").write_text("no video at all\n" * 100)
    error = refusal(tmp_path / "text.mp4", tmp_path / "3", progress)
    assert str(error) == (
        "cannot decode the video text.mp4: it is damaged, or of a kind that is not known here. "
        "Convert it first: ffmpeg -i text.mp4 converted.mp4"
    )
    assert capfd.readouterr().err == ""


def test_a_video_whose_end_is_missing_is_said(tmp_path: Path, progress: Any) -> None:
    path = clip(tmp_path / "a.mp4", panned(*np.arange(40) / 40))
    data = path.read_bytes()
    path.write_bytes(data[: int(0.85 * len(data))])
    frames = taken(path, tmp_path / "out", progress)
    assert len(frames) >= 5
    words = progress.notes[0].split()
    assert " ".join(words[:2]) == "only" + f" {words[1]}" and 10 < int(words[1]) < 40
    assert progress.notes[0].endswith("of 40 frames of a.mp4 can be decoded: is the file whole?")


@pytest.mark.parametrize(("decoded", "announced", "lacks"), [(29, 30, False), (27, 30, True), (985, 1000, False)])
def test_a_whole_video_may_announce_two_frames_too_many(decoded: int, announced: int, lacks: bool) -> None:
    assert lacks_frames(decoded, announced) == lacks
