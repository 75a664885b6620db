"""The density of the surface: the iso-level nearest to where the photos' own rays stop.

A radiance field has no surface, only density, and no fixed iso-level suits every field: a short training leaves
densities of a few units, a long one walls of thousands. What the photos constrain is where rays stop. So rays of the
training photos are followed through the field to their median depth (half of the transmittance lost), and of a range of
densities the one is chosen whose surface those rays meet nearest to it. Holes, crusts and floaters all count, because a
ray that stops without meeting the surface, or meets it without stopping, costs the full clip.
"""

import math
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
from skimage.filters import threshold_otsu

from nerf.fields.density_grid import DensityField, DensityGrid, along, first_crossing, ray_distances
from nerf.geometry.rays import Rays, clip_to_box, points_on
from stages.contract import StageError
from stages.mesh.marching_cubes import smoothed_occupancy

CLIP_VOXELS = 4.0
MARGIN = 1e-5
SAMPLES_PER_EDGE = 4  # along a ray, per grid point of an edge: at least two samples per voxel
RAY_CHUNK = 128
NUM_CANDIDATES = 17  # over three decades: neighbours differ by a factor of 1.5
STRIDES = (4, 2, 1)  # every fourth candidate is tried, then those next to the best, closer and closer
MIN_STOPPED = 0.01  # fraction of rays below which the photos say too little about the surface
RETRAIN = "Train for longer (--train.steps or --train.seconds)."
DIVERGED_HINT = "Train again with a tenth of --train.learning-rate: the field has diverged."


class IsoLevel(NamedTuple):
    """``density`` of the surface, per unit length of the grid's space, and why.

    ``surface_error_voxels`` is the mean clipped distance of the surface to where rays stop, None where that was not
    measured; ``well_defined`` says whether photos and surface agree.
    """

    density: float
    reason: str
    surface_error_voxels: float | None
    well_defined: bool


def check_range(grid: DensityGrid, iso_level: float | None) -> None:
    """Raise StageError for a grid in which no surface can be (non-finite, empty or constant), or a given iso-level out
    of its range."""
    broken = int((~torch.isfinite(grid.values)).sum())
    if broken:
        raise StageError(
            "mesh.density-not-finite",
            "the density is not finite",
            f"{broken} of {grid.values.numel()} grid points are NaN or infinite",
            DIVERGED_HINT,
        )
    low, high = float(grid.values.min()), float(grid.values.max())
    opacity = 1 - float(torch.exp(-high * (grid.high - grid.low).norm()))
    if opacity < 0.01:
        why = f"its density is at most {high:.3g}: a ray across the box has an opacity of {opacity:.1%}"
        raise StageError("mesh.empty-field", "the field is empty", why, RETRAIN)
    if high - low < 1e-3 * high:
        why = f"its density is {low:.3g} to {high:.3g}, the same everywhere"
        raise StageError("mesh.uniform-field", "the field has no surface", why, RETRAIN)
    if iso_level is not None and not low < iso_level < high:
        why = f"density runs from {low:.3g} to {high:.3g}"
        hint = "Give --mesh.iso-level a value in between, or leave it out for the default."
        raise StageError("mesh.level-out-of-range", f"no surface at density {iso_level:g}", why, hint)


def choose_iso_level(grid: DensityGrid, field: DensityField, rays: Rays) -> IsoLevel:
    """The density whose surface in ``grid`` lies closest to where ``rays`` lose half of their transmittance in
    the ``field``."""
    inside = clip_to_box(rays, grid.low, grid.high)
    inside = inside.each(lambda part: part[inside.far > inside.near])
    t = ray_distances(inside, SAMPLES_PER_EDGE * max(grid.values.shape))
    depth, peak = _median_depths(field, inside, t)
    stopped = torch.isfinite(depth)
    if int(stopped.sum()) < MIN_STOPPED * len(depth) or not stopped.any():
        return _otsu_level(grid, float(stopped.float().mean()) if len(depth) else 0.0)
    low, high = float(grid.values.min()), float(grid.values.max())
    peaks = peak[stopped].median() * torch.logspace(-2.5, 0.5, NUM_CANDIDATES, device=peak.device)
    # Inside the range by a fraction of its own ends: the highest density is an outlier, often of millions.
    candidates = peaks.clamp((1 + MARGIN) * low, (1 - MARGIN) * high).tolist()
    voxel = float(grid.spacing().max())

    def error(index: int) -> float:
        surface = first_crossing(along(smoothed_occupancy(grid, candidates[index]), inside, t), t, 0.5)
        return _surface_error(surface, depth, voxel)

    errors, best = {}, 0
    for stride in STRIDES:
        near = range(0, NUM_CANDIDATES, stride) if not errors else (best - stride, best + stride)
        errors |= {index: error(index) for index in near if 0 <= index < NUM_CANDIDATES and index not in errors}
        best = min(errors, key=errors.__getitem__)
    first, last = (f"{level:.2g}" if level < 10 else f"{level:.0f}" for level in (candidates[0], candidates[-1]))
    reason = (
        f"of densities from {first} to {last}, its surface is closest to where the transmittance of {len(depth):,} "
        f"rays of the photos falls to one half: {errors[best]:.2f} voxels away on average"
    )
    return IsoLevel(candidates[best], reason, errors[best], errors[best] < CLIP_VOXELS / 2)


def _median_depths(field: DensityField, rays: Rays, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where each ray has lost half of its transmittance (infinite: nowhere), and the largest density up to there.

    The field itself is asked, not the grid: between two grid points a wall thinner than a voxel looks like a ramp that
    stops a ray a voxel too early. Midpoint rule, so that a jump between samples is off by nothing on average.
    """
    middle = (t[:, 1:] + t[:, :-1]) / 2
    density = torch.empty_like(middle)
    with torch.no_grad():
        for row in range(0, len(t), RAY_CHUNK):
            part = slice(row, row + RAY_CHUNK)
            density[part] = field.density(points_on(rays.each(itemgetter(part)), middle[part])).float()
    thickness = torch.nn.functional.pad((density * t.diff(dim=-1)).cumsum(-1), (1, 0))
    depth = first_crossing(thickness, t, math.log(2))
    return depth, torch.where(t[:, :-1] <= depth[:, None], density, 0.0).amax(-1)


def _surface_error(surface: torch.Tensor, depth: torch.Tensor, voxel: float) -> float:
    both_pass = torch.isinf(surface) & torch.isinf(depth)
    distance = torch.where(both_pass, 0.0, (surface - depth).abs())
    return float((distance / voxel).clamp(max=CLIP_VOXELS).mean())


def _otsu_level(grid: DensityGrid, stopped: float) -> IsoLevel:
    """Otsu's threshold (1979) on the logarithm of the density, for fields in which hardly any ray stops."""
    values = grid.values.cpu().numpy()
    level = float(np.exp(threshold_otsu(np.log(values[values > 1e-3 * values.max()]))))
    reason = (
        f"only {stopped:.1%} of the photos' rays lose half of their transmittance in the box, so the field has "
        "no surface yet; Otsu's threshold on its log density is used"
    )
    return IsoLevel(level, reason, None, False)
