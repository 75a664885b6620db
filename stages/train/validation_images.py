"""Held-out photos (test and validation images), and how well a field in training shows some fixed pixels of them."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from nerf.effects import HeldOutImages
from nerf.geometry.scene import Scene, Split
from nerf.training.evaluation_pixels import (
    EvaluationPatches,
    EvaluationPixels,
    evaluate,
    render_patches,
    sample_evaluation_patches,
    sample_evaluation_pixels,
)
from nerf.training.trainer import FieldTrainer
from stages.contract import Progress, StageError
from stages.effects.image_effects import held_out_images
from stages.evaluate.image_metrics import ssim
from stages.io.amounts import counted
from stages.io.photos import spread
from stages.train.config import Config
from stages.train.data import ALL_MASKED, field_background, training_dataset

EVALUATION_PIXELS = 2048
EVALUATION_SEED = 0  # whatever the training's: curves of different seeds differ by what was trained, not by the pixels
# SSIM looks at windows of 11 pixels. Many small patches tell more of the photos than a few large ones; together they
# take twice the rays of the pixels.
EVALUATION_PATCHES, PATCH_SIZE = 16, 16
VALIDATION_INTERVAL = 8  # one training photo in so many becomes a validation photo,
MIN_TRAINING_PHOTOS = 4  # as long as so many are left to train on
MAX_VALIDATION_PHOTOS = 8  # for a target PSNR


class HeldOutEvaluation(NamedTuple):
    """Pixels and patches of held-out photos, and these photos beside the training photos."""

    pixels: EvaluationPixels
    patches: EvaluationPatches
    images: HeldOutImages


class Target(NamedTuple):
    """PSNR (dB) to be reached on validation photos."""

    psnr: float
    held_out: HeldOutEvaluation


class HeldOutQuality(NamedTuple):
    """PSNR (dB) and SSIM; None if the photos are smaller than a window of SSIM, or masks leave no window."""

    psnr: float
    ssim: float | None


def held_out_evaluation(
    config: Config, ingest: Path, scene: Scene, split: Split, device: str, progress: Progress
) -> HeldOutEvaluation | None:
    """Of the photos of a split, always the same pixels, at the size at which photos are scored. None if there are none,
    or if masks leave nothing of the test photos, which decide nothing: then with a note."""
    if not scene.of_split(split):
        return None
    try:
        dataset = training_dataset(ingest, scene, split, None, progress)
    except StageError as error:
        if split != "test" or error.code != ALL_MASKED:
            raise
        progress.note("train.no-test-photos", f"test photos are not measured while training: {error.why}")
        return None
    background = torch.tensor(field_background(config, scene))
    return HeldOutEvaluation(
        sample_evaluation_pixels(dataset, EVALUATION_PIXELS, background, EVALUATION_SEED).to(device),
        sample_evaluation_patches(dataset, EVALUATION_PATCHES, PATCH_SIZE, background, EVALUATION_SEED).to(device),
        held_out_images(scene, scene.of_split("train"), scene.of_split(split), device),
    )


def load_metrics() -> None:
    """Import what :func:`evaluate_held_out` computes with. It takes long: neither the first step nor the first
    evaluation should include it."""
    import kornia.metrics  # noqa: F401


def evaluate_held_out(trainer: FieldTrainer, held_out: HeldOutEvaluation) -> HeldOutQuality:
    """Quality on held-out photos, with the exposure expected from their neighbours."""
    effects = trainer.effects.of_held_out(held_out.images)
    psnr = evaluate(trainer.model, held_out.pixels, effects).psnr
    rows = zip(*render_patches(trainer.model, held_out.patches, effects), held_out.patches.used, strict=True)
    known = [value for row in rows if (value := ssim(*(part.cpu() for part in row))) is not None]
    return HeldOutQuality(psnr, sum(known) / len(known) if known else None)


def with_validation_split(scene: Scene) -> Scene:
    """``scene`` with every eighth training photo, at most MAX_VALIDATION_PHOTOS, evenly spread, in the split
    "validation".

    Raises StageError if too few would be left to train on.
    """
    split = split_off_validation(scene, MAX_VALIDATION_PHOTOS)
    if split is None:
        count = len(scene.of_split("train"))
        why = f"it needs validation photos, and {counted(count, 'training photo')} cannot spare any"
        raise StageError(
            "train.few-photos-for-target", "cannot train to a target PSNR", why, "Leave out --target-psnr."
        )
    return split


def split_off_validation(scene: Scene, most: int, least: int = 1) -> Scene | None:
    """``scene`` with every eighth training photo, ``least`` to ``most`` in all, evenly spread, in the split
    "validation"; None if too few would be left to train on. Views keep their order, which sparse points refer to."""
    train = scene.of_split("train")
    count = max(least, min(most, len(train) // VALIDATION_INTERVAL))
    if len(train) - count < MIN_TRAINING_PHOTOS:
        return None
    chosen = {train[i].name for i in spread(len(train), count)}
    views = (replace(view, split="validation") if view.name in chosen else view for view in scene.views)
    return replace(scene, views=tuple(views))
