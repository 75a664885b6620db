"""Where enough photos look for anything to stand there.

What one photo alone sees can be explained by something at any distance, also right before its camera; and what two see
often can, where it is dark or plain. A field puts it there, and there it is in the way of every other view. (The same
is seen, and met by weaker gradients near cameras, in Philip and Deschaintre 2023, "Floaters No More".)
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from nerf.kernels.cache import cell_corners, grown
from nerf.kernels.marching import unit_coordinates
from nerf.ray_bank import RayBank
from nerf.rays import Rays

SIDE = 64  # coarse cells along an edge of the unit cube
RAYS = 32  # along each side of a photo: of one of 60 degrees they are a coarse cell apart at a distance of two
STEPS = 128  # along a ray, in equal ratios: over three decades a coarse cell long at a distance of one
FIRST = 1e-4  # of far: where a ray that begins at its camera is first looked at


def well_seen(bank: RayBank, least: int, cells: int, contracted: bool) -> Bool[Tensor, "cache"]:
    """Which of ``cells``³ cells, in the order of ``nerf.kernels.cache``, may hold something: those that ``least``
    photos of ``bank`` look into, between near and far, and those with a point whose distance it knows. Both with a
    coarse cell around them."""
    side = min(SIDE, cells)
    seen = photos_looking(bank, side, contracted) >= least
    if bank.known is not None and bank.distance is not None:
        rays, _ = bank.rays(bank.known)
        points = rays.origins + bank.distance[:, None] * rays.directions
        seen |= grown(_touched(points, side, contracted))
    corners = cell_corners(cells, torch.arange(cells**3, device=bank.device))
    x, y, z = (side * corners).long().unbind(-1)
    return seen[x, y, z]


def photos_looking(bank: RayBank, side: int, contracted: bool) -> Int[Tensor, "side side side"]:
    """How many photos look into each of side³ cells of the unit cube or its neighbours, whatever hides them."""
    count = torch.zeros(side, side, side, dtype=torch.int32, device=bank.device)
    ratio = torch.linspace(0, 1, STEPS, device=bank.device)
    for view in range(len(bank.near)):
        rays = _spread_rays(bank, view)
        start = rays.near.maximum(FIRST * rays.far)
        t = start[:, None] * (rays.far / start)[:, None] ** ratio
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        count += grown(_touched(points.flatten(0, 1), side, contracted))
    return count


def _spread_rays(bank: RayBank, view: int) -> Rays:
    """RAYS² rays of a photo, those of its corners among them."""
    first, end = bank.first_pixel[view : view + 2].tolist()
    width = int(bank.layout[1, view])
    row, column = (torch.linspace(0, n - 1, RAYS, device=bank.device).round() for n in ((end - first) // width, width))
    return bank.rays((first + width * row.double()[:, None] + column).flatten().long())[0]


def _touched(points: Tensor, side: int, contracted: bool) -> Bool[Tensor, "side side side"]:
    """The cells in which points (n, 3) of the scene lie; those outside of a box lie in none."""
    unit = unit_coordinates(points, contracted)
    cell = (side * unit[((unit >= 0) & (unit <= 1)).all(-1)]).long().clamp(max=side - 1)
    touched = torch.zeros(side**3, dtype=torch.bool, device=points.device)
    touched[(cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]] = True
    return touched.view(side, side, side)
