"""Surfaces beside their place, moved to where photos of them agree."""

import math

import numpy as np
import pytest

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.io.files import write_png
from stages.io.photos import Photo, write_photos
from stages.mesh.grid_space import VoxelLengths
from stages.mesh.photos.refinement import refine
from stages.mesh.photos.sightings import find_sightings
from stages.mesh.surface import Surface

SIDE, FOCAL, VOXEL = 200, 250.0, 0.04
CAMERA = Camera("PINHOLE", SIDE, SIDE, (FOCAL, FOCAL, SIDE / 2, SIDE / 2))


def pattern(points):
    """Grey values (n,) with detail of a few pixels, and a bare half where x < 0."""
    x, y = points[:, 0], points[:, 1]
    waves = np.sin(23 * x + 3 * np.sin(9 * y)) + np.sin(31 * y + 2 * np.sin(13 * x)) + np.sin(17 * (x - y))
    return 0.5 + 0.12 * np.where(x > 0, waves, 0)


def sheet(height, cells=40, half=0.8):
    """The square [-half, half]² seen from above, each vertex at ``height`` (x, y)."""
    line = np.linspace(-half, half, cells + 1)
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(np.stack([x, y, height(x, y)], axis=1), faces.astype(np.int32))


def wavy(x, y):
    """Up to a voxel beside the true plane, z = 0."""
    return VOXEL * (0.6 + 0.4 * np.sin(5 * x) * np.cos(6 * y))


@pytest.fixture
def refined(tmp_path):
    """Refine a surface with photos of the textured plane z = 0; ``change(number, grey, points)`` alters one."""

    def run(surface, change=lambda number, grey, points: grey, count=7):
        views, photos = [], []
        for number in range(count):
            angle = 2 * math.pi * number / count
            centre = np.array([0.7 * math.cos(angle), 0.7 * math.sin(angle), 2.2])
            pose = look_at(centre[None], np.zeros(3), np.array([0.0, 1, 0]))[0]
            at = (np.arange(SIDE) + 0.5 - SIDE / 2) / FOCAL
            x, y = np.meshgrid(at, at)
            rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ pose[:, :3].T
            points = pose[:, 3] - rays * (pose[2, 3] / rays[:, 2:])
            grey = np.clip(change(number, pattern(points), points), 0, 1).reshape(SIDE, SIDE, 1)
            name = f"{number}.png"
            write_png(tmp_path / "images" / name, np.rint(255 * grey).astype(np.uint8).repeat(3, axis=2))
            views.append(View(name, f"images/{name}", 0, pose, 0.1, 9.0, "train"))
            photos.append(Photo(name, f"images/{name}", SIDE, SIDE, 0, None, None, False, 1.0))
        write_photos(tmp_path, photos, [], {})
        identity = Similarity(1.0, np.eye(3), np.zeros(3))
        scene = Scene((CAMERA,), tuple(views), identity, True, False, "forward-facing", True)
        voxels = VoxelLengths(*2 * [np.full(len(surface.vertices), VOXEL)])
        sightings = find_sightings(surface, scene, tmp_path, {"effects": {}}, voxels, lambda done: None)
        return refine(surface, sightings, voxels, lambda done: None)

    return run


def height_error(surface, where):
    """Root mean square height of the vertices ``where``, in voxels."""
    return float(np.sqrt((surface.vertices[where, 2] ** 2).mean())) / VOXEL


def textured(surface):
    """Vertices on the textured half, away from its borders."""
    x, y = surface.vertices[:, :2].T
    return (x > 0.15) & (x < 0.55) & (np.abs(y) < 0.55)


def test_a_wavy_surface_is_moved_onto_the_plane(refined):
    surface = sheet(wavy)
    found = refined(surface)
    assert found is not None and found.kept and 0 < found.before < found.after
    assert height_error(surface, textured(surface)) > 0.5
    assert 0 < height_error(found.surface, textured(surface)) < 0.06
    assert np.array_equal(found.surface.faces, surface.faces)


def test_exposures_do_not_matter(refined):
    gains = [1.0, 0.6, 1.3, 0.8, 1.1, 0.7, 1.0]
    surface = sheet(wavy)
    found = refined(surface, lambda number, grey, _: gains[number] * grey)
    assert found is not None and 0 < height_error(found.surface, textured(surface)) < 0.06


def test_a_surface_in_its_place_stays(refined):
    surface = sheet(lambda x, y: 0 * x)
    found = refined(surface)
    assert found is not None and height_error(found.surface, textured(surface)) < 0.03


def test_a_bare_wall_makes_nothing_up(refined):
    """It follows its neighbours, and comes no farther from its place than it was."""
    surface = sheet(wavy)
    bare = (surface.vertices[:, 0] < -0.2) & (np.abs(surface.vertices[:, 1]) < 0.6)
    found = refined(surface)
    assert found is not None and height_error(found.surface, bare) < 1.1 * height_error(surface, bare)


def test_photos_that_agree_nowhere_move_nothing_far(refined):
    random = np.random.default_rng(0)
    surface = sheet(wavy)
    found = refined(surface, lambda number, grey, points: random.random(len(grey)))
    assert found is not None
    moved = np.linalg.norm(found.surface.vertices - surface.vertices, axis=1) / VOXEL
    assert np.median(moved) < 0.5 and np.isfinite(found.surface.vertices).all()


def test_what_no_two_photos_show_is_left(refined):
    assert refined(sheet(wavy), count=1) is None
    surface = sheet(wavy)
    turned = from_below(surface)
    assert refined(turned) is None


def from_below(surface):
    """The same surface seen from below, which no photo shows."""
    return surface._replace(faces=surface.faces[:, ::-1].copy())


def test_the_same_bytes_each_time(refined):
    first, second = refined(sheet(wavy)), refined(sheet(wavy))
    assert first is not None and second is not None
    assert first.surface.vertices.tobytes() == second.surface.vertices.tobytes()
