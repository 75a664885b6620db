"""How large depth maps may be in the time there is."""

import time
from typing import TYPE_CHECKING

from stages.contract import Inputs, Progress
from stages.depth.photos import TrainingPhotos, one_thread_each, read_training_photos
from stages.depth.stereo_matching import candidates
from stages.hardware.device import processors
from stages.io.files import read_scene

if TYPE_CHECKING:
    from stages.depth import Config

DEFAULT_SIDE, MIN_SIDE, TIMED_SIDE = 640, 160, 240  # pixels of the longer side
TIMED_PAIRS = 2
COST_EXPONENT = 2.6  # of a pair's seconds by its side: pixels and disparities grow with it, what is fixed does not
MATCHING_SHARE = 0.6  # of what decoding leaves of the time; the rest is for what neighbours agree on and for points
DECODINGS = 2  # of each photo: for matching, and for the points' colours


def choose_downscale(config: "Config", inputs: Inputs, progress: Progress) -> float:
    """Photo size over the size of its depth map: DEFAULT_SIDE, or as much of it as fits into ``config.seconds``."""
    scene = read_scene(inputs["normalise"])
    longest = max(max(scene.cameras[view.camera].width, scene.cameras[view.camera].height) for view in scene.views)
    side = float(DEFAULT_SIDE)
    if config.seconds is not None:
        progress.update("timing pairs of photos")
        timed = read_training_photos(inputs, max(1.0, longest / TIMED_SIDE))
        pairs, seconds, decoding = _timed(timed, config.neighbours)
        if pairs:
            allowed = MATCHING_SHARE * max(config.seconds - decoding, 0.0) * processors() / pairs
            side = min(side, max(MIN_SIDE, min(longest, TIMED_SIDE) * (allowed / seconds) ** (1 / COST_EXPONENT)))
    return round(max(1.0, longest / side), 3)


def _timed(photos: TrainingPhotos, neighbours: int) -> tuple[int, float, float]:
    """How many pairs there are, seconds of a core that one takes once its photos are decoded, and the seconds in which
    all cores decode all photos, whatever the size of the depth maps."""
    pairs, _ = photos.pairs(neighbours)
    timed = list(pairs.items())[:: max(1, len(pairs) // TIMED_PAIRS)][:TIMED_PAIRS]
    used = sorted({number for pair, _ in timed for number in pair})
    with one_thread_each():
        began = time.perf_counter()
        for number in used:
            photos.pixels(number)
        decoded = time.perf_counter()
        for (one, other), pair in timed:
            viewpoints = photos.viewpoints[one], photos.viewpoints[other]
            candidates(pair, viewpoints, (photos.pixels(one), photos.pixels(other)))
        matching = time.perf_counter() - decoded
    decoding = DECODINGS * len(photos.views) * (decoded - began) / max(len(used), 1) / processors()
    return len(pairs), matching / max(len(timed), 1), decoding
