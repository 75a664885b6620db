"""How large and how long a video may be so that rendering it costs no more than training did."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerf.scene import Camera

TRAINING_COST = 3  # rendered rays that cost as much as one trained ray: forward, backward and update
SHARE = 0.5  # of the training's cost
FEWEST_FRAMES, MOST_FRAMES = 24, 120
LEAST_LONG_SIDE, USUAL_LONG_SIDE = 200, 320  # pixels
LEAST_RATE, FULL_RATE, SHORTEST_SECONDS = 10, 30, 4.0


def affordable(
    rays_trained: int, camera: "Camera", longest: float, frames: int | None, width: int | None
) -> tuple[int, int]:
    """(frames, width), each as given or chosen.

    Frames come first, as many of 24 to 120 as a long side of 320 pixels leaves; then pixels, from a long side of 200 to
    ``longest`` (the size of the photos as trained). A very short training still gives the smallest of both.
    """
    budget = SHARE * TRAINING_COST * rays_trained
    long_side = max(camera.width, camera.height)
    pixels_per_square = camera.width * camera.height / long_side**2
    if frames is None:
        side = width * long_side / camera.width if width else min(USUAL_LONG_SIDE, longest)
        frames = int(min(max(budget / (side**2 * pixels_per_square), FEWEST_FRAMES), MOST_FRAMES))
    if width is None:
        side = math.sqrt(budget / frames / pixels_per_square)
        side = min(max(side, LEAST_LONG_SIDE), max(longest, LEAST_LONG_SIDE), long_side)
        width = int(side * camera.width / long_side)
    return frames, max(2, 2 * round(width / 2))


def chosen_fps(frames: int) -> int:
    """30; fewer for a short path, so that it lasts four seconds, but at least 10."""
    return max(LEAST_RATE, min(FULL_RATE, round(frames / SHORTEST_SECONDS)))
