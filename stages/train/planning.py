"""What the options of training leave open: field, budget, kernels, and sizes as large as the budget can make use of."""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import torch

from nerf.runtime.matmul_precision import use_matmul_precision
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from stages.contract import Inputs, Progress
from stages.effects.decisions import Decisions, read_decisions
from stages.effects.image_effects import image_effects
from stages.hardware.device import compute_device
from stages.hardware.memory import available_on
from stages.io.amounts import bytes_in_words, counted, duration, short_count
from stages.io.files import read_json, read_scene
from stages.io.photos import read_photos
from stages.train.config import SECONDS, Config
from stages.train.continuation import continued, finished_training_folder
from stages.train.data import MIN_LONG_SIDE, camera_directions
from stages.train.fields.field_list import field_of, make_trainer
from stages.train.fields.space import chosen_space
from stages.train.precision import chosen_precision

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene

MAX_PIXELS = 400e6  # of many photos, which are held in memory: 1.2 GB
MAX_PHOTOS = 48  # of 240 photos of one scene, 0.2 rays a pixel are best (docs/experiments/many_photos.md)
TIMED_SECONDS = 1.0
TIMED_PROGRESS = 0.5  # most of a run is past its long steps along rays
MAX_MEMORY_SHARE = 0.5  # of what is free on a GPU: what the pixels may take of it
MIN_NAMED_GAIN = 0.2  # of the photos' width: what larger photos have to have before they are worth a word


