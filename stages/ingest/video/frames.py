"""The frames of a video that become photos: sharp ones, each a step of the camera away from the last.

The video is decoded twice, a frame at a time: first to measure, on frames made small and grey, how far the picture has
moved and how sharp it is, then to write the chosen ones, those of HDR video tone-mapped (tone_mapping.py).
"""

import math
import os
import re
import subprocess
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

from stages.contract import Progress, StageError
from stages.ingest.panoramas import Panorama, cutting_advice, panorama_kind
from stages.ingest.sharpness import WIDTH, at_most, sharpness
from stages.ingest.video.optical_flow import corners, follow_both_ways
from stages.ingest.video.tone_mapping import srgb_filters
from stages.io.amounts import counted
from stages.io.files import stand_in, write_jpeg

FLOW_WIDTH = 500  # pixels of the frames on which motion is measured
MAX_CORNERS, MIN_CORNERS = 150, 10
# All in widths of the picture. Photos should share 60 to 80 % with their neighbours: frames a LONG_STEP apart do so
# with three on each side. A clip that gives few frames is taken in shorter steps, down to STEP, until they are PLENTY:
# more would hardly tell more of the scene, and each takes as long as any photo.
STEP, LONG_STEP = 0.05, 0.12
PLENTY = 100
WAY_PER_SECOND = 0.2  # of somebody who walks around a thing or through a room, filming
# Of the ways of the corners: walking around a thing, and towards it, hardly moves what is in the middle of the picture.
MOVED_QUANTILE = 0.75
# Less than this is not added up: the tremble of a hand, or noise, would become a way.
MIN_MOTION = 0.01
# Where less than a third of the corners are found again, a cut or a jerk, they are those that happened to move least:
# nothing is known to be shared.
MIN_TRACKED_FRACTION, LOST = 1 / 3, 1.0
MIN_FRAMES = 3  # as sfm needs
MAX_OVERCOUNT = 2  # frames that a whole video's container may count and not hold
# Widths over heights of pixels: what is stored for tape has 8/11 to 2; others are wrong, 0 is unknown.
PIXEL_ASPECTS = (0.25, 4.0)
JPEG_QUALITY = 95  # far closer to the frame than the video is to what the camera saw


@dataclass(frozen=True)
class Frame:
    """A frame as measured: ``path`` is how far the picture has moved since the first one, in its own widths."""

    time_s: float
    path: float
    sharpness: float


@dataclass(frozen=True)
class TakenFrame:
    """A frame that was written as a JPEG ``file``; ``number`` counts the video's frames from 0."""

    number: int
    time_s: float
    sharpness: float
    file: Path
    width: int
    height: int


def take_frames(video: Path, most: int, folder: Path, progress: Progress) -> list[TakenFrame]:
    """Write at most ``most`` frames of ``video`` into ``folder``. Raises StageError where there is nothing to take.

    The frames stand upright and their pixels are square: what the video says of its rotation and of the shape of its
    pixels is undone.
    """
    filters = srgb_filters(video, progress)
    frames = _measure(video, progress)
    chosen = choose_frames(frames, most)
    if len(chosen) < MIN_FRAMES:
        raise _no_way(video, frames)
    way = frames[-1].path
    progress.note(
        "ingest.frames-taken",
        f"took {len(chosen)} of {len(frames)} frames: the sharpest in each step of about "
        f"{way / (len(chosen) - 1):.0%} of the image width; the image moves {way:.1f} widths in all",
    )
    return list(_write(video, frames, chosen, filters, folder, progress))


def choose_frames(frames: Sequence[Frame], most: int) -> list[int]:
    """The numbers of the frames to take: after each one the sharpest of those that are half a step to one and a half
    steps further, or else the next one there is. Steps grow from STEP to LONG_STEP until there are no more than PLENTY,
    and beyond that until there are no more than ``most``."""
    paths, step = [frame.path for frame in frames], STEP
    chosen = _chosen_by(paths, frames, step)
    for enough, longest in ((PLENTY, LONG_STEP), (most, math.inf)):
        while len(chosen) > enough and step < longest:
            step = min(longest, step * max(1.01, len(chosen) / enough))
            chosen = _chosen_by(paths, frames, step)
    return chosen


