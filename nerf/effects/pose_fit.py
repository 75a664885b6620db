"""Where a photo was taken from, found against a finished field: for photos that took no part in training it."""

from operator import itemgetter

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.effects import AS_RENDERED, PhotoColours, Seen
from nerf.effects.pose_refinement import LARGEST_UNIT, RefinedPoses
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.rays import Rays
from nerf.runtime.randomness import generator

STEPS = 40
RAYS = 256  # looked at in a step
RATE = 3e-3  # radians and units of shift at first, falling exponentially to
LR_FINAL_FRACTION = 0.1  # of it


def fit_pose(
    model: HashGridField,
    rays: Rays,
    target: Float[Tensor, "pixels 3"],
    background: Float[Tensor, "3"],
    photo_colours: PhotoColours = AS_RENDERED,
    seed: int = 0,
    distance: float = LARGEST_UNIT,
) -> RefinedPoses:
    """The correction of one photo's pose that makes the field look most like it, by Adam on the squared error.

    ``rays`` and ``target`` are pixels of that photo (those by which the pose may be judged), ``photo_colours`` says
    what the photo makes of colours; both it and the field stay as they are. ``distance`` (scene units) is that of what
    the photo shows. The correction and ``photo_colours`` know a single view, 0.
    """
    here = torch.zeros(1, 3, device=target.device)
    pose, random = RefinedPoses(here, here.new_tensor([distance])), generator(target.device, seed)
    mean, square = ({name: torch.zeros_like(part) for name, part in pose.parameters.items()} for _ in range(2))
    for step in range(STEPS):
        pixel = torch.randint(len(target), (min(RAYS, len(target)),), generator=random, device=target.device)
        places = torch.rand(2, len(pixel), generator=random, device=target.device)
        some = rays.each(itemgetter(pixel))
        gradients = _gradients(model, pose, photo_colours, (some, target[pixel], background), places)
        rate = RATE * LR_FINAL_FRACTION ** (step / (STEPS - 1))
        for name, gradient in gradients.items():
            model.backend.adam(pose.parameters[name], gradient, mean[name], square[name], rate, step + 1)
    return pose


def _gradients(
    model: HashGridField,
    pose: RefinedPoses,
    photo_colours: PhotoColours,
    pixels: tuple[Rays, Float[Tensor, "pixels 3"], Float[Tensor, "3"]],
    places: Float[Tensor, "2 pixels"],
) -> dict[str, Tensor]:
    """Of the mean squared error on ``pixels`` (rays, colours, the background behind them), by the pose. ``places``:
    where samples stand in their intervals, and which thin ones are kept."""
    rays, target, background = pixels
    view = torch.zeros(len(target), dtype=torch.int64, device=target.device)
    jitter, offset = places
    done = model.forward(pose.forward(rays, view), jitter, offset, background.expand_as(target).contiguous())
    seen = Seen(done.rendering, background, view)
    residual = photo_colours.residual(seen, target)
    grad, _ = photo_colours.backward(seen, residual * (2 / residual.numel()))
    gradients = model.backward(done, grad, torch.zeros_like(done.weights))
    return pose.backward(rays, view, lambda: model.rays_backward(done, gradients))
