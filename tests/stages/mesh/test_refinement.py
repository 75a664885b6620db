"""Surfaces beside their place, moved to where photos of them agree."""

import numpy as np
import pytest

from stages.mesh.photos.best_photos import find_best_photos
from stages.mesh.photos.refinement import refine
from tests.stages.mesh.plane_photos import known, ring_of_views, scene_of, sheet, square_camera, write_plane_photos

CAMERA, VOXEL, CELLS = square_camera(200), 0.04, 40


def pattern(points):
    """Grey values (n,) with detail of a few pixels, and a bare half where x < 0."""
    x, y = points[:, 0], points[:, 1]
    waves = np.sin(23 * x + 3 * np.sin(9 * y)) + np.sin(31 * y + 2 * np.sin(13 * x)) + np.sin(17 * (x - y))
    return 0.5 + 0.12 * np.where(x > 0, waves, 0)


def wavy(x, y):
    """Up to a voxel beside the true plane, z = 0."""
    return VOXEL * (0.6 + 0.4 * np.sin(5 * x) * np.cos(6 * y))


@pytest.fixture
def refined(tmp_path):
    """Refine a surface with photos of the textured plane z = 0; ``change(number, grey, points)`` alters one."""

    def run(surface, change=lambda number, grey, points: grey, count=7):
        views = ring_of_views(count, 0.7, 2.2)

        def colours(number, points):
            return change(number, pattern(points), points)[:, None].repeat(3, axis=1)

        write_plane_photos(tmp_path, CAMERA, views, colours)
        voxels, scene = known(surface, VOXEL), scene_of(CAMERA, views)
        best_photos = find_best_photos(surface, scene, tmp_path, {"effects": {}}, voxels, lambda done: None)
        return refine(surface, best_photos, voxels, lambda done: None)

    return run


def height_error(surface, where):
    """Root mean square height of the vertices ``where``, in voxels."""
    return float(np.sqrt((surface.vertices[where, 2] ** 2).mean())) / VOXEL


def textured(surface):
    """Vertices on the textured half, away from its borders."""
    x, y = surface.vertices[:, :2].T
    return (x > 0.15) & (x < 0.55) & (np.abs(y) < 0.55)


def test_a_wavy_surface_is_moved_onto_the_plane(refined):
    surface = sheet(CELLS, wavy)
    found = refined(surface)
    assert found is not None and found.kept and 0 < found.before < found.after
    assert height_error(surface, textured(surface)) > 0.5
    assert 0 < height_error(found.surface, textured(surface)) < 0.06
    assert np.array_equal(found.surface.faces, surface.faces)


def test_short_edges_are_as_smooth_as_long_ones(refined):
    def noisy(number, grey, points):
        return grey + np.random.default_rng(number).normal(0, 0.03, grey.shape)

    def bent(cells):
        """Mean angle (degrees) of faces to the plane, where there is texture and photos enough."""
        found = refined(sheet(cells, wavy), noisy)
        assert found.kept
        surface = found.surface
        corners = surface.vertices[surface.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = corners.mean(axis=1)
        inner = (np.abs(middle[:, :2]) < 0.6).all(axis=1) & (middle[:, 0] > 0.1)
        return np.degrees(np.arccos(normals[inner, 2] / np.linalg.norm(normals[inner], axis=1))).mean()

    found = [bent(20), bent(40), bent(60)]
    assert max(found[1:]) < 1.3 * found[0] < 2, "3.4 before"


def test_exposures_do_not_matter(refined):
    gains = [1.0, 0.6, 1.3, 0.8, 1.1, 0.7, 1.0]
    surface = sheet(CELLS, wavy)
    found = refined(surface, lambda number, grey, _: gains[number] * grey)
    assert found is not None and 0 < height_error(found.surface, textured(surface)) < 0.06


def test_a_surface_in_its_place_stays(refined):
    surface = sheet(CELLS)
    found = refined(surface)
    assert found is not None and height_error(found.surface, textured(surface)) < 0.03


def test_a_bare_wall_makes_nothing_up(refined):
    """It follows its neighbours, and comes no farther from its place than it was."""
    surface = sheet(CELLS, wavy)
    bare = (surface.vertices[:, 0] < -0.2) & (np.abs(surface.vertices[:, 1]) < 0.6)
    found = refined(surface)
    assert found is not None and height_error(found.surface, bare) < 1.1 * height_error(surface, bare)


def test_photos_that_agree_nowhere_move_nothing_far(refined):
    random = np.random.default_rng(0)
    surface = sheet(CELLS, wavy)
    found = refined(surface, lambda number, grey, points: random.random(len(grey)))
    assert found is not None
    moved = np.linalg.norm(found.surface.vertices - surface.vertices, axis=1) / VOXEL
    assert np.median(moved) < 0.5 and np.isfinite(found.surface.vertices).all()


def test_what_no_two_photos_show_is_left(refined):
    assert refined(sheet(CELLS, wavy), count=1) is None
    surface = sheet(CELLS, wavy)
    turned = from_below(surface)
    assert refined(turned) is None


def from_below(surface):
    """The same surface seen from below, which no photo shows."""
    return surface._replace(faces=surface.faces[:, ::-1].copy())


def test_the_same_bytes_each_time(refined):
    first, second = refined(sheet(CELLS, wavy)), refined(sheet(CELLS, wavy))
    assert first is not None and second is not None
    assert first.surface.vertices.tobytes() == second.surface.vertices.tobytes()
