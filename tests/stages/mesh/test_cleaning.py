"""What is kept of a surface, and how its end is described."""

import numpy as np
import pytest

from nerf.geometry.space_maps import Box
from stages.contract import StageError
from stages.mesh.cleaning import (
    AVERAGING_STEPS,
    DILATION_STEPS,
    FRINGE_STEPS,
    MIN_POINTS,
    SUPPORT_RADIUS,
    boundary,
    clean,
    cut_unseen,
)
from stages.mesh.grid_space import VoxelSize
from stages.mesh.surface import Surface
from stages.mesh.visibility import Visibility
from tests.refusals import refused

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)

CUBE = np.array([[-0.9] * 3, [0.9] * 3])


def tetrahedra(*sizes):
    """Separate tetrahedra of the given edge lengths in a row."""
    vertices = np.concatenate([CORNERS * size + [2 * i, 0, 0] for i, size in enumerate(sizes)])
    return Surface(vertices, np.concatenate([FACES + 4 * i for i in range(len(sizes))]))


def visibility_of(in_frustum, seen):
    """Four vertices per component, all with the same counts."""
    in_frustum, seen = np.repeat(in_frustum, 4), np.repeat(seen, 4)
    return Visibility(in_frustum, seen, np.zeros((len(seen), 3)))


NO_POINTS = np.zeros((0, 3))


def points_at(*corners, count=2 * MIN_POINTS):
    """A dense cloud of points around each of some places."""
    cloud = np.random.default_rng(0).normal(scale=SUPPORT_RADIUS / 10, size=(count, 3))
    return np.concatenate([cloud + corner for corner in corners])


def long_strip():
    """Vertices in pairs, 0 to 100 along x, and two faces between one pair and the next."""
    steps = np.arange(101.0)
    edges = np.stack([np.stack([steps, 0 * steps, 0 * steps], -1), np.stack([steps, 0 * steps + 1, 0 * steps], -1)], 1)
    first = 2 * np.arange(100)[:, None]
    faces = np.concatenate([first + np.array(corners) for corners in ([0, 2, 1], [1, 2, 3])])
    return edges.reshape(-1, 3), faces.astype(np.int32)


def test_visible_keeps_what_is_seen_and_large_enough():
    surface = tetrahedra(1.0, 0.5, 0.05, 1.0)  # the third is a speck of 1/400 of the area, the last an unseen cavity
    cleaned = clean(surface, visibility_of([5, 5, 5, 5], [3, 2, 5, 1]), NO_POINTS, "visible", 2, 0.01)
    assert (cleaned.kept, cleaned.dropped, cleaned.outside, cleaned.hidden) == (2, 1, 0, 4)
    np.testing.assert_array_equal(cleaned.surface.vertices, surface.vertices[:8])
    assert cleaned.vertex.tolist() == list(range(8))


def test_an_unseen_component_does_not_set_the_scale():
    cleaned = clean(tetrahedra(100.0, 1.0), visibility_of([5, 5], [0, 5]), NO_POINTS, "visible", 2, 0.01)
    assert (cleaned.kept, len(cleaned.surface.faces)) == (1, 4)


def test_surface_far_from_sparse_points_is_removed():
    view, both = visibility_of([5, 5], [5, 5]), tetrahedra(100.0, 1.0)
    on_the_second = both.vertices[4]
    cleaned = clean(both, view, points_at(on_the_second), "visible", 2, 0.01)
    assert (cleaned.kept, cleaned.dropped, len(cleaned.surface.faces)) == (1, 1, 4)
    assert cleaned.surface.vertices[:, 0].max() == 3.0


@pytest.mark.parametrize("count", [0, 1, MIN_POINTS - 1])
def test_few_points_tell_nothing(count):
    surface = tetrahedra(2.0, 1.0)
    points = points_at(surface.vertices[4], count=count)
    assert clean(surface, visibility_of([5, 5], [5, 5]), points, "visible", 2, 0.01).kept == 2


def test_points_far_from_all_of_the_surface_tell_nothing():
    points = points_at(np.array([0.0, 50, 50]))
    assert clean(tetrahedra(2.0, 1.0), visibility_of([5, 5], [5, 5]), points, "visible", 2, 0.01).kept == 2


