"""Which parts of a raw surface to keep: what the photos cover, see and locate, without specks."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from stages.contract import StageError
from stages.mesh_surface import Surface, border_vertices, components, face_areas, is_watertight, keep_faces

if TYPE_CHECKING:
    from stages.mesh_views import Sight

Keep = Literal["visible", "largest", "all"]
SEEN_SHARE = 0.1  # of a component's area; an inner cavity has none, the seen side of an object about half
# Of a component's area, near a sparse point. Surfaces have 0.8 to 1 of theirs, sheets of sky none (docs/numbers.md).
LOCATED_SHARE = 0.1
REACH = 0.1  # scene units; farther where points stand that far apart themselves
REACH_IN_SPACINGS = 3.0


class Cleaned(NamedTuple):
    """A cleaned surface; ``uncovered`` counts the faces cut away because too few photos look there."""

    surface: Surface
    vertex: np.ndarray  # the old index of each vertex
    kept: int
    dropped: int
    uncovered: int


def located(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether a sparse point is near each vertex, (n,) bool; ``points`` (m, 3), in the same frame.

    Sparse points are where details of photos agree on a place. What has none far and wide (sky, fog) is somewhere
    only because the field had to put it somewhere. Without two points nothing is known, and all is True.
    """
    from scipy.spatial import KDTree

    if len(points) < 2:
        return np.ones(len(vertices), bool)
    tree = KDTree(points)
    spacing = float(np.median(tree.query(points, 2)[0][:, 1]))
    return tree.query(vertices, distance_upper_bound=max(REACH, REACH_IN_SPACINGS * spacing))[0] < np.inf


def clean(
    surface: Surface, sight: "Sight", near_points: np.ndarray, keep: Keep, min_views: int, min_component: float
) -> Cleaned:
    """Drop what the photos do not vouch for; ``near_points``: of each vertex, by :func:`located`.

    ``visible`` cuts the faces that fewer than ``min_views`` photos cover (depth cannot be known from one), then
    drops components that hardly any of those photos see (inner cavities), those far from all sparse points unless all
    are, and those with less than ``min_component`` of the largest one's area. ``largest`` keeps the component of
    largest area, ``all`` everything. Raises StageError if nothing remains.
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
        near = np.any(near_points[old][surface.faces], axis=1)
        good = _worth_keeping(label, face_areas(surface), seen, near, min_component)
    else:
        good = np.arange(count) < (1 if keep == "largest" else count)
    if not good.any():
        why = f"in none of its {count} components is a tenth of the area seen by {min_views} photos"
        raise StageError("no part of the surface is seen by the photos", why, "Try --mesh.keep all or --mesh.level.")
    surface, left = keep_faces(surface, good[label])
    return Cleaned(surface, old[left], int(good.sum()), int((~good).sum()), int((~covered).sum()))


def _worth_keeping(
    label: np.ndarray, area: np.ndarray, seen: np.ndarray, near: np.ndarray, min_component: float
) -> np.ndarray:
    """Whether each component is seen, located and large enough, (components,) bool."""
    total = np.bincount(label, area)
    good = (np.bincount(label, area * seen) >= SEEN_SHARE * total) & (total > 0)
    certain = good & (np.bincount(label, area * near) >= LOCATED_SHARE * total)
    good = certain if certain.any() else good
    return good & (total >= min_component * total[good].max(initial=0.0))


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
