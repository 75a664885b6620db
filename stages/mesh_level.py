"""At which density is the surface? Where the photos' own rays stop.

A radiance field has no surface, only density, and no fixed level suits every field: a short training leaves
a fog of a few units, a long one walls of thousands. What the photos constrain is where light stops. So the
rays of the training photos are followed through the lattice to their median depth (half of the light lost), and of a range
of levels the one is taken whose surface those rays meet nearest to it. Holes, crusts and floaters all count,
because a ray that stops without meeting the surface, or meets it without stopping, costs the full clip.
"""

from typing import TYPE_CHECKING, NamedTuple

from stages.contract import StageError

if TYPE_CHECKING:
    import torch

    from nerf.lattice import Lattice
    from nerf.rays import Rays

CLIP_VOXELS = 4.0
LEVELS = 17  # four per decade and two ends: neighbours differ by a factor of 1.54
MIN_STOPPED = 0.01  # share of rays below which the photos say too little about the surface


class Level(NamedTuple):
    """The density chosen for the surface, per scene unit; ``miss_voxels`` is the mean clipped distance, or None."""

    level: float
    reason: str
    miss_voxels: float | None


def check_range(lattice: "Lattice", level: float | None) -> None:
    """Refuse lattices in which no surface can be: non-finite, empty or constant, or a given level out of range."""
    import torch

    broken = int((~torch.isfinite(lattice.values)).sum())
    if broken:
        raise StageError(
            "the density is not finite",
            f"{broken} of {lattice.values.numel()} lattice points are NaN or infinite",
            "Train again: the field is broken.",
        )
    low, high = float(lattice.values.min()), float(lattice.values.max())
    through = 1 - float(torch.exp(-high * (lattice.high - lattice.low).norm()))
    if through < 0.01:
        why = f"its density is at most {high:.3g} per scene unit, which stops {through:.1%} of a ray across the box"
        raise StageError("the field is empty", why, "Train for longer (--train.steps or --train.seconds).")
    if high - low < 1e-3 * high:
        why = f"its density is {low:.3g} to {high:.3g} per scene unit, the same everywhere"
        raise StageError("the field has no surface", why, "Train for longer (--train.steps or --train.seconds).")
    if level is not None and not low < level < high:
        why = f"density runs from {low:.3g} to {high:.3g} per scene unit"
        hint = "Give --mesh.level a value in between, or leave it out to have one chosen."
        raise StageError(f"no surface at density {level:g}", why, hint)


def choose_level(lattice: "Lattice", rays: "Rays") -> Level:
    """The density whose surface lies closest to where ``rays`` lose half of their light (see the module)."""
    import torch

    from nerf.lattice import along, box_interval, first_crossing, occupancy, optical_depth, ray_distances

    inside = box_interval(rays, lattice.low, lattice.high)
    inside = type(rays)(*(part[inside.far > inside.near] for part in inside))
    t = ray_distances(inside, 2 * max(lattice.values.shape))
    density = along(lattice, inside, t)
    stop = first_crossing(optical_depth(density, t), t, float(torch.log(torch.tensor(2.0))))
    stopped = torch.isfinite(stop)
    share = float(stopped.float().mean()) if stopped.numel() else 0.0
    if share < MIN_STOPPED:
        return _thickest_fog(lattice, share)
    peak = torch.where(t <= stop[:, None], density, 0.0)[stopped].amax(-1).median()
    candidates = (peak * torch.logspace(-2.5, 0.5, LEVELS)).clamp(max=0.99 * float(lattice.values.max())).tolist()
    voxel = float(lattice.spacing().max())
    misses = [
        _miss(first_crossing(along(occupancy(lattice, level), inside, t), t, 0.5), stop, voxel) for level in candidates
    ]
    best = min(range(len(misses)), key=misses.__getitem__)
    reason = (
        f"of {LEVELS} levels from {candidates[0]:.2g} to {candidates[-1]:.2g}, its surface lies closest to where "
        f"{len(stop)} rays of the photos lose half of their light: {misses[best]:.2g} voxels away on average"
    )
    return Level(candidates[best], reason, misses[best])


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
    return Level(level, reason, None)