def test_a_bare_wall_survives_a_speck():
    """The wall has points in one corner alone: it stays if they are more than those on the speck."""
    edges, strip = long_strip()
    speck = np.array([[200.0, 0, 0], [201, 0, 0], [200, 1, 0]])
    wall = Surface(np.concatenate([edges, speck]), np.vstack([strip, [202, 203, 204]]).astype(np.int32))
    view = Visibility(np.full(205, 5), np.full(205, 5), np.zeros((205, 3)))
    on_the_wall, on_the_speck = points_at(wall.vertices[0]), points_at(speck[0])
    both = np.concatenate([on_the_wall, on_the_speck[: len(on_the_speck) // 2]])
    assert clean(wall, view, both, "visible", 2, 0.0).kept == 2
    both = np.concatenate([on_the_wall[: len(on_the_wall) // 2], on_the_speck])
    assert clean(wall, view, both, "visible", 2, 0.0).kept == 1


def test_faces_without_enough_photos_are_cut_before_components_are_counted():
    view = visibility_of([5, 1], [5, 1])
    assert clean(tetrahedra(1.0, 1.0), view, NO_POINTS, "visible", 2, 0.01)[2:] == (1, 0, 4, 0)
    view.in_frustum[0] = 1  # three of the four faces of the first touch its first vertex
    assert clean(tetrahedra(1.0, 1.0), view, NO_POINTS, "visible", 2, 0.01)[2:] == (1, 0, 7, 0)


def test_hidden_surface_far_from_points_is_removed():
    """A strip of which photos see the first fifth, with points there: the rest hangs on it, a little of it stays."""
    strip = Surface(*long_strip())
    x = strip.vertices[:, 0]
    view = Visibility(np.full(202, 5), np.where(x <= 20, 5, 1), np.zeros((202, 3)))
    here, face = points_at(strip.vertices[0]), points_at(*strip.vertices[[180, 182, 181]])
    cleaned = clean(strip, view, here, "visible", 2, 0.0)
    end = cleaned.surface.vertices[:, 0].max()
    assert 20 < end < 20 + AVERAGING_STEPS
    assert cleaned.hidden == pytest.approx(2 * (100 - end), abs=1)
    assert clean(strip, view, np.concatenate([here, face]), "visible", 2, 0.0).hidden == cleaned.hidden - 1
    past_an_edge = Visibility(np.full(202, 50), np.where(x <= 20, 25, 9), np.zeros((202, 3)))
    assert 2 * (80 - AVERAGING_STEPS) < clean(strip, past_an_edge, here, "visible", 2, 0.0).hidden < 160
    assert clean(strip, view, here[: MIN_POINTS - 1], "visible", 2, 0.0).hidden == cleaned.hidden
    assert clean(strip, view, here, "all", 2, 0.0).hidden == 0


def long_tube(caps):
    """Triangular, 0 to 100 along x, closed at its first end or at both."""
    line = np.arange(101.0)
    ring = np.stack([np.stack([line, y + 0 * line, z + 0 * line], -1) for y, z in ((0, 0), (1, 0), (0.5, 1))], 1)
    first = (3 * np.arange(100)[:, None, None] + np.arange(3)[:, None]).reshape(-1, 1)
    after = np.tile([1, 1, -2], 100)[:, None]
    none = 0 * after
    quads = [np.hstack([none, after, none + 3]), np.hstack([after, after + 3, none + 3])]
    sides = np.concatenate([first + corners for corners in quads])
    ends = np.array([[0, 2, 1], [300, 301, 302]])[:caps]
    return Surface(ring.reshape(-1, 3), np.concatenate([sides, ends]).astype(np.int32))


@pytest.mark.parametrize(("has_alpha", "caps"), [(True, 2), (True, 1), (False, 2)])
def test_without_points_silhouettes_keep_a_hidden_end(has_alpha, caps):
    """A box of which photos see one end: the other closes it, unless it leaves the region there or nothing bounds
    it."""
    tube = long_tube(caps)
    view = Visibility(np.full(303, 5), np.where(tube.vertices[:, 0] <= 40, 5, 1), np.zeros((303, 3)))
    hidden = clean(tube, view, NO_POINTS, "visible", 2, 0.0, has_alpha).hidden
    if has_alpha and caps == 2:
        assert hidden == 0
    elif caps == 2:
        assert hidden == 6 * (60 - DILATION_STEPS) + 1
    else:
        assert 6 * (60 - DILATION_STEPS) < hidden < 6 * 60


@pytest.mark.parametrize("caps", [1, 2])
def test_what_shows_here_and_there_goes_where_it_ends_openly(caps):
    """A tube with points at its visible end; of the rest photos see every seventh ring, past an edge."""
    tube = long_tube(caps)
    x = tube.vertices[:, 0]
    seen = np.where(x <= 40, 25, np.where(x % 7 == 0, 15, 4))
    view = Visibility(np.full(303, 50), seen, np.zeros((303, 3)))
    cleaned = clean(tube, view, points_at(tube.vertices[0]), "visible", 2, 0.0)
    reaches = cleaned.surface.vertices[:, 0].max()
    assert 40 < reaches < 40 + AVERAGING_STEPS if caps == 1 else reaches == 100


def test_nothing_counts_as_hidden_where_all_would():
    """The points lie on an end of the strip that lies in too few frustums."""
    strip = Surface(*long_strip())
    in_frustum = strip.vertices[:, 0] > 50
    view = Visibility(np.where(in_frustum, 5, 1), np.where(in_frustum, 1, 0), np.zeros((202, 3)))
    with refused("mesh.nothing-seen"):
        clean(strip, view, points_at(*strip.vertices[:3]), "visible", 2, 0.0)


@pytest.mark.parametrize(("keep", "kept"), [("largest", 1), ("all", 3)])
def test_other_rules_ignore_the_photos(keep, kept):
    cleaned = clean(tetrahedra(0.5, 1.0, 0.5), visibility_of([0, 0, 0], [0, 0, 0]), NO_POINTS, keep, 2, 0.01)
    assert (cleaned.kept, cleaned.dropped) == (kept, 3 - kept)
    assert np.ptp(cleaned.surface.vertices[:, 1]) == 1.0


@pytest.mark.parametrize(
    ("in_frustum", "message"),
    [
        (1, "no part of the surface lies within the photos' frusta: none of its 4 faces"),
        (2, "no part of the surface is visible"),
    ],
)
def test_nothing_left_is_an_error_that_helps(in_frustum, message):
    with pytest.raises(StageError, match=message) as error:
        clean(tetrahedra(1.0), visibility_of([in_frustum], [0]), NO_POINTS, "visible", 2, 0.01)
    assert "--mesh.keep all" in error.value.hint


def sheet(low, high):
    corners = np.array([[low, low, 0], [high, low, 0], [high, high, 0], [low, high, 0.0]])
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (tetrahedra(0.5), "watertight"),
        (sheet(-0.9, 0.9), "open at the edge of the region"),
        (sheet(-0.5, 0.5), "open where too few photos see it"),
        (sheet(-0.9, 0.5), "open at the edge of the region and where too few photos see it"),
        (tetrahedra(0.5)._replace(faces=np.concatenate([FACES, FACES])), "closed, but not a manifold"),
    ],
)
def test_the_end_of_a_surface_is_named(surface, words):
    assert boundary(surface, (CUBE, CUBE), VoxelSize(Box(), np.full(3, 0.02))) == words


def test_fringes_that_no_photo_sees_are_cut():
    strip = Surface(*long_strip())
    seen = (strip.vertices[:, 0] >= 40) & (strip.vertices[:, 0] <= 60)
    part, vertex = cut_unseen(strip, seen, 0.0)
    ends = 40 - FRINGE_STEPS - 1, 60 + FRINGE_STEPS + 1
    assert (part.vertices[:, 0].min(), part.vertices[:, 0].max()) == ends, "a face with one near vertex stays"
    np.testing.assert_array_equal(part.vertices, strip.vertices[vertex])
    for everything in (np.ones(len(seen), bool), np.zeros(len(seen), bool)):
        assert cut_unseen(strip, everything, 0.0)[0] is strip, "all seen, or none"


def test_what_photos_see_all_around_stays():
    """A sheet with an unseen patch: in its middle it stays, at its border it goes."""
    line = np.arange(31.0)
    x, y = (each.reshape(-1) for each in np.meshgrid(line, line, indexing="ij"))
    corner = (31 * np.arange(30)[:, None] + np.arange(30)).reshape(-1, 1)
    sheet = Surface(
        np.stack([x, y, 0 * x], axis=1),
        np.concatenate([corner + np.array(turn) for turn in ([0, 31, 1], [1, 31, 32])]).astype(np.int32),
    )
    for middle, left in ((15.0, 1800), (0.0, None)):
        seen = (np.abs(x - middle) > 8) | (np.abs(y - 15) > 8)
        count = len(cut_unseen(sheet, seen, 0.01)[0].faces)
        assert count == left if left else 1500 < count < 1800


def test_specks_that_fringes_held_go_with_them():
    strip = Surface(*long_strip())
    seen = (strip.vertices[:, 0] < 40) | (strip.vertices[:, 0] == 99)
    assert cut_unseen(strip, seen, 0.3)[0].vertices[:, 0].max() == 40 + FRINGE_STEPS
    assert cut_unseen(strip, seen, 0.01)[0].vertices[:, 0].max() == 100
