"""A/B runs (pilots): short paired trainings that tell what an effect is worth, by validation photos taken from the
training photos.

Both runs have the same seed, rays and number of steps and differ in nothing but the effect. Validation photos have an
exposure (and, where a run refines poses, a pose) of their own, which neither run knows: so they are scored by the
half-image protocol, fitted on the left half and scored on the right one.

A pilot ends with the first seed that speaks against a change, and changes nothing then. For the mean of three seeds to
be more than its noise, 4.3 standard deviations / √3, none of them may gain much less than the others: where one gains
less than MIN_GAIN_DB, what three could prove is a gain below 0.2 dB.
"""

import time
from statistics import mean, median
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerf.effects.appearance import AppearanceModel
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.rays import Rays
from nerf.geometry.scene import Scene, View
from nerf.rendering.images import render_image
from nerf.training.ray_dataset import RayDataset
from stages.contract import Inputs, Progress, StageError
from stages.effects.decisions import Decisions
from stages.effects.image_effects import image_effects, learnt_effects, photo_effects, refines_poses
from stages.evaluate.half_images import enough, from_fitted_pose, right_half_psnr
from stages.evaluate.image_metrics import MIN_FOR_INTERVAL, mean_interval
from stages.hardware.backend import chosen_backend
from stages.hardware.device import compute_device, cores
from stages.train.config import BLACK, Config
from stages.train.data import ALL_MASKED, PhotoReader, dataset_with_depths, view_mask, view_rays
from stages.train.fields.field_list import make_trainer, with_defaults
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.space import chosen_space
from stages.train.planning import seconds_per_step
from stages.train.validation_images import split_off_validation

LONG_SIDE = 200  # pixels of the photos in a pilot
SCORED_SIDE = 100  # of a validation image: rendering all of its pixels takes as long as training, and says the same
MAX_VALIDATION = 4  # of the training photos, to judge by; with fewer than MIN_FOR_INTERVAL their own noise is not known
SEEDS = 3  # at most
TARGET_SAMPLES = 1 << 13  # half the usual: a pilot has to be short, and is judged early
MICRO_BATCHES = 4  # fixed, so that a pilot ends the same whatever the machine
BESIDE_TRAINING = 0.4  # of the time of the trainings: reading photos, the warm-up, scoring
# Of a pilot's training, on one core, that take as long as fitting the pose of a validation photo and rendering it
# again: 7 in the scenes of tests/effect_scenes.py where alpha ends space, 20 to 26 where nothing does.
STEPS_PER_FIT = 25
MIN_GAIN_DB = 0.1  # a gain must exceed its noise, and this, which nobody sees


class Pilot(NamedTuple):
    """What switching an effect on gained on the validation images, in dB: the mean, and half of its 95 % interval, over
    photos or, of SEEDS seeds, over seeds, whichever is wider. ``cost`` is the share by which it made training slower;
    ``seeds``: how many were trained."""

    gain_db: float
    noise_db: float
    cost: float
    seeds: int = SEEDS

    @property
    def pays(self) -> bool:
        """Whether the gain is more than its noise: fewer seeds than SEEDS know none."""
        return self.seeds == SEEDS and self.gain_db > max(self.noise_db, MIN_GAIN_DB)

    @property
    def hurts(self) -> bool:
        """Whether leaving it out would gain as clearly."""
        return self.seeds == SEEDS and -self.gain_db > max(self.noise_db, MIN_GAIN_DB)


class _Photo(NamedTuple):
    """A validation photo: (height, width) rays, colours and which pixels count."""

    view: View
    rays: Rays
    colours: Tensor
    used: Tensor | None


class PilotScene(NamedTuple):
    """What every pilot of a scene shares; make it with :func:`pilot_scene`."""

    scene: Scene
    dataset: RayDataset
    validation: tuple[_Photo, ...]


class _Trained(NamedTuple):
    """A field on the CPU, and ``learnt``, what field.json would have of its effects."""

    field: HashGridField
    learnt: dict[str, Any]


def pilot_scene(inputs: Inputs, scene: Scene, progress: Progress) -> PilotScene | str:
    """Small photos to train on and to judge by, both from the training photos; or why there can be no pilot."""
    split = split_off_validation(scene, MAX_VALIDATION, MIN_FOR_INTERVAL)
    if split is None:
        return "too few training photos"
    cameras = [scene.cameras[view.camera] for view in scene.views]
    downscale = max(1.0, median(max(camera.width, camera.height) for camera in cameras) / LONG_SIDE)
    size = f"1/{downscale:.3g} of their size"
    try:
        dataset = dataset_with_depths(inputs, split, downscale, progress).to(compute_device())
    except StageError as error:
        if error.code != ALL_MASKED:
            raise
        # Larger photos may show enough of a thin thing.
        return f"masks leave nothing of the training photos at {size}"
    reader = PhotoReader(inputs["ingest"], split, downscale)
    photos = [
        _Photo(
            view,
            view_rays(split, view, downscale),
            reader.pixels(view, BLACK),
            view_mask(inputs["ingest"], split, view, downscale),
        )
        for view in split.of_split("validation")
    ]
    validation = tuple(photo for photo in map(_thinned, photos) if enough(photo.colours, photo.used))
    if len(validation) < MIN_FOR_INTERVAL:
        return f"too few training photos show enough at {size}"
    return PilotScene(split, dataset, validation)


