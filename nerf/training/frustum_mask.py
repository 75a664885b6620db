"""Where a field of unbounded space may put things, by how many photos look there.

What one photo alone sees can be explained by something at any distance, also right before its camera; and what two see
often can, where it is dark or plain. A field puts it there, in the way of every other view. (Philip and Deschaintre
2023, "Floaters No More", see the same and weaken gradients near cameras.) So before a photo's foreground, which begins
at the sparse points nearest to it, there is nothing but what several photos look at.
"""

from collections.abc import MutableMapping
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from nerf.geometry.near_far import NEAR_MARGIN
from nerf.geometry.space_maps import SpaceMap
from nerf.kernels.torch.occupancy import cell_corners, grown
from nerf.runtime.parallel import in_order
from nerf.training.ray_dataset import CENTRE, NEAR_AND_FAR, ROTATION, RayDataset

SIDE = 64  # coarse cells along an edge of the unit cube
EDGE_PIXELS = 16  # along each side of a photo, from which its field of view is known
TOGETHER = 16  # photos that look at once, on all cores, at what is undecided; fixed, whatever the cores


# Of datasets that are in use, by their geometry: all trainers of a run ask for the same, and so do all of its pilots.
_answers: MutableMapping[Tensor, dict[tuple[SpaceMap, int, int], Tensor]] = WeakTensorKeyDictionary()


def compute_frustum_mask(dataset: RayDataset, space: SpaceMap, least: int, cells: int) -> Bool[Tensor, "cells"]:
    """Which of ``cells``³ cells of an unbounded ``space``, in the order of ``nerf.kernels.torch.occupancy``, may hold
    something: those whose middles ``least`` photos of ``dataset`` look at, or one, from where its foreground begins;
    and a coarse cell around them. What hides them, and masks, count for nothing. Found once for a dataset; not to be
    written to."""
    answers = _answers.setdefault(dataset.view_geometry, {})
    if (space, least, cells) not in answers:
        answers[space, least, cells] = _compute_frustum_mask(dataset, space, least, cells)
    return answers[space, least, cells]


def _compute_frustum_mask(dataset: RayDataset, space: SpaceMap, least: int, cells: int) -> Bool[Tensor, "cells"]:
    side, views = min(SIDE, cells), range(len(dataset.near))
    middles = _middles(space, side, dataset.device)
    undecided = torch.arange(side**3, device=dataset.device)
    photos = torch.zeros_like(undecided)
    for first in range(0, len(views), TOGETHER):
        decided = torch.zeros_like(undecided, dtype=torch.bool)
        together = views[first : first + TOGETHER]
        for seen, in_foreground in in_order(partial(_looked_at, dataset, middles), together, dataset.device):
            photos += seen
            decided |= in_foreground
        still = (~decided & (photos < least)).nonzero()[:, 0]
        undecided, photos, middles = undecided[still], photos[still], middles[:, still]
    usable = torch.ones(side**3, dtype=torch.bool, device=dataset.device)
    usable[undecided] = False
    corners = cell_corners(cells, torch.arange(cells**3, device=dataset.device))
    x, y, z = (side * corners).long().unbind(-1)
    return grown(usable.view(side, side, side))[x, y, z]


def _middles(space: SpaceMap, side: int, device: torch.device) -> Float[Tensor, "3 cells"]:
    """Where the middles of side³ cells of the unit cube are in the scene."""
    line = 2 * space.half * ((torch.arange(side, device=device) + 0.5) / side - 0.5)
    middles = space.inverse(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1))
    return middles.flatten(0, 2).T.contiguous()


def _looked_at(
    dataset: RayDataset, points: Float[Tensor, "3 points"], view: int
) -> tuple[Bool[Tensor, "points"], Bool[Tensor, "points"]]:
    """Which points a photo may show between near and far, and which of these are no nearer than its foreground."""
    geometry = dataset.view_geometry[:, view]
    from_scene, (near, far) = geometry[ROTATION].view(3, 3).T, geometry[NEAR_AND_FAR]
    field = _angles(from_scene @ _spread_directions(dataset, view).T)
    local = from_scene @ (points - geometry[CENTRE, None])
    angles, distance = _angles(local), local.square().sum(0).sqrt()
    inside = (angles >= field.amin(1, keepdim=True)) & (angles <= field.amax(1, keepdim=True))
    seen = inside.all(0) & (distance >= near) & (distance <= far)
    return seen, seen & (NEAR_MARGIN * distance >= near)


def _angles(vectors: Float[Tensor, "3 n"]) -> Float[Tensor, "2 n"]:
    """How far to the right and down of the optical axis vectors in a camera's frame point, in radians. A photo without
    distortion is a rectangle of them."""
    return torch.atan2(vectors[:2], vectors[2:])


def _spread_directions(dataset: RayDataset, view: int) -> Float[Tensor, "rays 3"]:
    """Of EDGE_PIXELS² rays of a photo, those of its corners among them."""
    first, end = dataset.first_pixel[view : view + 2].tolist()
    width = int(dataset.width[view])
    share = torch.linspace(0, 1, EDGE_PIXELS, dtype=torch.float64, device=dataset.device)
    row, column = (((n - 1) * share).round().long() for n in ((end - first) // width, width))
    return dataset.rays((first + width * row[:, None] + column).flatten())[0].directions