def expected_frames(video: Path, most: int) -> tuple[int, int, int]:
    """How many frames are likely to be taken, by how long the container says that the video is, and their width and
    height. Raises StageError where it cannot be opened."""
    with _opened(video) as capture:
        width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        across, down = _stretch(capture)
        count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
    way = WAY_PER_SECOND * count / rate if count > 0 and rate > 0 else PLENTY * STEP
    expected = max(min(way / STEP, PLENTY), way / LONG_STEP)
    return min(most, max(MIN_FRAMES, round(expected))), round(width * across), round(height * down)


def _chosen_by(paths: Sequence[float], frames: Sequence[Frame], step: float) -> list[int]:
    chosen: list[int] = []
    first, end = 0, bisect_left(paths, step / 2)
    while first < len(frames):
        end = max(end, first + 1)
        best = max(range(first, end), key=lambda number: (frames[number].sharpness, -number))
        chosen.append(best)
        first = max(best + 1, bisect_left(paths, paths[best] + step / 2))
        end = bisect_left(paths, paths[best] + 1.5 * step)
    return chosen


def _measure(video: Path, progress: Progress) -> list[Frame]:
    """Time, way and sharpness of every frame."""
    frames: list[Frame] = []
    motion = _Motion()
    with _opened(video) as capture:
        announced, stretch = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), _stretch(capture)
        while (answer := capture.read())[0]:
            frame = _with_square_pixels(answer[1], stretch)
            if not frames and (kind := panorama_kind(frame)):
                raise _panoramas(video, kind)
            # Grey first: shrinking a large frame takes longer than all the rest, and three times as long in colour.
            grey = at_most(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), WIDTH)
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            frames.append(Frame(time_s, motion.path_to(at_most(grey, FLOW_WIDTH)), sharpness(grey)))
            if len(frames) % 10 == 0:
                share = len(frames) / announced / 2 if announced >= len(frames) else None
                progress.update(f"examined {len(frames)} frames of {video.name}", share)
    if not frames:
        raise _undecodable("ingest.no-frame-decodes", video, "none of its frames can be decoded")
    if lacks_frames(len(frames), announced):
        progress.note(
            "ingest.frames-missing",
            f"only {len(frames)} of {announced} frames of {video.name} can be decoded: is the file complete?",
        )
    return frames


def lacks_frames(decoded: int, announced: int) -> bool:
    """Whether a video is not whole, of which so many frames could be decoded and its container announces so many."""
    return announced - decoded > max(MAX_OVERCOUNT, 0.02 * announced)


class _Motion:
    """How far the picture has moved: the upper quartile of the ways of its corners, which are followed from one frame
    to the next ones until it is MIN_MOTION, and from there on anew."""

    def __init__(self) -> None:
        self.path = 0.0
        self.path_of_start = 0.0
        self.start: np.ndarray | None = None  # where corners are followed from
        self.corners: np.ndarray | None = None

    def path_to(self, grey: np.ndarray) -> float:
        """The way to the next frame, (h, w) uint8, in widths of the picture. It never goes back."""
        moved = self._moved(grey)
        self.path = max(self.path, self.path_of_start + moved)
        if self.corners is None or moved >= MIN_MOTION or len(self.corners) < MIN_CORNERS:
            self.path_of_start, self.start = self.path, grey
            self.corners = corners(grey, MAX_CORNERS)
        return self.path

    def _moved(self, grey: np.ndarray) -> float:
        """Since the start; nothing where that has no corners, a black frame for instance."""
        if self.start is None or self.corners is None or len(self.corners) < MIN_CORNERS:
            return 0.0
        there, followed = follow_both_ways(self.start, grey, self.corners)
        if followed.sum() < max(MIN_CORNERS, MIN_TRACKED_FRACTION * len(followed)):
            return LOST
        ways = np.linalg.norm((there - self.corners)[followed, 0], axis=1)
        return float(np.quantile(ways, MOVED_QUANTILE)) / grey.shape[1]


def _write(
    video: Path, frames: Sequence[Frame], chosen: Sequence[int], filters: str | None, folder: Path, progress: Progress
) -> Iterator[TakenFrame]:
    with _opened(video) as capture:
        stretch = _stretch(capture)
        pictures = _as_stored(video, capture, chosen) if filters is None else _filtered(video, chosen, filters)
        for number, stored in zip(chosen, pictures, strict=True):
            picture, file = _with_square_pixels(stored, stretch), folder / f"{number:06d}"
            write_jpeg(file, picture, JPEG_QUALITY)
            height, width = picture.shape[:2]
            time_s = round(frames[number].time_s - frames[0].time_s, 4)
            yield TakenFrame(number, time_s, frames[number].sharpness, file, width, height)
            progress.update(f"writing {len(chosen)} frames", 0.5 + number / max(chosen) / 2)


