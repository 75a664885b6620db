"""How much of each test photo there is time to score on this machine."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from nerf.geometry.rays import Rays, join_rays
from nerf.geometry.scene import Scene
from stages.contract import Inputs, Progress
from stages.evaluate.scoring import fits_poses
from stages.evaluate.seconds import MIN_RENDERING, SHARE, STEREO_SHARE, other_seconds
from stages.evaluate.tiles import PREVIEW_SHARE
from stages.hardware.device import cores
from stages.io.amounts import counted, duration, short_count
from stages.io.files import read_json, read_scene
from stages.io.photos import spread
from stages.render.renderer import TimeBudget, measured_speed
from stages.train.data import scaled_size, view_rays

if TYPE_CHECKING:
    from stages.evaluate import Config

SECONDS_PER_PIXEL = 1e-6  # that is scored, of one core: SSIM, error map, two PNG files
FITTING_RENDERS = 3  # of a photo scored at a fitted pose: the raw one, one to fit by and the fitted one
TIMED_PHOTOS = 4  # to see how fast the field renders them
MAX_FINE_FRACTION = 0.1  # from here on a fraction is rounded to whole percents, below to its first two digits


def affordable_fraction(config: "Config", inputs: Inputs, progress: Progress) -> float:
    """How much of each test photo there is time to score; says so where that is not all."""
    scene, train = read_scene(inputs["normalise"]), inputs["train"]
    if not (test := scene.of_split("test")):
        return 1.0
    time_budget = TimeBudget(config.seconds, train, other_seconds(len(scene.views), cores()), SHARE, MIN_RENDERING)
    sizes = [scaled_size(scene.cameras[view.camera], config.downscale) for view in test]
    renders = FITTING_RENDERS if fits_poses(config, read_json(train / "field.json")) else 1
    progress.update("measuring how fast the field renders")
    speed = measured_speed(train, lambda side: _timed_rays(scene, side), max(map(max, sizes)))
    pixels = sum(map(math.prod, sizes))
    whole = pixels * (renders / speed + SECONDS_PER_PIXEL / cores())
    fraction = _rounded_down(time_budget.seconds_left() / whole, (renders + PREVIEW_SHARE) / renders)
    if fraction < 1:
        photos = counted(len(test), "test photo")
        progress.note(
            "evaluate.some-pixels",
            f"only part of the pixels of {photos} is scored: all would take about {duration(whole)} at "
            f"{short_count(speed)} rays/s, {time_budget.message()}; --evaluate.fraction 1 scores all",
        )
    return fraction


def stereo_seconds(config: "Config", train: Path) -> float:
    """How long comparing depth with stereo may take, on top of what scoring may."""
    return STEREO_SHARE * TimeBudget(config.seconds, train, 0.0, SHARE, MIN_RENDERING).seconds_left()


def _rounded_down(affordable: float, with_preview: float) -> float:
    """The fraction to score where ``affordable`` of the whole could be rendered: 1 where that is all; in tiles, which
    cost ``with_preview`` times as much, two digits of it."""
    if affordable >= 1:
        return 1.0
    fraction = affordable / with_preview
    digits = 2 if fraction >= MAX_FINE_FRACTION else 1 - math.floor(math.log10(fraction))
    return max(math.floor(fraction * 10**digits) / 10**digits, 10.0**-digits)


def _timed_rays(scene: Scene, side: int) -> Rays:
    """Rays of a few test photos, reduced to a longer side of ``side`` pixels, in one row each photo after the other."""
    test = scene.of_split("test")
    few = [test[i] for i in spread(len(test), min(TIMED_PHOTOS, len(test)))]
    cameras = [scene.cameras[view.camera] for view in few]
    photos = [view_rays(scene, v, max(c.width, c.height) / side) for v, c in zip(few, cameras, strict=True)]
    return join_rays((rays.each(lambda part: part.reshape(1, -1, *part.shape[2:])) for rays in photos), dim=1)
