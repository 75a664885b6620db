"""What is kept of a surface, and how its end is described."""

import numpy as np
import pytest

from stages.contract import StageError
from stages.mesh_cleaning import REACH, clean, located, openness
from stages.mesh_surface import Surface
from stages.mesh_views import Sight

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def tetrahedra(*sizes):
    """Separate tetrahedra of the given edge lengths in a row."""
    vertices = np.concatenate([CORNERS * size + [2 * i, 0, 0] for i, size in enumerate(sizes)])
    return Surface(vertices, np.concatenate([FACES + 4 * i for i in range(len(sizes))]))


def sight(covered, seen):
    """Four vertices per component, all with the same counts."""
    covered, seen = np.repeat(covered, 4), np.repeat(seen, 4)
    return Sight(covered, seen, np.zeros((len(seen), 3)))


def near(*components):
    """Four vertices per component, all near a sparse point or far from any."""
    return np.repeat(components, 4)


def test_visible_keeps_what_is_seen_and_large_enough():
    surface = tetrahedra(1.0, 0.5, 0.05, 1.0)  # the third is a speck of 1/400 of the area, the last an unseen cavity
    cleaned = clean(surface, sight([5, 5, 5, 5], [3, 2, 5, 1]), near(True, True, True, True), "visible", 2, 0.01)
    assert (cleaned.kept, cleaned.dropped, cleaned.uncovered) == (2, 2, 0)
    np.testing.assert_array_equal(cleaned.surface.vertices, surface.vertices[:8])
    assert cleaned.vertex.tolist() == list(range(8))


def test_an_unseen_component_does_not_set_the_scale():
    cleaned = clean(tetrahedra(100.0, 1.0), sight([5, 5], [0, 5]), near(True, True), "visible", 2, 0.01)
    assert (cleaned.kept, len(cleaned.surface.faces)) == (1, 4)


def test_what_is_far_from_every_sparse_point_goes_and_does_not_set_the_scale():
    view = sight([5, 5], [5, 5])
    cleaned = clean(tetrahedra(100.0, 1.0), view, near(False, True), "visible", 2, 0.01)
    assert (cleaned.kept, cleaned.dropped, len(cleaned.surface.faces)) == (1, 1, 4)
    assert cleaned.surface.vertices[:, 0].max() == 3.0
    assert clean(tetrahedra(2.0, 1.0), view, near(False, False), "visible", 2, 0.01).kept == 2  # nothing to go by


def test_a_surface_reaches_beyond_its_sparse_points():
    surface = sheet(0.0, 1.0)  # of two triangles, of which one has a point at a corner
    view = Sight(np.full(4, 5), np.full(4, 5), np.zeros((4, 3)))
    assert clean(surface, view, np.array([False, True, False, False]), "visible", 2, 0.01).dropped == 0


def test_near_is_within_reach_of_a_point_or_of_the_distance_between_points():
    points = np.array([[0.0, 0, 0], [REACH / 10, 0, 0], [0, REACH / 10, 0]])
    at = np.array([[0, 0, 0.9 * REACH], [0, 0, 1.1 * REACH], [0, 0, 2.9], [0, 0, 3.1]])
    assert located(at, points).tolist() == [True, False, False, False]
    assert located(at, points * (10 / REACH)).tolist() == [True, True, True, False]  # they stand 1 apart
    for few in (0, 1):
        assert located(at, points[:few]).all()


def test_faces_without_enough_photos_are_cut_before_components_are_counted():
    view = sight([5, 1], [5, 1])
    assert clean(tetrahedra(1.0, 1.0), view, near(True, True), "visible", 2, 0.01)[2:] == (1, 0, 4)
    view.covered[0] = 1  # three of the four faces of the first touch its first vertex
    assert clean(tetrahedra(1.0, 1.0), view, near(True, True), "visible", 2, 0.01)[2:] == (1, 0, 7)


@pytest.mark.parametrize(("keep", "kept"), [("largest", 1), ("all", 3)])
def test_other_rules_ignore_the_photos(keep, kept):
    cleaned = clean(tetrahedra(0.5, 1.0, 0.5), sight([0, 0, 0], [0, 0, 0]), near(True, False, False), keep, 2, 0.01)
    assert (cleaned.kept, cleaned.dropped) == (kept, 3 - kept)
    assert np.ptp(cleaned.surface.vertices[:, 1]) == 1.0


@pytest.mark.parametrize(
    ("covered", "message"),
    [
        (1, "no part of the surface is covered by the photos: none of its 4 faces"),
        (2, "no part of the surface is seen"),
    ],
)
def test_nothing_left_is_an_error_that_helps(covered, message):
    with pytest.raises(StageError, match=message) as error:
        clean(tetrahedra(1.0), sight([covered], [0]), near(True), "visible", 2, 0.01)
    assert "--mesh.keep all" in error.value.hint


def sheet(low, high):
    corners = np.array([[low, low, 0], [high, low, 0], [high, high, 0], [low, high, 0.0]])
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (tetrahedra(0.5), "watertight"),
        (sheet(-0.9, 0.9), "open at the box"),
        (sheet(-0.5, 0.5), "open where too few photos look"),
        (sheet(-0.9, 0.5), "open at the box and where too few photos look"),
        (tetrahedra(0.5)._replace(faces=np.concatenate([FACES, FACES])), "closed, but not a manifold"),
    ],
)
def test_the_end_of_a_surface_is_named(surface, words):
    assert openness(surface, 0.9, 0.02) == words
