"""Which frames of a video are taken, and what is said where there are none."""

import shlex
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
from stages.ingest.video import tone_mapping
from stages.ingest.video.frames import (
    LONG_STEP,
    LOST,
    PLENTY,
    STEP,
    Frame,
    TakenFrame,
    _filtered,
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
    assert progress.codes == ["ingest.frames-taken"]
    step = f"{0.8 / (len(frames) - 1):.0%} of the image width"
    assert progress.names("ingest.frames-taken", f"{len(frames)} of 56 frames", step, "0.8 widths")
    assert progress.updates[0] == ("examined 10 frames of a.mp4", pytest.approx(10 / 112))
    assert progress.updates[-1] == (f"writing {len(frames)} frames", 1.0)


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
    monkeypatch.setattr("stages.ingest.video.frames.sharpness", lambda picture: float(sizes.append(picture.shape) or 0))
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


FFMPEG = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
BT2020_FROM_BT709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])


def hlg(nits: np.ndarray) -> np.ndarray:
    """The HLG signal of linear BT.2020 light on a display of 1000 cd/m² (ITU-R BT.2100)."""
    light = nits / 1000
    luminance = np.maximum(light @ [0.2627, 0.6780, 0.0593], 1e-6)
    scene = light * (luminance ** (-0.2 / 1.2))[..., None]
    above = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), above)


def pq(nits: np.ndarray) -> np.ndarray:
    """The PQ signal (SMPTE ST 2084)."""
    power = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def hdr_clip(path: Path, pictures: list[np.ndarray], transfer: str) -> Path:
    """sRGB pictures, white at 203 cd/m², as 10-bit HEVC of BT.2020 primaries."""
    for number, picture in enumerate(pictures):
        encoded = picture / 255
        light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        signal = {"arib-std-b67": hlg, "smpte2084": pq}[transfer](203 * np.clip(light @ BT2020_FROM_BT709.T, 0, None))
        cv2.imwrite(str(path.parent / f"hdr{number}.png"), np.rint(65535 * signal).astype(np.uint16)[..., ::-1])
    colours = f"colorprim=bt2020:transfer={transfer}:colormatrix=bt2020nc"
    words = ["-framerate", str(FPS), "-i", str(path.parent / "hdr%d.png")]
    words += ["-vf", "scale=out_color_matrix=bt2020:out_range=tv,format=yuv420p10le", "-c:v", "libx265", "-crf", "4"]
    words += ["-x265-params", f"log-level=error:{colours}", "-color_primaries", "bt2020", "-color_trc", transfer]
    subprocess.run([*FFMPEG, *words, "-colorspace", "bt2020nc", str(path)], check=True)
    return path


def coloured(pictures: list[np.ndarray]) -> list[np.ndarray]:
    """With a colour of its own for each third of the picture, none as light as white."""
    tint = np.repeat([[0.8, 0.5, 0.4], [0.4, 0.8, 0.5], [0.75, 0.75, 0.75]], WIDTH // 3 + 1, axis=0)[:WIDTH]
    return [np.rint(picture * tint).astype(np.uint8) for picture in pictures]


@pytest.mark.parametrize(("transfer", "name"), [("arib-std-b67", "HLG"), ("smpte2084", "PQ")])
def test_hdr_video_is_tone_mapped_to_srgb(
    transfer: str, name: str, tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = coloured(panned(*np.arange(6) / 6))
    path = hdr_clip(tmp_path / "a.mov", pictures, transfer)

    def off(folder: str) -> float:
        frames = taken(path, tmp_path / folder, progress)
        assert [frame.number for frame in frames] == list(range(6))
        shown = (np.asarray(Image.open(frame.file)).astype(int) for frame in frames)
        return max(float(np.abs(one - other).mean()) for one, other in zip(shown, pictures, strict=True))

    assert off("mapped") < 6, "as near as JPEG and chroma of half the size allow"
    assert progress.codes[0] == "ingest.tone-mapped" and progress.names("ingest.tone-mapped", name, "203 cd/m²")
    monkeypatch.setattr(tone_mapping, "can_tone_map", lambda: False)
    progress.clear()
    assert off("flat") > 9
    command = progress.said("ingest.no-tone-mapping")[0].split("has them: ")[1]
    assert command.startswith('ffmpeg -i a.mov -vf "zscale=') and progress.names("ingest.no-tone-mapping", name)
    words = [*FFMPEG, *shlex.split(command)[1:]]  # the command does it
    subprocess.run(words, cwd=tmp_path, check=True)
    path = tmp_path / "sdr.mp4"
    assert off("converted") < 8 and progress.codes[1:] == ["ingest.frames-taken"] * 2


P3_FROM_BT709 = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])