def _thinned(photo: _Photo) -> _Photo:
    """Rows and columns of a photo, evenly spread, so that its longer side has about SCORED_SIDE pixels."""
    stride = max(1, round(max(photo.colours.shape[:2]) / SCORED_SIDE))
    rays = photo.rays.each(lambda part: part[::stride, ::stride])
    used = None if photo.used is None else photo.used[::stride, ::stride]
    return photo._replace(rays=rays, colours=photo.colours[::stride, ::stride], used=used)


def fits_poses(off: Decisions, on: Decisions) -> bool:
    """Whether a pilot of these two finds out where validation photos were taken from: where neither refines poses,
    they are taken as right."""
    return refines_poses({*off.on, *on.on})


def expected_seconds(scene: Scene, steps: int) -> tuple[float, float]:
    """What a pilot of all seeds takes here: its trainings, by a few steps of a fresh field, and what goes on beside
    them; and what such a pilot takes that fits poses, too."""
    decisions = Decisions({"view_dependence": {}} | ({} if scene.bounded else {"background": {}}))

    def step_on(device: str) -> float:
        return seconds_per_step(_config(decisions, scene, steps, device), scene, decisions, device)

    device = compute_device()
    per_step = step_on(device)
    trainings = (1 + BESIDE_TRAINING) * 2 * SEEDS * steps * per_step
    on_cpu = per_step if device == "cpu" else step_on("cpu")
    return trainings, trainings + 2 * SEEDS * MAX_VALIDATION * STEPS_PER_FIT * on_cpu * min(MICRO_BATCHES, cores())


def run_pilot(
    trial: PilotScene,
    off: Decisions,
    on: Decisions,
    steps: int,
    seed: int,
    progress: Progress,
    default: bool | None = None,
) -> Pilot:
    """Train both runs for each seed and compare; no more seeds once an effect clearly stays as it is by ``default``, on
    or off. Raises NonFinite where a run diverges."""
    gains: list[list[float]] = []
    decisions, seconds = {"off": off, "on": on}, {"off": 0.0, "on": 0.0}
    poses = fits_poses(off, on)
    _trained(trial, off, 1, seed)  # pays for kernels and memory
    for number in range(SEEDS):
        scores: dict[str, list[float]] = {}
        for name in ("off", "on") if number % 2 else ("on", "off"):
            done = (2 * number + len(scores)) / (2 * SEEDS)
            progress.update(f"A/B training {2 * number + len(scores) + 1} of {2 * SEEDS}", done)
            started = time.perf_counter()
            trained = _trained(trial, decisions[name], steps, seed + number)
            seconds[name] += time.perf_counter() - started
            scores[name] = [_score(trained, trial.scene, photo, poses, seed) for photo in trial.validation]
        gains.append([with_it - without for with_it, without in zip(scores["on"], scores["off"], strict=True)])
        if default is not None and (-1 if default else 1) * mean(gains[-1]) < MIN_GAIN_DB:
            break
    return Pilot(mean(map(mean, gains)), _noise(gains), seconds["on"] / seconds["off"] - 1, len(gains))


def _noise(gains: list[list[float]]) -> float:
    """Half of the mean gain's 95 % interval by Student's t, which knows how few they are: the seeds' own, or the
    photos' where that is more."""
    of_seeds = [mean(of_seed) for of_seed in gains]
    of_photos = [mean(of_photo) for of_photo in zip(*gains, strict=True)]
    intervals = [interval for each in (of_seeds, of_photos) if (interval := mean_interval(each)) is not None]
    return max((high - low) / 2 for low, high in intervals)


def _trained(trial: PilotScene, decisions: Decisions, steps: int, seed: int) -> _Trained:
    """A hash-grid field after ``steps`` steps under the decisions of one run."""
    views = trial.scene.of_split("train")
    effects = image_effects(decisions, trial.scene, views, trial.dataset)
    config = _config(decisions, trial.scene, steps, trial.dataset.device.type)
    trainer = make_trainer(config, trial.scene, trial.dataset, seed, effects)
    for step in range(steps):
        trainer.step(step, step / steps, 1.0)
    assert isinstance(trainer.model, HashGridField)
    return _Trained(trainer.model.to("cpu"), {"effects": learnt_effects(trainer.effects, views)})


def _config(decisions: Decisions, scene: Scene, steps: int, device: str) -> Config:
    """A small hash-grid field with what stage train would choose."""
    return with_defaults(
        Config(
            steps=steps,
            space=chosen_space(decisions, scene)[0],
            view_dependence="view_dependence" in decisions.on,
            grid=HashGridOptions(
                backend=chosen_backend(device),
                micro_batches=MICRO_BATCHES,
                num_levels=4,
                log2_hashmap_size=17,
                max_res=256,
                target_samples=TARGET_SAMPLES,
            ),
        )
    )


def _score(trained: _Trained, scene: Scene, photo: _Photo, poses: bool, seed: int) -> float:
    """PSNR (dB) on the right half of a photo whose exposure (and pose) is fitted on its left half."""
    behind, effects = torch.tensor(scene.backdrop or BLACK), photo_effects(trained.learnt, scene, photo.view)
    shown = AppearanceModel(trained.field, effects)
    picture = render_image(shown, photo.rays, behind)
    if poses:
        rays = from_fitted_pose(trained.field, photo.rays, picture, behind, photo.colours, photo.used, effects, seed)
        picture = render_image(shown, rays, behind)
    _, fitted = right_half_psnr(picture, behind, photo.colours, photo.used)
    assert fitted is not None, "pilot_scene takes no photo that has too few pixels"
    return fitted
