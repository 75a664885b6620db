"""Which parts of a raw surface to keep: what the photos see and sparse points support, without specks."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from stages.contract import StageError
from stages.mesh.grid_space import VoxelSize
from stages.mesh.surface import (
    Surface,
    border_indices,
    border_vertices,
    components,
    face_areas,
    is_watertight,
    keep_faces,
    neighbour_means,
)
from stages.mesh.visibility import Visibility

if TYPE_CHECKING:
    from stages.mesh import Keep

# Of the photos whose frustums hold a vertex. A true surface is visible in about half of them, nine vertices in ten in a
# quarter; what only shows past the edge of something else is visible in fewer (docs/experiments/mesh.md).
MIN_VISIBLE_FRACTION = 0.2
DILATION_STEPS = 10  # edges from a visible vertex within which faces are kept: creases and gaps close
# The same of the mean around a vertex, that many edges far: sheets that show here and there have a seventh.
MIN_MEAN_VISIBLE_FRACTION, AVERAGING_STEPS = 0.25, 10
FRINGE_STEPS = 1  # edges of the decimated surface (docs/experiments/mesh.md)
MIN_VISIBLE_AREA = 0.1  # of a component's; an inner cavity has none, the visible side of an object about half
# Of a component's area, near a sparse point. Of the demo's table 41 % lies within 0.03 of one, 57 % within 0.05; of
# sheets of sky below it nothing within 0.3 (docs/experiments/mesh.md).
MIN_SUPPORTED_AREA = 0.1
# How near is near: in scene units, or in median distances from a sparse point to the next, whichever is more.
SUPPORT_RADIUS, SUPPORT_RADIUS_SPACINGS = 0.1, 3.0
MIN_POINTS = 50  # near the surface; fewer say nothing about surface far from them


class Cleaned(NamedTuple):
    """A cleaned surface. ``outside`` counts the faces removed because too few photos' frustums hold them, ``hidden``
    those removed because they are visible in too few of these photos and no sparse point is near."""

    surface: Surface
    vertex: np.ndarray  # the old index of each vertex
    kept: int
    dropped: int
    outside: int
    hidden: int


def clean(
    surface: Surface,
    visibility: Visibility,
    points: np.ndarray,
    keep: "Keep",
    min_views: int,
    min_component: float,
    has_alpha: bool = False,
) -> Cleaned:
    """Remove what the photos do not support; ``points`` are the sparse ones (n, 3), in the frame of the surface;
    ``has_alpha``: the photos' alpha says what is background.

    ``visible`` removes the faces that lie in fewer than ``min_views`` frustums (one photo gives no depth) and those
    visible in too few of them without a sparse point near (sky that hangs on the back of a table). Of the components it
    then removes those that hardly any photo sees (inner cavities), those without sparse points (see :func:`_supported`)
    and those with less than ``min_component`` of the largest one's area. ``largest`` keeps the component of largest
    area, ``all`` everything. Raises StageError if nothing remains.
    """
    inside = np.all(visibility.in_frustum[surface.faces] >= min_views, axis=1) | (keep != "visible")
    if not inside.any():
        why = f"none of its {len(surface.faces)} faces lies in {min_views} photos between near and far"
        raise StageError(
            "mesh.nothing-covered", "no part of the surface lies within the photos' frusta", why, "Try --mesh.keep all."
        )
    surface, old = keep_faces(surface, inside)
    hidden = 0
    if keep == "visible":
        views, of = visibility.visible[old], visibility.in_frustum[old]
        remove = _hidden(surface, np.where(views >= min_views, views / np.maximum(of, 1), 0), points, has_alpha)
        surface, left = keep_faces(surface, ~remove)
        old, hidden = old[left], int(remove.sum())
    label = components(surface)
    count = int(label.max()) + 1
    if keep == "visible":
        visible = np.any(visibility.visible[old][surface.faces] >= min_views, axis=1)
        good = _good_components(surface, label, visible, points, min_component)
    else:
        good = np.arange(count) < (1 if keep == "largest" else count)
    if not good.any():
        why = f"in none of its {count} components is a tenth of the area visible in {min_views} photos"
        hint = "Try --mesh.keep all or another --mesh.iso-level."
        raise StageError("mesh.nothing-seen", "no part of the surface is visible in the photos", why, hint)
    surface, left = keep_faces(surface, good[label])
    return Cleaned(surface, old[left], int(good.sum()), int((~good).sum()), int((~inside).sum()), hidden)


def _hidden(surface: Surface, share: np.ndarray, points: np.ndarray, has_alpha: bool) -> np.ndarray:
    """Faces that no photo shows to be there, (faces,) bool; none where that would be all. ``share``: of the photos
    whose frustums hold a vertex, how many see it, (n,).

    These are faces without a sparse point near that lie more than DILATION_STEPS edges from every visible vertex; and,
    where they hang together with an open border, those around which the mean share is small: sheets of sky that show
    here and there past the edge of a table, and end where the region does.

    Where there are too few points to tell (imported poses of photos with alpha have none), visibility alone decides;
    but of photos with alpha only such parts go as end openly. Their silhouettes bound an object on all sides, so that
    its bare underside closes it and stays. Without alpha the volume below a table is as the field happened to leave it.
    """
    near, few = np.zeros(len(share), bool), len(points) < MIN_POINTS
    if not few:
        tree, radius = _point_tree(points)
        near = np.isfinite(tree.query(surface.vertices, distance_upper_bound=radius)[0])
    visible = share >= MIN_VISIBLE_FRACTION
    for _ in range(DILATION_STEPS):
        visible = _dilated(surface.faces, visible)
    means = neighbour_means(surface)
    for _ in range(AVERAGING_STEPS):
        share = means @ share
    often_visible = share >= MIN_MEAN_VISIBLE_FRACTION
    hidden, seldom_visible = (~np.all((near | each)[surface.faces], axis=1) for each in (visible, often_visible))
    hidden = _ends_openly(surface, hidden) if has_alpha and few else hidden
    hidden |= _ends_openly(surface, seldom_visible)
    return hidden & ~hidden.all()


def cut_unseen(surface: Surface, seen: np.ndarray, min_component: float) -> tuple[Surface, np.ndarray]:
    """The surface without its fringes, and the old index of each vertex: what hangs behind a wall or past the end of a
    table where no photo looks.

    A face belongs to a fringe if it lies more than FRINGE_STEPS edges from every vertex that is ``seen`` (n,), and
    hangs together with an open border by such faces: what photos see all around closes the surface, and stays. Parts
    that only fringes held together stay if they have ``min_component`` of the largest one's area.
    """
    for _ in range(FRINGE_STEPS):
        seen = _dilated(surface.faces, seen)
    fringe = _ends_openly(surface, np.logical_not(seen[surface.faces].any(axis=1)))
    if not fringe.any() or fringe.all():
        return surface, np.arange(len(surface.vertices))
    rest, left = keep_faces(surface, ~fringe)
    label = components(rest)
    area = np.bincount(label, face_areas(rest))
    large, of_large = keep_faces(rest, (area >= min_component * area.max())[label])
    return large, left[of_large]


def _ends_openly(surface: Surface, marked: np.ndarray) -> np.ndarray:
    """Those of the ``marked`` faces that hang together, by marked faces, with an open border of the surface."""
    found = np.zeros(len(marked), bool)
    if marked.any():
        part, vertex = keep_faces(surface, marked)
        label = components(part)
        on_border = np.isin(vertex, border_indices(surface))[part.faces].any(1)
        found[marked] = (np.bincount(label, on_border) > 0)[label]
    return found


def _dilated(faces: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """The ``marked`` vertices and all that share a face with one."""
    grown = marked.copy()
    grown[faces[marked[faces].any(1)]] = True
    return grown


def _good_components(
    surface: Surface, label: np.ndarray, visible: np.ndarray, points: np.ndarray, min_component: float
) -> np.ndarray:
    """Whether each component is visible, supported and large enough, (components,) bool."""
    area = face_areas(surface)
    total = np.bincount(label, area)
    good = _covers(label, area, visible, MIN_VISIBLE_AREA) & (total > 0)
    good = _supported(surface, label, area, points, good)
    return good & (total >= min_component * total[good].max(initial=0.0))


def _supported(
    surface: Surface, label: np.ndarray, area: np.ndarray, points: np.ndarray, good: np.ndarray
) -> np.ndarray:
    """Which of the ``good`` components have sparse points near a tenth of their area.

    Sparse points are where details of photos agree on a position. What has none nearby (sky, floaters) is where it is
    only because the field had to put it somewhere. All stay where that cannot be told: where few points are near any,
    or more of them near those that would go than near those that would stay (a bare wall, and a speck on it).
    """
    if len(points) < MIN_POINTS:
        return good
    tree, radius = _point_tree(points)
    near = np.isfinite(tree.query(surface.vertices, distance_upper_bound=radius)[0])
    supported = good & _covers(label, area, near[surface.faces].any(1), MIN_SUPPORTED_AREA)

    of_vertex = np.zeros(len(surface.vertices), label.dtype)
    of_vertex[surface.faces] = label[:, None]
    distance, vertex = KDTree(surface.vertices).query(points, distance_upper_bound=radius)
    of_point = of_vertex[np.asarray(vertex)[np.isfinite(distance)]]
    near_good, near_supported = (int(which[of_point].sum()) for which in (good, supported))
    return supported if near_good >= MIN_POINTS and near_supported >= near_good / 2 else good


def _point_tree(points: np.ndarray) -> tuple[KDTree, float]:
    """The sparse points as a search tree, and the distance within which one counts as near."""
    tree = KDTree(points)
    spacing = float(np.median(tree.query(points, 2)[0][:, 1]))
    return tree, max(SUPPORT_RADIUS, SUPPORT_RADIUS_SPACINGS * spacing)


def _covers(label: np.ndarray, area: np.ndarray, marked: np.ndarray, fraction: float) -> np.ndarray:
    """Whether the ``marked`` faces make up that fraction of each component's area, (components,) bool."""
    return np.bincount(label, area * marked) >= fraction * np.bincount(label, area)


def boundary(
    surface: Surface, extent: tuple[np.ndarray, np.ndarray], voxel_size: VoxelSize, cropped: bool = False
) -> str:
    """Where the surface ends: "watertight", or "open" and where. ``extent``: the region of the scene that is meshed,
    and the grid's box in its space (2, 3 each). Of one that was ``cropped`` it is not known which border is the
    crop's."""
    if is_watertight(surface):
        return "watertight"
    border = border_vertices(surface)
    if len(border) == 0:
        return "closed, but not a manifold"
    if cropped:
        return "open, cropped by --mesh.box"
    (region, box), mapped = extent, voxel_size.space.forward(torch.from_numpy(border)).numpy()
    reach = np.maximum(*voxel_size.at(border))[:, None]
    at_box = _next_to(region, border, reach / 2) | _next_to(box, mapped, voxel_size.spacing.max() / 2)
    places = [("at the edge of the region", at_box.any()), ("where too few photos see it", not at_box.all())]
    return "open " + " and ".join(place for place, present in places if present)


def _next_to(box: np.ndarray, points: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
    """Which points (n, 3) lie within ``reach`` of a side of a box (2, 3), or beyond it."""
    return ((points < box[0] + reach) | (points > box[1] - reach)).any(axis=1)
