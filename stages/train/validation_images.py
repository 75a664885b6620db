"""Photos that take no part in training, and what a field in training shows of them: a fixed handful of pixels."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from nerf.effects import HeldOutImages
from nerf.geometry.scene import Scene, Split
from nerf.training.trainer import FieldTrainer
from nerf.training.validation_probe import Patches, Probe, make_patches, make_probe, measure, pictures
from stages.contract import Progress, StageError
from stages.effects.image_effects import held_out_images
from stages.evaluate.image_metrics import ssim
from stages.io.photos import spread
from stages.train.config import Config
from stages.train.data import ALL_MASKED, field_background, training_dataset

PROBE_RAYS = 2048
PROBE_SEED = 0  # whatever the training's: curves of different seeds differ by what was trained, not by the pixels
# SSIM looks at windows of 11 pixels. Many small squares tell more of the photos than a few large ones; together they
# take twice the rays of the probe.
PATCHES, PATCH_SIDE = 16, 16
VALIDATION_EVERY = 8  # of the training photos one is set aside to decide by,
MIN_LEFT = 4  # and with fewer left to train on none can be
MAX_VALIDATION = 8  # where a target decides when to stop


class Unseen(NamedTuple):
    """Pixels and patches of some photos, and these beside the training photos."""

    probe: Probe
    patches: Patches
    photos: HeldOutImages


class Target(NamedTuple):
    """PSNR (dB) to be reached on photos that decide nothing else."""

    psnr: float
    photos: Unseen


class Look(NamedTuple):
    """PSNR (dB) and SSIM; None where the photos are smaller than a window of SSIM, or masks leave no window."""

    psnr: float
    ssim: float | None


def unseen_photos(
    config: Config, ingest: Path, scene: Scene, split: Split, device: str, progress: Progress
) -> Unseen | None:
    """Of the photos of a split, at the size at which photos are scored; None where it has none, or where masks leave
    nothing of its test photos, which decide nothing: then ``progress`` is told. Always the same pixels."""
    if not scene.of_split(split):
        return None
    try:
        dataset = training_dataset(ingest, scene, split, None, progress)
    except StageError as error:
        if split != "test" or error.code != ALL_MASKED:
            raise
        progress.note("train.no-test-photos", f"test photos are not measured while training: {error.why}")
        return None
    shown_over = torch.tensor(field_background(config, scene))
    return Unseen(
        make_probe(dataset, PROBE_RAYS, shown_over, PROBE_SEED).to(device),
        make_patches(dataset, PATCHES, PATCH_SIDE, shown_over, PROBE_SEED).to(device),
        held_out_images(scene.of_split("train"), scene.of_split(split), device),
    )


def load_metrics() -> None:
    """Import what :func:`look` computes with. It takes long: the first step should not wait for it, nor should the
    first measurement be charged with it."""
    import kornia.metrics  # noqa: F401


def look(trainer: FieldTrainer, unseen: Unseen) -> Look:
    """How the field does on photos that it has never seen, exposed as their neighbours let expect."""
    as_expected = trainer.effects.of_held_out(unseen.photos)
    psnr = measure(trainer.model, unseen.probe, as_expected).psnr
    rows = zip(*pictures(trainer.model, unseen.patches, as_expected), unseen.patches.used, strict=True)
    known = [value for row in rows if (value := ssim(*(part.cpu() for part in row))) is not None]
    return Look(psnr, sum(known) / len(known) if known else None)


def with_validation(scene: Scene) -> Scene:
    """``scene`` with every eighth training photo, at most MAX_VALIDATION, evenly spread, in the split "validation".

    Raises StageError where too few would be left to train on.
    """
    split = set_aside(scene, MAX_VALIDATION)
    if split is None:
        count = len(scene.of_split("train"))
        why = f"photos to decide by have to be set aside, and of {count} training photos too few would be left"
        raise StageError("train.few-photos-for-target", "no target can be trained to", why, "Leave out --target-psnr.")
    return split


def set_aside(scene: Scene, most: int, least: int = 1) -> Scene | None:
    """``scene`` with every eighth training photo, ``least`` to ``most`` in all, evenly spread, in the split
    "validation"; None where too few would be left to train on. Views keep their places, by which sparse points know
    them."""
    train = scene.of_split("train")
    count = max(least, min(most, len(train) // VALIDATION_EVERY))
    if len(train) - count < MIN_LEFT:
        return None
    chosen = {train[i].name for i in spread(len(train), count)}
    views = (replace(view, split="validation") if view.name in chosen else view for view in scene.views)
    return replace(scene, views=tuple(views))
