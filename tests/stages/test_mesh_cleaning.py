"""What is kept of a surface, and how its end is described."""

import numpy as np
import pytest

from stages.contract import StageError
from stages.mesh_cleaning import clean, openness
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


def test_visible_keeps_what_is_seen_and_large_enough():
    surface = tetrahedra(1.0, 0.5, 0.05, 1.0)  # the third is a speck of 1/400 of the area, the last an unseen cavity
    cleaned = clean(surface, sight([5, 5, 5, 5], [3, 2, 5, 1]), "visible", 2, 0.01)
    assert (cleaned.kept, cleaned.dropped, cleaned.uncovered) == (2, 2, 0)
    np.testing.assert_array_equal(cleaned.surface.vertices, surface.vertices[:8])
    assert cleaned.vertex.tolist() == list(range(8))


def test_an_unseen_component_does_not_set_the_scale():
    cleaned = clean(tetrahedra(100.0, 1.0), sight([5, 5], [0, 5]), "visible", 2, 0.01)
    assert (cleaned.kept, len(cleaned.surface.faces)) == (1, 4)


def test_faces_without_enough_photos_are_cut_before_components_are_counted():
    view = sight([5, 1], [5, 1])
    assert clean(tetrahedra(1.0, 1.0), view, "visible", 2, 0.01)[2:] == (1, 0, 4)
    view.covered[0] = 1  # three of the four faces of the first touch its first vertex
    assert clean(tetrahedra(1.0, 1.0), view, "visible", 2, 0.01)[2:] == (1, 0, 7)


@pytest.mark.parametrize(("keep", "kept"), [("largest", 1), ("all", 3)])
def test_other_rules_ignore_the_photos(keep, kept):
    cleaned = clean(tetrahedra(0.5, 1.0, 0.5), sight([0, 0, 0], [0, 0, 0]), keep, 2, 0.01)
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
        clean(tetrahedra(1.0), sight([covered], [0]), "visible", 2, 0.01)
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
