"""The kinds of paths; how large and how long a video may be so that rendering it stays within a number of rays."""

import math
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from nerf.geometry.scene import Camera

PathKind = Literal["orbit", "spiral", "interpolated"]

MAX_FRAMES, MIN_FRAMES, MIN_SLIDES = 120, 24, 6  # four smooth seconds, a turn in steps of 15°, a slide show
MAX_SIDE, USUAL_SIDE, SMALL_SIDE, MIN_SIDE = 1920, 480, 200, 32  # pixels
MIN_WIDTH = 16  # pixels, whatever the height: of --render.width, too
FULL_RATE, USUAL_SECONDS = 30, 4.0


def affordable(rays: float, camera: "Camera", longest: float, frames: int | None, width: int | None) -> tuple[int, int]:
    """(frames, width), each as given or chosen so that all frames together have at most ``rays`` pixels;
    a width that is given has to be even.

    A still has to show something before it is worth moving, and a size that shows it is enough until the motion is
    smooth. So growing ``rays`` are spent on: 6 frames up to a long side of 200, 24 frames at that, a side of 480,
    120 frames, a side of ``longest``. Less than 6 frames of 32 pixels, 16 wide, there is not, whatever they cost.
    """
    long_side = max(camera.width, camera.height)
    squares = rays / (camera.width * camera.height / long_side**2)

    def count(side: float, least: int, most: int) -> int:
        return int(min(max(squares / side**2, least), most))

    if width is not None:
        frames = frames or count(width * long_side / camera.width, MIN_SLIDES, MAX_FRAMES)
        return frames, width
    if frames is None:
        frames = count(min(USUAL_SIDE, longest), MIN_FRAMES, MAX_FRAMES)
        if squares < frames * min(SMALL_SIDE, longest) ** 2:
            frames = count(min(SMALL_SIDE, longest), MIN_SLIDES, MIN_FRAMES)
    side = min(max(math.sqrt(squares / frames), MIN_SIDE), longest)
    return frames, even_width(side * camera.width / long_side)


def even_width(width: float) -> int:
    """The largest even number of pixels that ``width`` has room for, MIN_WIDTH at least."""
    return max(MIN_WIDTH, 2 * int(width / 2))


def longest_side(camera: "Camera", downscale: float) -> float:
    """The side beyond which a video shows nothing new: that of the photos as trained. Photos trained very small are
    drawn larger than that, for blocks of pixels would hide what the field knows; none larger than it is or 1920."""
    side = max(camera.width, camera.height)
    return min(max(side / downscale, USUAL_SIDE), side, MAX_SIDE)


def chosen_fps(frames: int) -> int:
    """30; fewer for a short path, so that it lasts four seconds."""
    return max(1, min(FULL_RATE, round(frames / USUAL_SECONDS)))