def planned(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Everything that was left open: field and budget, what stage effects decided, then sizes and the photos' size; or
    all of it as the finished training has it that is to go on."""
    scene, decisions = read_scene(inputs["normalise"]), read_decisions(inputs["effects"])
    if config.after is not None:
        whole = continued(config, inputs)
        open_size = config.downscale is None  # what the user gave is what they want
        if open_size and (words := larger_photos_words(whole, inputs, scene, _used_shares(inputs["ingest"], scene))):
            progress.note("train.larger-photos", words)
        return whole
    preset = config.preset or "standard"
    seconds = SECONDS[preset] if config.steps is None and config.seconds is None else config.seconds
    config = config.model_copy(update={"field": config.kind, "preset": preset, "seconds": seconds})
    config = config.filled({"view_dependence": "view_dependence" in decisions.on})
    if config.space is None:
        space, why = chosen_space(decisions, scene)
        config = config.filled({"space": space})
        progress.note("train.space", f"space {why}")
    field = field_of(config)
    config = field.prepared(field.with_defaults(config), progress)
    if config.matmul is None:
        config = config.filled({"matmul": chosen_precision(config, progress)})
    if config.downscale is not None and field.is_sized(config):
        return config
    progress.update("measuring how fast this machine trains")
    rays = rays_in_budget(config, scene, decisions)
    progress.note("train.photo-size", reason(config, rays))
    if config.downscale is None:
        used = _used_shares(inputs["ingest"], scene)
        config = config.filled({"downscale": chosen_downscale(scene, rays, used, progress)})
    return field.with_sizes(config, scene, rays, progress)


def reason(config: Config, rays: float) -> str:
    """What sizes that were left open are chosen for."""
    if config.steps is None:
        assert config.seconds is not None, "one of the two is given"
        budget = f"{duration(config.seconds)} on this machine render"
    else:
        budget = counted(config.steps, "step renders", "steps render")
    work = field_of(config).work(config, rays)
    return f"{budget} about {short_count(rays)} rays{work}; the sizes that you leave open follow from that"


def _used_shares(ingest: Path, scene: "Scene") -> dict[str, float]:
    """By name, which share of its pixels a photo's mask leaves; photos that are not named have none."""
    masks = {view.file: view.mask for view in scene.views if view.mask}
    photos = [photo for photo in read_photos(ingest) if photo.file in masks] if masks else []
    cut_out = {photo.name for photo in photos if masks[photo.file] == photo.opaque_mask}
    return {photo.name: photo.opaque_share if photo.name in cut_out else photo.used_share for photo in photos}


def rays_in_budget(config: Config, scene: "Scene", decisions: Decisions) -> float:
    """How many rays the run will draw: counted for a budget of steps, from measured speed for one of seconds."""
    if config.steps is not None:
        return config.steps * field_of(config).rays_per_step(config)
    assert config.seconds is not None, "one of the two is given"
    return config.seconds * rays_per_second(config, scene, decisions)


def rays_per_second(config: Config, scene: "Scene", decisions: Decisions) -> float:
    """Measured training speed."""
    config = field_of(config).timed(config)
    return field_of(config).rays_per_step(config) / seconds_per_step(config, scene, decisions, compute_device())


def seconds_per_step(config: Config, scene: "Scene", decisions: Decisions, device: str) -> float:
    """Measured: steps of a fresh field of known sizes, with its effects, on a grey picture, for about a second."""
    dataset = _grey_dataset(scene).to(device)
    effects = image_effects(decisions, scene, scene.of_split("train")[:1], dataset)
    trainer = make_trainer(config, scene, dataset, seed=0, effects=effects)
    with use_matmul_precision(config.matmul):
        trainer.step(0, TIMED_PROGRESS, 1.0)  # the first step pays for memory and kernels
        started, steps = time.perf_counter(), 0
        while steps == 0 or time.perf_counter() - started < TIMED_SECONDS:
            steps += 1
            trainer.step(steps, TIMED_PROGRESS, 1.0)
        return (time.perf_counter() - started) / steps


def _grey_dataset(scene: "Scene") -> RayDataset:
    """The rays of the first training view, of a picture that is grey all over."""
    view = scene.of_split("train")[0]
    camera = scene.cameras[view.camera]
    directions = camera_directions(camera, max(1.0, max(camera.width, camera.height) / MIN_LONG_SIDE))
    grey = torch.full((*directions.shape[:2], 3), 128, dtype=torch.uint8)
    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return ray_dataset_from_images(
        [grey], [0], [directions], pose[None], torch.tensor([view.near]), torch.tensor([view.far])
    )


def chosen_downscale(
    scene: "Scene", rays: float, used: "Mapping[str, float] | None" = None, progress: Progress | None = None
) -> float:
    """How many times smaller than the photos to train, for a budget of ``rays``, in tenths rounded down. ``used`` says
    by name which share of its pixels a photo's mask leaves; of others all count.

    Every pixel of the training photos is then drawn about once: of larger photos some pixels would never be drawn, and
    of smaller ones all would be drawn again and again. More than MAX_PHOTOS photos show the same things several times.
    Each of them keeps the pixels that it would have as one of MAX_PHOTOS, though not all are drawn then, up to
    MAX_PIXELS in all. Long sides keep MIN_LONG_SIDE pixels in the median, and photos are never enlarged. On a GPU,
    which holds all pixels, they are made smaller still where its memory asks for that; then ``progress`` is told.
    """
    views, used = scene.of_split("train"), used or {}
    cameras = [scene.cameras[view.camera] for view in views]
    shares = [used.get(view.name, 1.0) for view in views]
    pixels = sum(share * camera.width * camera.height for share, camera in zip(shares, cameras, strict=True))
    drawn = max(rays, min(rays * len(views) / MAX_PHOTOS, MAX_PIXELS))
    most = median(max(camera.width, camera.height) for camera in cameras) / MIN_LONG_SIDE
    wanted = max(1.0, math.floor(10 * min(math.sqrt(pixels / drawn), most)) / 10)
    if compute_device() == "cpu":  # maps the photos from the disk
        return wanted
    free = available_on("cuda")
    table = (4 if scene.has_alpha else 3) * sum(camera.width * camera.height for camera in cameras)
    least = math.ceil(10 * math.sqrt(table / max(1.0, MAX_MEMORY_SHARE * free))) / 10
    if least > wanted and progress:
        progress.note(
            "train.memory-limits-photos",
            f"photos at 1/{least:g} of their size: at 1/{wanted:g}, which the training time allows, their pixels take "
            f"{bytes_in_words(table / wanted**2)}, and only {bytes_in_words(free)} of GPU memory are free",
        )
    return max(wanted, least)


def larger_photos_words(config: Config, inputs: Inputs, scene: "Scene", used: Mapping[str, float]) -> str | None:
    """That as long a training from the start would take photos larger by more than MIN_NAMED_GAIN than those of
    ``config``, which goes on with what it has; None where it would not. ``used``: as for :func:`chosen_downscale`."""
    assert config.after is not None and config.downscale is not None, "continued() has them"
    folder = finished_training_folder(config.after, inputs)
    before = read_json(folder / "field.json")
    if config.more_steps is not None:
        steps = before["steps"] + config.more_steps
        longer, much, command = steps / before["steps"], f"{steps:,} steps", f"--train.steps {steps}"
    else:
        assert config.more_seconds is not None, "one of the two is given"
        trained = read_json(folder / "manifest.json")["facts"]["train_seconds"]
        seconds = trained + config.more_seconds
        longer, much = seconds / trained, duration(seconds)
        command = f"--train.seconds {seconds:.0f}, or a larger --budget,"
    would = chosen_downscale(scene, before["steps"] * field_of(config).rays_per_step(config) * longer, used)
    if config.downscale <= (1 + MIN_NAMED_GAIN) * would:
        return None
    stay = f"the photos stay at 1/{config.downscale:g} of their size, and the field keeps its size"
    return f"{stay}; a new training of {much} would use 1/{would:g}: {command} starts it"