@pytest.mark.parametrize(
    ("primaries", "matrix", "from_bt709"),
    [
        ("bt2020", "bt2020nc", BT2020_FROM_BT709),
        ("bt2020", "bt709", BT2020_FROM_BT709),
        ("smpte432", "bt709", P3_FROM_BT709),
    ],
)
def test_wide_gamut_video_becomes_srgb(
    primaries: str, matrix: str, from_bt709: np.ndarray, tmp_path: Path, progress: Any
) -> None:
    pictures, path = coloured(panned(*np.arange(6) / 6)), tmp_path / "a.mp4"
    for number, picture in enumerate(pictures):
        wide = ((picture / 255) ** 2.4 @ from_bt709.T).clip(0, 1) ** (1 / 2.4)
        cv2.imwrite(str(tmp_path / f"wide{number}.png"), np.rint(255 * wide).astype(np.uint8)[..., ::-1])
    tags = f"setparams=color_primaries={primaries}:color_trc=bt709:colorspace={matrix}"
    words = ["-framerate", str(FPS), "-i", str(tmp_path / "wide%d.png"), "-c:v", "libx264", "-crf", "4"]
    words += ["-vf", f"scale=out_color_matrix={matrix[:6]}:out_range=tv,format=yuv420p,{tags}"]
    words += ["-color_primaries", primaries, "-color_trc", "bt709", "-colorspace", matrix]
    subprocess.run([*FFMPEG, *words, str(path)], check=True)
    frames = taken(path, tmp_path / "out", progress)
    shown = [np.asarray(Image.open(frame.file)).astype(int) for frame in frames]
    off = max(float(np.abs(one - other).mean()) for one, other in zip(shown, pictures, strict=True))
    assert off < 6 and progress.codes[0] == "ingest.gamut-mapped"


def test_turned_hdr_video_stands_upright(tmp_path: Path, progress: Any) -> None:
    pictures = coloured(panned(*np.arange(6) / 6))
    stored, turned = hdr_clip(tmp_path / "a.mov", pictures, "arib-std-b67"), tmp_path / "b.mov"
    words = [*FFMPEG, "-display_rotation", "90", "-i", str(stored), "-c", "copy", str(turned)]
    subprocess.run(words, check=True)
    frames = taken(turned, tmp_path / "out", progress)
    shown, expected = np.asarray(Image.open(frames[0].file)).astype(int), np.rot90(pictures[0])
    assert shown.shape == expected.shape and np.abs(shown - expected).mean() < 6


def test_an_hdr_frame_that_cannot_be_read_again_is_named(tmp_path: Path) -> None:
    path = hdr_clip(tmp_path / "a.mov", panned(*np.arange(4) / 6), "smpte2084")
    with pytest.raises(StageError) as caught:
        list(_filtered(path, [1, 7], tone_mapping.tone_mapping("smpte2084")))
    assert caught.value.code == "ingest.frame-lost" and "frame 7" in caught.value.why


def test_times_of_a_variable_frame_rate_are_right(tmp_path: Path, progress: Any) -> None:
    steady, uneven = clip(tmp_path / "a.mp4", panned(*np.arange(12) / 12)), tmp_path / "b.mp4"
    words = ["-i", str(steady), "-vf", "settb=1/9000,setpts='(N+0.35*mod(N,3)+2*gte(N,6))/10/TB'"]
    words += ["-fps_mode", "passthrough", "-enc_time_base", "1:9000", "-video_track_timescale", "9000"]
    subprocess.run([*FFMPEG, *words, str(uneven)], check=True)
    frames = taken(uneven, tmp_path / "out", progress)
    assert [frame.number for frame in frames] == list(range(12))
    expected = [(n + 0.35 * (n % 3) + 2 * (n >= 6)) / 10 for n in range(12)]
    assert [frame.time_s for frame in frames] == pytest.approx(expected, abs=0.002)


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
    assert error.code == "ingest.still-video" and "still.mp4" in error.what and "in 20 frames" in error.why
    error = refusal(clip(tmp_path / "short.mp4", panned(0.0, 0.5)), tmp_path / "2", progress)
    assert error.code == "ingest.short-video" and "2 frames" in error.why
    (tmp_path / "text.mp4").write_text("no video at all\n" * 100)
    error = refusal(tmp_path / "text.mp4", tmp_path / "3", progress)
    assert error.code == "ingest.unknown-video" and "ffmpeg -i text.mp4 " in error.hint
    stand_ins = (b"", "empty"), (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull")
    for number, (content, why) in enumerate(stand_ins):
        (tmp_path / "text.mp4").write_bytes(content)
        error = refusal(tmp_path / "text.mp4", tmp_path / f"stand-in-{number}", progress)
        assert error.code == "ingest.no-video" and why in error.why
    assert capfd.readouterr().err == ""


def test_a_video_whose_end_is_missing_is_said(tmp_path: Path, progress: Any) -> None:
    path = clip(tmp_path / "a.mp4", panned(*np.arange(40) / 40))
    data = path.read_bytes()
    path.write_bytes(data[: int(0.85 * len(data))])
    frames = taken(path, tmp_path / "out", progress)
    assert len(frames) >= 5
    assert progress.codes[0] == "ingest.frames-missing" and progress.names("ingest.frames-missing", "of 40 frames")
    assert 10 < int(progress.notes[0].split()[1]) < 40


@pytest.mark.parametrize(("decoded", "announced", "lacks"), [(29, 30, False), (27, 30, True), (985, 1000, False)])
def test_a_whole_video_may_announce_two_frames_too_many(decoded: int, announced: int, lacks: bool) -> None:
    assert lacks_frames(decoded, announced) == lacks