def _as_stored(video: Path, capture: cv2.VideoCapture, chosen: Sequence[int]) -> Iterator[np.ndarray]:
    """Frames by their numbers, which rise, as (h, w, 3) uint8 RGB."""
    wanted = set(chosen)
    for number in range(max(chosen) + 1):
        if not capture.grab():
            raise _lost(video, number)
        if number in wanted:
            yield cv2.cvtColor(capture.retrieve()[1], cv2.COLOR_BGR2RGB)


def _filtered(video: Path, chosen: Sequence[int], filters: str) -> Iterator[np.ndarray]:
    """Frames by their numbers, which rise, after ffmpeg's ``filters``, upright, as (h, w, 3) uint8."""
    select = "+".join(f"eq(n,{number})" for number in chosen)
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-i", f"file:{video.resolve()}"]
    words += ["-vf", f"select='{select}',{filters},format=rgb24", "-fps_mode", "passthrough"]
    with subprocess.Popen(
        [*words, "-c:v", "ppm", "-f", "image2pipe", "-"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as ffmpeg:
        assert ffmpeg.stdout is not None
        try:
            for number in chosen:
                header = [ffmpeg.stdout.readline() for _ in range(3)]  # P6, width and height, 255
                if not (size := re.fullmatch(rb"(\d+) (\d+)\n", header[1])):
                    raise _lost(video, number)
                width, height = map(int, size.groups())
                if len(pixels := ffmpeg.stdout.read(3 * width * height)) < 3 * width * height:
                    raise _lost(video, number)
                yield np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        finally:
            ffmpeg.kill()


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: what is wrong with a file we say ourselves

    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(before)
    try:
        if not capture.isOpened():
            raise _unknown(video)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        yield capture
    finally:
        capture.release()


def _stretch(capture: cv2.VideoCapture) -> tuple[float, float]:
    """By how much upright frames have to be stretched across and down for their pixels to be square: across, by the
    sample aspect ratio, as players do it, unless they were turned by a quarter."""
    wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if not PIXEL_ASPECTS[0] * high <= wide <= PIXEL_ASPECTS[1] * high or not high:
        return 1.0, 1.0
    turned = capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 != 0
    return (1.0, wide / high) if turned else (wide / high, 1.0)


def _with_square_pixels(frame: np.ndarray, stretch: tuple[float, float]) -> np.ndarray:
    if stretch == (1.0, 1.0):
        return frame
    height, width = frame.shape[:2]
    return cv2.resize(frame, (round(width * stretch[0]), round(height * stretch[1])), interpolation=cv2.INTER_CUBIC)


def _unknown(video: Path) -> StageError:
    with video.open("rb") as file:
        why = stand_in(file.read(256))
    if why is None:
        why = "it is cut off or damaged, has sound and no pictures, or is of an unknown format"
        return _undecodable("ingest.unknown-video", video, why)
    return StageError("ingest.no-video", f"cannot decode the video {video.name}", why, "Copy or download it again.")


def _undecodable(code: str, video: Path, why: str) -> StageError:
    return StageError(
        code, f"cannot decode the video {video.name}", why, f"Convert it first: ffmpeg -i {video.name} converted.mp4"
    )


def _lost(video: Path, number: int) -> StageError:
    return _undecodable("ingest.frame-lost", video, f"frame {number} cannot be decoded a second time")


def _panoramas(video: Path, kind: Panorama) -> StageError:
    advice = cutting_advice(video.name, "0.mp4", kind)
    what, hint = f"cannot take photos from {video.name}", f"{advice[0].upper()}{advice[1:]}."
    if kind == "dual fisheye":
        why = "its frames are two fisheye pictures side by side"
        return StageError("ingest.dual-fisheye-video", what, why, hint)
    return StageError("ingest.panorama-video", what, "its frames are panoramas", hint)


def _no_way(video: Path, frames: Sequence[Frame]) -> StageError:
    what = f"cannot take photos from {video.name}"
    if len(frames) < MIN_FRAMES:
        return StageError(
            "ingest.short-video",
            what,
            f"it has only {counted(len(frames), 'frame')}",
            "Film for at least ten seconds while walking around the scene.",
        )
    way = frames[-1].path
    return StageError(
        "ingest.still-video",
        what,
        f"the camera hardly moves: in {len(frames)} frames the image shifts by {way:.1%} of its width",
        "Walk around the scene while filming, slowly, so that every part of it is seen from several sides.",
    )
