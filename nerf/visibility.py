"""Where a field of folded space may put things, by how many photos look there.

What one photo alone sees can be explained by something at any distance, also right before its camera; and what two see
often can, where it is dark or plain. A field puts it there, in the way of every other view. (Philip and Deschaintre
2023, "Floaters No More", see the same and weaken gradients near cameras.) So before a photo's foreground, which begins
with the nearest thing that is known of, there is nothing but what several photos look at.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.depth_range import NEAR_MARGIN
from nerf.kernels.cache import cell_corners, grown
from nerf.kernels.marching import unit_coordinates
from nerf.ray_bank import RayBank
from nerf.rays import Rays

SIDE = 64  # coarse cells along an edge of the unit cube
RAYS = 32  # along each side of a photo: of one of 60 degrees they are a coarse cell apart at a distance of two
STEPS = 128  # along a ray, in equal ratios: over three decades a coarse cell long at a distance of one


class Looks(NamedTuple):
    """Of each of side³ cells of the unit cube: how many photos look into it or a neighbour, whatever hides it, and
    whether it lies in the foreground of one of them, or behind that."""

    photos: Int[Tensor, "side side side"]
    behind: Bool[Tensor, "side side side"]


def usable_cells(bank: RayBank, least: int, cells: int) -> Bool[Tensor, "cache"]:
    """Which of ``cells``³ cells of folded space, in the order of ``nerf.kernels.cache``, may hold something: those that
    ``least`` photos of ``bank`` look into, or one in its foreground or behind that."""
    side = min(SIDE, cells)
    looks = photos_looking(bank, side)
    usable = (looks.photos >= least) | looks.behind
    corners = cell_corners(cells, torch.arange(cells**3, device=bank.device))
    x, y, z = (side * corners).long().unbind(-1)
    return usable[x, y, z]


def photos_looking(bank: RayBank, side: int) -> Looks:
    """Where the photos look, between near and far."""
    count = torch.zeros(side, side, side, dtype=torch.int32, device=bank.device)
    behind = torch.zeros_like(count, dtype=torch.bool)
    ratio = torch.linspace(0, 1, STEPS, device=bank.device)
    for view in range(len(bank.near)):
        rays = _spread_rays(bank, view)
        t = rays.near[:, None] * (rays.far / rays.near)[:, None] ** ratio
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        count += grown(_touched(points.flatten(0, 1), side))
        behind |= _touched(points[NEAR_MARGIN * t >= rays.near[:, None]], side)
    return Looks(count, grown(behind))


def _spread_rays(bank: RayBank, view: int) -> Rays:
    """RAYS² rays of a photo, those of its corners among them."""
    first, end = bank.first_pixel[view : view + 2].tolist()
    width = int(bank.layout[1, view])
    row, column = (torch.linspace(0, n - 1, RAYS, device=bank.device).round() for n in ((end - first) // width, width))
    return bank.rays((first + width * row.double()[:, None] + column).flatten().long())[0]


def _touched(points: Float[Tensor, "points 3"], side: int) -> Bool[Tensor, "side side side"]:
    """The cells in which points of the scene lie."""
    x, y, z = (side * unit_coordinates(points, True)).long().clamp(0, side - 1).unbind(-1)
    touched = torch.zeros(side**3, dtype=torch.bool, device=points.device)
    touched[(x * side + y) * side + z] = True
    return touched.view(side, side, side)
