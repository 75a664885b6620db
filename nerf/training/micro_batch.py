"""A step's rays, and what they add to loss and gradients."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

from nerf.fields.hash_grid import SamplePlan
from nerf.fields.mlp import Weights
from nerf.geometry.rays import Rays


class HashGridBatch(NamedTuple):
    """Rays with their target colours, which are composited over ``background``. ``jitter`` places the samples in their
    intervals, ``thinning_offset`` decides which thin samples are kept (both in [0, 1)). ``view`` is the image of a ray,
    ``known_depth`` the distance of what it meets, by a sparse point or a depth map; 0: that is not known."""

    rays: Rays
    target: Float[Tensor, "rays 3"]
    background: Float[Tensor, "rays 3"]
    jitter: Float[Tensor, "rays"]
    thinning_offset: Float[Tensor, "rays"]
    view: Int[Tensor, "rays"]
    known_depth: Float[Tensor, "rays"]


class LossWeights(NamedTuple):
    """What a ray's distortion loss and depth loss are multiplied by in the loss of a step; None: they are off."""

    distortion: Float[Tensor, ""] | None
    depth: Float[Tensor, ""] | None


class MicroBatch(NamedTuple):
    """What one micro-batch contributes: loss, gradients and their norm, the optical thickness of its samples, and the
    numbers of colour and density evaluations. ``batch`` is None of one that another process computed. ``samples`` may
    have padding at their end (nerf/kernels); ``room`` and ``fits`` are those of the HashGridPass."""

    batch: HashGridBatch | None
    loss: Tensor
    squared_error: Tensor
    grad_networks: Weights
    grad_features: Float[Tensor, "samples width"]
    points: Float[Tensor, "samples 3"]
    grad_background: dict[str, Tensor]
    grad_effects: dict[str, Tensor]
    grad_norm: Tensor
    optical_thickness: Float[Tensor, "samples"]
    colour_evaluations: Int32[Tensor, ""]
    density_evaluations: Int32[Tensor, ""]
    room: SamplePlan
    fits: Bool[Tensor, ""]


def joined(batches: Sequence[HashGridBatch]) -> dict[str, Tensor]:
    """Micro-batches joined to one batch, by the names of its tensors."""
    rays = zip(*(batch.rays for batch in batches), strict=True)
    rest = zip(*(batch[1:] for batch in batches), strict=True)
    names = (*Rays._fields, *HashGridBatch._fields[1:])
    return {name: torch.cat(chunks) for name, chunks in zip(names, (*rays, *rest), strict=True)}
