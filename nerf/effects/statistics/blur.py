"""Which photos are blurred, and whether by motion: gradients of a photo in every direction, beside its neighbours'."""

import numpy as np
from jaxtyping import Float

from nerf.effects.statistics.statistic import Evidence, unknown

ONE_DIRECTION = 1e-6  # of the larger eigenvalue: stripes, whose gradients across say nothing and cannot be divided by
NEIGHBOURS = 3  # on each side
LOST = 0.5  # of the gradients' amplitude: edges are twice as wide
ONE_WAY = 0.6  # amplitude lost in one direction beside the other: a smear and no defocus
# One photo in twenty that is blurred like this is a pixel of every view in twenty wrong by its edges' contrast.
THRESHOLD = 0.05


def blur_evidence(gradients: Float[np.ndarray, "views 2 2"]) -> Evidence:
    """The share of photos that have lost half of their gradients in some direction.

    ``gradients``: of each photo, in order, the mean over its pixels of g g^T, g the gradient of grey values (the
    structure tensor; Förstner & Gülch 1987); NaN where it is not known. Neighbours show much the same, so a
    photo's tensor in the frame of their median's (whitened) tells blur from texture: a smear takes the smaller
    eigenvalue and leaves the larger one, defocus takes both. It is only flagged: no pilot decides on it.
    """
    amplitude = relative_gradients(gradients)
    known = np.isfinite(amplitude).all(axis=1)
    if not known.any():
        return unknown("share", THRESHOLD, "too few photos to compare", False)
    weak, strong = amplitude[known].T
    blurred = weak < LOST
    moved = blurred & (weak < ONE_WAY * strong)
    share, count = float(blurred.mean()), int(known.sum())
    noise = float(np.sqrt(max(share * (1 - share), 1 / count) / count))
    kinds = f"{moved.sum()} by motion, {blurred.sum() - moved.sum()} out of focus"
    words = f"{blurred.sum()} of {count} photos are blurred beside their neighbours, {kinds}"
    # photos are counted and not estimated: a share of those there has no noise beside the counting's
    return Evidence(share, "share", THRESHOLD, noise, share >= THRESHOLD, words)


def relative_gradients(gradients: Float[np.ndarray, "views 2 2"]) -> Float[np.ndarray, "views 2"]:
    """Of each photo the least and the largest amplitude of gradients in any direction, beside the median tensor of its
    neighbours; NaN where there are fewer than NEIGHBOURS of them or they have no texture."""
    amplitude = np.full((len(gradients), 2), np.nan)
    for view, tensor in enumerate(gradients):
        around = np.concatenate([gradients[max(0, view - NEIGHBOURS) : view], gradients[view + 1 :][:NEIGHBOURS]])
        around = around[np.isfinite(around).all(axis=(1, 2))]
        if len(around) < NEIGHBOURS or not np.isfinite(tensor).all():
            continue
        size, axes = np.linalg.eigh(np.median(around, axis=0))
        if size[0] > ONE_DIRECTION * size[1] > 0:
            white = axes / np.sqrt(size)
            amplitude[view] = np.sqrt(np.maximum(np.linalg.eigvalsh(white.T @ tensor @ white), 0.0))
    return amplitude
