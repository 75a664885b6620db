"""How like a photo a rendering is once its exposure is that of the photo, told by pixels that did not choose it.

A field of photos that differ in exposure has one exposure of its own, and a held-out photo's is anybody's guess. The
gain (per channel, in linear light) is fitted on the left half of the photo; the right half is scored with it and, for
comparison, without.
"""

import math

import torch
from torch import Tensor

from nerf.effects import ColourEffect, ImageEffects, foreground_radiance
from nerf.effects.exposure import ExposureModel, expose, fit_log_gain
from nerf.effects.pose_refinement import fit_pose
from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.training.psnr import mean_squared_error, psnr

MIN_PIXELS = 64  # of a half


def right_half_psnr(
    rendering: Rendering, background: Tensor, truth: Tensor, used: Tensor | None = None
) -> tuple[float | None, float | None]:
    """PSNR of the right half: as rendered, and with the exposure that makes the left half like the photo.

    ``rendering`` is (H, W), shown over ``background`` (3,), which no gain changes; ``truth`` is (H, W, 3), and only
    pixels that are ``used``, (H, W) bool, count. (None, None) where a half has fewer than MIN_PIXELS of them.
    """
    if not enough(truth, used):
        return None, None
    left, right = halves(truth, used)
    light, log_gain = _exposed_as_left(rendering, background, truth, left)
    behind = rendering.colour - light
    fitted = behind[right] + expose(light[right], log_gain)
    raw, fitted = (mean_squared_error(c.clamp(0, 1), truth[right]) for c in (rendering.colour[right], fitted))
    return psnr(raw), psnr(fitted)


def from_fitted_pose(
    field: HashGridField,
    rays: Rays,
    rendering: Rendering,
    background: Tensor,
    truth: Tensor,
    used: Tensor | None,
    effects: tuple[ColourEffect, ...] = (),
    seed: int = 0,
) -> Rays:
    """``rays`` (H, W) of a photo from where its left half says that it was taken, at the exposure that suits the
    ``rendering`` of ``field`` along them through the photo's ``effects``; everything on the CPU."""
    left, _ = halves(truth, used)
    _, log_gain = _exposed_as_left(rendering, background, truth, left)
    shown = ImageEffects(colours=(*effects, ExposureModel(log_gain[None])))
    distance = viewing_distance(rendering, left)
    pose = fit_pose(field, rays.each(lambda part: part[left]), truth[left], background, shown, seed, distance)
    flat = rays.each(lambda part: part.flatten(0, 1))
    moved = pose.forward(flat, torch.zeros(len(flat.near), dtype=torch.int64))
    return Rays(*(part.view_as(whole) for part, whole in zip(moved, rays, strict=True)))


def viewing_distance(rendering: Rendering, pixels: Tensor) -> float:
    """How far away is what a rendering (H, W) shows at some pixels, (H, W) bool: the median (scene units) of those that
    are more opaque than not; infinite where none is."""
    depth = rendering.depth[pixels & (rendering.opacity > 0.5)]
    return float(depth.median()) if len(depth) else math.inf


def _exposed_as_left(rendering: Rendering, background: Tensor, truth: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """The scene's own light (H, W, 3) in a rendering, and its log gain (3,) by the pixels ``left`` of the photo."""
    light = foreground_radiance(rendering.colour, rendering.opacity, background)
    behind = rendering.colour - light
    return light, fit_log_gain(light[left], truth[left] - behind[left])


def halves(truth: Tensor, used: Tensor | None) -> tuple[Tensor, Tensor]:
    """The used pixels of the left half and those of the right half, (H, W) bool; ``truth`` is (H, W, 3)."""
    used = torch.ones(truth.shape[:2], dtype=torch.bool) if used is None else used
    in_left = torch.arange(truth.shape[1]) < truth.shape[1] // 2
    return used & in_left, used & ~in_left


def enough(truth: Tensor, used: Tensor | None) -> bool:
    """Whether both halves have the pixels that it takes."""
    return min(int(half.sum()) for half in halves(truth, used)) >= MIN_PIXELS
