"""How fast this machine trains each variant of a study and reads its photos, and which photo sizes that calls for."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from stages.contract import Inputs, Progress
from stages.effects.decisions import Space
from stages.tradeoff.runs import (
    LONGEST,
    REDUCED,
    TIMED,
    VARIANTS,
    Reading,
    Speed,
    options_of,
    photo_sizes,
)

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene, View
    from stages.train import Config as TrainConfig


class _Quiet:
    """A Progress whose notes nobody needs: stage train says them again."""

    def __init__(self, progress: Progress) -> None:
        self.update = progress.update

    def note(self, message: str) -> None:
        """Nothing."""


def measured_speeds(scene: "Scene", inputs: Inputs, seconds: float, progress: Progress) -> dict[str, Speed]:
    """A second or two of training for each variant that has a speed of its own.

    The published networks are timed only where they could come to a score in a study of ``seconds``: one of their steps
    may take longer than the whole timing. Their arithmetic beside the reduced ones' tells.
    """
    from stages.effects.decisions import read_decisions
    from stages.train.fields import field_of
    from stages.train.planning import rays_per_second

    decisions, speeds = read_decisions(inputs["effects"]), dict[str, Speed]()
    for number, name in enumerate(TIMED):
        progress.update(f"trying how fast this machine trains: {name}", number / len(TIMED))
        config = _planned(name, decisions.space, inputs, progress)
        if VARIANTS[name].family == "published":
            rays = speeds[REDUCED].rays * _work(_planned(REDUCED, decisions.space, inputs, progress)) / _work(config)
            if LONGEST * seconds * rays < VARIANTS[name].fewest * field_of(config).rays_per_step(config):
                speeds[name] = Speed(rays / field_of(config).rays_per_step(config), rays)
                continue
        rays = rays_per_second(config, scene, decisions)
        speeds[name] = Speed(rays / field_of(config).rays_per_step(config), rays)
    return speeds


def _planned(name: str, space: Space, inputs: Inputs, progress: Progress) -> "TrainConfig":
    """What stage train makes of a variant; nothing is left for it to choose by time."""
    from stages import train

    asked = train.Config(steps=1, downscale=1.0, **options_of(name, space))  # type: ignore[arg-type]
    return train.plan(asked, inputs, _Quiet(progress))


def _work(config: "TrainConfig") -> float:
    """Multiplications of a ray through both networks of a paper field, about."""
    assert config.samples_coarse and config.samples_fine and config.depth and config.width
    return (2 * config.samples_coarse + config.samples_fine) * config.depth * config.width**2


def measured_reading(scene: "Scene", ingest: Path, windows: int) -> Reading:
    """What the photos take by the time that one of them takes: all on all cores, those of the windows one by one."""
    from stages.hardware.device import processors
    from stages.io.photos import load_pixels
    from stages.train.data import scaled_size

    def pixels(views: "Sequence[View]") -> int:
        return sum(scene.cameras[view.camera].width * scene.cameras[view.camera].height for view in views)

    test, started = scene.of_split("test"), 0.0
    for view in (test[-1], test[0]):  # the first one pays for imports
        started = time.perf_counter()
        load_pixels(ingest / view.file, *scaled_size(scene.cameras[view.camera], 2.0))
    per_pixel = (time.perf_counter() - started) / pixels(test[:1])
    scored = [test[number % len(test)] for number in range(windows)]
    return Reading(per_pixel * pixels(scene.views) / processors(), per_pixel * pixels(scored))


def study_sizes(scene: "Scene", speeds: Mapping[str, Speed], seconds: float) -> tuple[float, ...]:
    """The photo sizes of a study of ``seconds``, see :func:`photo_sizes`."""
    from stages.train.planning import chosen_downscale

    smallest = chosen_downscale(scene, rays=1.0)  # as small as photos are ever made
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    longer_side = median(max(camera.width, camera.height) for camera in cameras)
    return photo_sizes(chosen_downscale(scene, LONGEST * seconds * speeds["grid"].rays), smallest, longer_side)
