"""At which density is the surface? Where the photos' own rays stop.

A radiance field has no surface, only density, and no fixed level suits every field: a short training leaves
a fog of a few units, a long one walls of thousands. What the photos constrain is where light stops. So rays of the
training photos are followed through the field to their median depth (half of the light lost), and of a range of
levels the one is taken whose surface those rays meet nearest to it. Holes, crusts and floaters all count, because
a ray that stops without meeting the surface, or meets it without stopping, costs the full clip.
"""

import math
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

from stages.contract import StageError

if TYPE_CHECKING:
    import torch

    from nerf.fields.density_grid import Lattice
    from nerf.fields.interface import RadianceModel
    from nerf.geometry.rays import Rays

CLIP_VOXELS = 4.0
MARGIN = 1e-5
SAMPLES_PER_EDGE = 4  # along a ray, per lattice point of an edge: at least two samples per voxel
RAYS_AT_A_TIME = 128
LEVELS = 17  # over three decades: neighbours differ by a factor of 1.5
STRIDES = (4, 2, 1)  # of the levels: every fourth is tried, then those next to the best, closer and closer
MIN_STOPPED = 0.01  # share of rays below which the photos say too little about the surface


class Level(NamedTuple):
    """The density of the surface, per scene unit.

    ``miss_voxels`` is the mean clipped distance of the surface to where rays stop, None where that was not measured;
    ``clear`` says whether photos and surface agree.
    """

    level: float
    reason: str
    miss_voxels: float | None
    clear: bool


def check_range(lattice: "Lattice", level: float | None) -> None:
    """Refuse lattices in which no surface can be: non-finite, empty or constant, or a given level out of range."""
    import torch

    broken = int((~torch.isfinite(lattice.values)).sum())
    if broken:
        raise StageError(
            "mesh.density-not-finite",
            "the density is not finite",
            f"{broken} of {lattice.values.numel()} lattice points are NaN or infinite",
            "Train again: the field is broken.",
        )
    low, high = float(lattice.values.min()), float(lattice.values.max())
    through = 1 - float(torch.exp(-high * (lattice.high - lattice.low).norm()))
    if through < 0.01:
        why = f"its density is at most {high:.3g} per scene unit, which stops {through:.1%} of a ray across the box"
        raise StageError(
            "mesh.empty-field", "the field is empty", why, "Train for longer (--train.steps or --train.seconds)."
        )
    if high - low < 1e-3 * high:
        why = f"its density is {low:.3g} to {high:.3g} per scene unit, the same everywhere"
        raise StageError(
            "mesh.uniform-field",
            "the field has no surface",
            why,
            "Train for longer (--train.steps or --train.seconds).",
        )
    if level is not None and not low < level < high:
        why = f"density runs from {low:.3g} to {high:.3g} per scene unit"
        hint = "Give --mesh.level a value in between, or leave it out to have one chosen."
        raise StageError("mesh.level-out-of-range", f"no surface at density {level:g}", why, hint)


def choose_level(lattice: "Lattice", model: "RadianceModel", rays: "Rays") -> Level:
    """The density whose surface in ``lattice`` lies closest to where ``rays`` lose half of their light in ``model``."""
    import torch

    from nerf.fields.density_grid import along, first_crossing, ray_distances
    from nerf.geometry.rays import clip_to_box
    from stages.mesh.surface import solidity

    inside = clip_to_box(rays, lattice.low, lattice.high)
    inside = inside.each(lambda part: part[inside.far > inside.near])
    t = ray_distances(inside, SAMPLES_PER_EDGE * max(lattice.values.shape))
    stop, peak = _stops(model, inside, t)
    stopped = torch.isfinite(stop)
    if int(stopped.sum()) < MIN_STOPPED * len(stop) or not stopped.any():
        return _thickest_fog(lattice, float(stopped.float().mean()) if len(stop) else 0.0)
    low, high = float(lattice.values.min()), float(lattice.values.max())
    peaks = peak[stopped].median() * torch.logspace(-2.5, 0.5, LEVELS, device=peak.device)
    # Inside the range by a part of its own ends: the highest density is an outlier, often of millions.
    candidates = peaks.clamp((1 + MARGIN) * low, (1 - MARGIN) * high).tolist()
    voxel = float(lattice.spacing().max())

    def miss(index: int) -> float:
        surface = first_crossing(along(solidity(lattice, candidates[index]), inside, t), t, 0.5)
        return _miss(surface, stop, voxel)

    misses, best = {}, 0
    for stride in STRIDES:
        near = range(0, LEVELS, stride) if not misses else (best - stride, best + stride)
        misses |= {index: miss(index) for index in near if 0 <= index < LEVELS and index not in misses}
        best = min(misses, key=misses.__getitem__)
    tried = " to ".join(f"{level:.2g}" if level < 10 else f"{level:.0f}" for level in (candidates[0], candidates[-1]))
    reason = (
        f"its surface lies closest to where {len(stop)} rays of the photos lose half of their light, "
        f"{misses[best]:.2f} voxels away on average (tried {tried})"
    )
    return Level(candidates[best], reason, misses[best], misses[best] < CLIP_VOXELS / 2)


def _stops(model: "RadianceModel", rays: "Rays", t: "torch.Tensor") -> "tuple[torch.Tensor, torch.Tensor]":
    """Where each ray has lost half of its light (infinite: nowhere), and the largest density met until there.

    The field itself is asked, not the lattice: between two lattice points a wall thinner than a voxel looks like a
    ramp that stops light a voxel too early. Midpoint rule, so that a jump between samples is off by nothing on average.
    """
    import torch

    from nerf.fields.density_grid import first_crossing
    from nerf.geometry.rays import points_on

    middle = (t[:, 1:] + t[:, :-1]) / 2
    density = torch.empty_like(middle)
    with torch.no_grad():
        for row in range(0, len(t), RAYS_AT_A_TIME):
            part = slice(row, row + RAYS_AT_A_TIME)
            density[part] = model.density(points_on(rays.each(itemgetter(part)), middle[part])).float()
    depth = torch.nn.functional.pad((density * t.diff(dim=-1)).cumsum(-1), (1, 0))
    stop = first_crossing(depth, t, math.log(2))
    return stop, torch.where(t[:, :-1] <= stop[:, None], density, 0.0).amax(-1)


def _miss(surface: "torch.Tensor", stop: "torch.Tensor", voxel: float) -> float:
    import torch

    both_pass = torch.isinf(surface) & torch.isinf(stop)
    distance = torch.where(both_pass, 0.0, (surface - stop).abs())
    return float((distance / voxel).clamp(max=CLIP_VOXELS).mean())


def _thickest_fog(lattice: "Lattice", share: float) -> Level:
    """Otsu's threshold (1979) on the logarithm of the density, for fields that hardly stop any light."""
    import numpy as np
    from skimage.filters import threshold_otsu

    values = lattice.values.cpu().numpy()
    level = float(np.exp(threshold_otsu(np.log(values[values > 1e-3 * values.max()]))))
    reason = (
        f"only {share:.1%} of the photos' rays lose half of their light in the box, so the field is still fog; "
        "this level splits thick from thin (Otsu on log density)"
    )
    return Level(level, reason, None, False)
