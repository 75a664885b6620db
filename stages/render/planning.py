"""The kinds of paths; the number and size of frames that a number of rays allows."""

import math
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from nerf.geometry.scene import Camera

PathKind = Literal["orbit", "spiral", "interpolated"]

MAX_FRAMES, MIN_FRAMES, MIN_STILLS = 120, 24, 6  # four smooth seconds, a turn in steps of 15°, a slide show
MAX_SIDE, DEFAULT_SIDE, SMALL_SIDE, MIN_SIDE = 1920, 480, 200, 32  # pixels
MIN_WIDTH = 16  # pixels, whatever the height: of --render.width, too
MAX_FPS, DEFAULT_SECONDS = 30, 4.0
MAX_GIVEN_FPS = 120


def choose_frames_and_width(
    rays: float, camera: "Camera", longest: float, frames: int | None, width: int | None
) -> tuple[int, int]:
    """(frames, width), each as given or chosen so that all frames together have at most ``rays`` pixels; a given width
    must be even.

    With more rays the video grows in this order: 6 frames up to a long side of 200 pixels, then up to 24 frames, then
    both together up to 120 frames of 480 pixels, then up to ``longest``. It never has less than 6 frames of 32 pixels,
    16 wide.
    """
    long_side = max(camera.width, camera.height)
    squares = rays / (camera.width * camera.height / long_side**2)

    def count(side: float, least: int, most: int) -> int:
        return int(min(max(squares / side**2, least), most))

    if width is not None:
        frames = frames or count(width * long_side / camera.width, MIN_STILLS, MAX_FRAMES)
        return frames, width
    if frames is None:
        small, usual = min(SMALL_SIDE, longest), min(DEFAULT_SIDE, longest)
        moving, full = MIN_FRAMES * small**2, MAX_FRAMES * usual**2
        if squares < moving:
            frames = count(small, MIN_STILLS, MIN_FRAMES)
        else:  # each grows by the same power of the rays
            grown = math.log(squares / moving) / math.log(full / moving)
            frames = min(MAX_FRAMES, int(MIN_FRAMES * (MAX_FRAMES / MIN_FRAMES) ** grown))
    side = min(max(math.sqrt(squares / frames), MIN_SIDE), longest)
    return frames, even_width(side * camera.width / long_side)


def even_width(width: float) -> int:
    """The largest even number of pixels that ``width`` has room for, MIN_WIDTH at least."""
    return max(MIN_WIDTH, 2 * int(width / 2))


def max_useful_side(camera: "Camera", downscale: float) -> float:
    """The long side beyond which a video shows nothing new: that of the photos as trained. Very small ones are rendered
    larger, at DEFAULT_SIDE, but not larger than the photo or MAX_SIDE."""
    side = max(camera.width, camera.height)
    return min(max(side / downscale, DEFAULT_SIDE), side, MAX_SIDE)


def default_fps(frames: int) -> int:
    """MAX_FPS; fewer for a short path, so that it lasts DEFAULT_SECONDS."""
    return max(1, min(MAX_FPS, round(frames / DEFAULT_SECONDS)))
