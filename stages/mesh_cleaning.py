"""Which parts of a raw surface to keep: what the photos cover and see, without specks."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from stages.contract import StageError
from stages.mesh_surface import Surface, border_vertices, components, face_areas, is_watertight, keep_faces

if TYPE_CHECKING:
    from stages.mesh_views import Sight

Keep = Literal["visible", "largest", "all"]
SEEN_SHARE = 0.1  # of a component's area; an inner cavity has none, the seen side of an object about half


class Cleaned(NamedTuple):
    """A cleaned surface; ``uncovered`` counts the faces cut away because too few photos look there."""

    surface: Surface
    vertex: np.ndarray  # the old index of each vertex
    kept: int
    dropped: int
    uncovered: int


def clean(surface: Surface, sight: "Sight", keep: Keep, min_views: int, min_component: float) -> Cleaned:
    """Drop what the photos do not vouch for.

    ``visible`` cuts the faces that fewer than ``min_views`` photos cover (depth cannot be known from one), then
    drops components that hardly any of those photos see (inner cavities) and those with less than
    ``min_component`` of the largest one's area. ``largest`` keeps the component of largest area, ``all`` everything.
    Raises StageError if nothing remains.
    """
    covered = np.all(sight.covered[surface.faces] >= min_views, axis=1) | (keep != "visible")
    if not covered.any():
        why = f"none of its {len(surface.faces)} faces lies in {min_views} photos between near and far"
        raise StageError("no part of the surface is covered by the photos", why, "Try --mesh.keep all.")
    surface, old = keep_faces(surface, covered)
    label = components(surface)
    count = int(label.max()) + 1
    if keep == "visible":
        seen = np.any(sight.seen[old][surface.faces] >= min_views, axis=1)
        good = _worth_keeping(label, face_areas(surface), seen, min_component)
    else:
        good = np.arange(count) < (1 if keep == "largest" else count)
    if not good.any():
        why = f"in none of its {count} components is a tenth of the area seen by {min_views} photos"
        raise StageError("no part of the surface is seen by the photos", why, "Try --mesh.keep all or --mesh.level.")
    surface, left = keep_faces(surface, good[label])
    return Cleaned(surface, old[left], int(good.sum()), int((~good).sum()), int((~covered).sum()))


def _worth_keeping(label: np.ndarray, area: np.ndarray, seen: np.ndarray, min_component: float) -> np.ndarray:
    """Whether each component is seen and large enough, (components,) bool."""
    total = np.bincount(label, area)
    visible = np.bincount(label, area * seen) >= SEEN_SHARE * total
    visible &= total > 0
    return visible & (total >= min_component * total[visible].max(initial=0.0))


def openness(surface: Surface, half_box: float, voxel: float) -> str:
    """Where the surface ends: "watertight", or "open" and the places, for a lattice over [-half_box, half_box]^3."""
    if is_watertight(surface):
        return "watertight"
    border = border_vertices(surface)
    if len(border) == 0:
        return "closed, but not a manifold"
    at_box = np.abs(border).max(axis=1) > half_box - voxel / 2
    places = [("at the box", at_box.any()), ("where too few photos look", not at_box.all())]
    return "open " + " and ".join(place for place, present in places if present)
