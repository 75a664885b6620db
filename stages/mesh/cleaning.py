"""Which parts of a raw surface to keep: what the photos cover, see and locate, without specks."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.contract import StageError
from stages.mesh.surface import Surface, border_vertices, components, face_areas, is_watertight, keep_faces

if TYPE_CHECKING:
    from scipy.spatial import KDTree

    from stages.mesh import Keep
    from stages.mesh.visibility import Sight

# Of the photos that look at a vertex. What is there is seen by about half of them, nine vertices in ten by a quarter;
# what only shows itself past the edge of something else is seen by less (docs/experiments/mesh.md).
SEEN_OF_LOOKING = 0.2
HIDDEN_STEPS = 10  # from vertex to vertex, by which a face may be away from what photos see: creases and gaps close
SEEN_SHARE = 0.1  # of a component's area; an inner cavity has none, the seen side of an object about half
# Of a component's area, near a sparse point. Of the demo's table 41 % lies within 0.03 of one, 57 % within 0.05; of
# sheets of sky below it nothing within 0.3 (docs/experiments/mesh.md).
LOCATED_SHARE = 0.1
REACH, REACH_IN_SPACINGS = 0.1, 3.0  # scene units; of the distance from a sparse point to the next, if that is more
FEWEST_POINTS = 50  # near the surface; fewer tell nothing of what is far from them


class Cleaned(NamedTuple):
    """A cleaned surface; ``uncovered`` counts the faces cut away because too few photos look there, ``hidden`` those
    cut because too few of these see them and no sparse point is near."""

    surface: Surface
    vertex: np.ndarray  # the old index of each vertex
    kept: int
    dropped: int
    uncovered: int
    hidden: int


def clean(
    surface: Surface, sight: "Sight", points: np.ndarray, keep: "Keep", min_views: int, min_component: float
) -> Cleaned:
    """Drop what the photos do not vouch for; ``points`` are the sparse ones (n, 3), in the frame of the surface.

    ``visible`` cuts the faces that fewer than ``min_views`` photos cover (depth cannot be known from one) and those
    that too few of them see, with no sparse point near (sky that hangs on the back of a table), then drops components
    that hardly any photos see (inner cavities), those that :func:`_located` has no place for, and those with less than
    ``min_component`` of the largest one's area. ``largest`` keeps the component of largest area, ``all`` everything.
    Raises StageError if nothing remains.
    """
    covered = np.all(sight.covered[surface.faces] >= min_views, axis=1) | (keep != "visible")
    if not covered.any():
        why = f"none of its {len(surface.faces)} faces lies in {min_views} photos between near and far"
        raise StageError(
            "mesh.nothing-covered", "no part of the surface is covered by the photos", why, "Try --mesh.keep all."
        )
    surface, old = keep_faces(surface, covered)
    hidden = 0
    if keep == "visible":
        seen = sight.seen[old] >= np.maximum(min_views, SEEN_OF_LOOKING * sight.covered[old])
        cut = _hidden(surface, seen, points)
        surface, left = keep_faces(surface, ~cut)
        old, hidden = old[left], int(cut.sum())
    label = components(surface)
    count = int(label.max()) + 1
    if keep == "visible":
        seen = np.any(sight.seen[old][surface.faces] >= min_views, axis=1)
        good = _worth_keeping(surface, label, seen, points, min_component)
    else:
        good = np.arange(count) < (1 if keep == "largest" else count)
    if not good.any():
        why = f"in none of its {count} components is a tenth of the area seen by {min_views} photos"
        raise StageError(
            "mesh.nothing-seen",
            "no part of the surface is seen by the photos",
            why,
            "Try --mesh.keep all or --mesh.level.",
        )
    surface, left = keep_faces(surface, good[label])
    return Cleaned(surface, old[left], int(good.sum()), int((~good).sum()), int((~covered).sum()), hidden)


def _hidden(surface: Surface, seen: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which faces have a vertex that is neither within HIDDEN_STEPS edges of a ``seen`` one nor within reach of a
    sparse point, (faces,) bool; none where there are too few points to tell, or where that would be all."""
    if len(points) < FEWEST_POINTS:
        return np.zeros(len(surface.faces), bool)
    tree, reach = _places(points)
    vouched = np.isfinite(tree.query(surface.vertices, distance_upper_bound=reach)[0])
    for _ in range(HIDDEN_STEPS):
        seen = _grown(surface.faces, seen)
    hidden = ~(vouched | seen)[surface.faces].all(1)
    return hidden & ~hidden.all()


def _grown(faces: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """The ``marked`` vertices and all that share a face with one."""
    grown = marked.copy()
    grown[faces[marked[faces].any(1)]] = True
    return grown


def _worth_keeping(
    surface: Surface, label: np.ndarray, seen: np.ndarray, points: np.ndarray, min_component: float
) -> np.ndarray:
    """Whether each component is seen, located and large enough, (components,) bool."""
    area = face_areas(surface)
    total = np.bincount(label, area)
    good = _have(label, area, seen, SEEN_SHARE) & (total > 0)
    good = _located(surface, label, area, points, good)
    return good & (total >= min_component * total[good].max(initial=0.0))


def _located(surface: Surface, label: np.ndarray, area: np.ndarray, points: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Which of the ``good`` components have sparse points near a tenth of their area.

    Sparse points are where details of photos agree on a place. What has none far and wide (sky, fog) is somewhere
    only because the field had to put it somewhere. All stay where that cannot be told: where few points are near any,
    or more of them near those that would go than near those that would stay (a bare wall, and a speck on it).
    """
    from scipy.spatial import KDTree

    if len(points) < FEWEST_POINTS:
        return good
    tree, reach = _places(points)
    near = np.isfinite(tree.query(surface.vertices, distance_upper_bound=reach)[0])
    certain = good & _have(label, area, near[surface.faces].any(1), LOCATED_SHARE)

    of_vertex = np.zeros(len(surface.vertices), label.dtype)
    of_vertex[surface.faces] = label[:, None]
    distance, vertex = KDTree(surface.vertices).query(points, distance_upper_bound=reach)
    holder = of_vertex[np.asarray(vertex)[np.isfinite(distance)]]
    held, of_certain = (int(which[holder].sum()) for which in (good, certain))
    return certain if held >= FEWEST_POINTS and of_certain >= held / 2 else good


def _places(points: np.ndarray) -> "tuple[KDTree, float]":
    """The sparse points, to be searched, and how near one has to be to be near."""
    from scipy.spatial import KDTree

    tree = KDTree(points)
    spacing = float(np.median(tree.query(points, 2)[0][:, 1]))
    return tree, max(REACH, REACH_IN_SPACINGS * spacing)


def _have(label: np.ndarray, area: np.ndarray, marked: np.ndarray, share: float) -> np.ndarray:
    """Whether the ``marked`` faces are so large a share of each component's area, (components,) bool."""
    return np.bincount(label, area * marked) >= share * np.bincount(label, area)


def openness(surface: Surface, box: np.ndarray, voxel: float) -> str:
    """Where the surface ends: "watertight", or "open" and the places, for a lattice over a box (2, 3)."""
    if is_watertight(surface):
        return "watertight"
    border = border_vertices(surface)
    if len(border) == 0:
        return "closed, but not a manifold"
    at_box = ((border < box[0] + voxel / 2) | (border > box[1] - voxel / 2)).any(axis=1)
    places = [("at the box", at_box.any()), ("where too few photos look", not at_box.all())]
    return "open " + " and ".join(place for place, present in places if present)
