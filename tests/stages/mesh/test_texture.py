"""Textures baked from photos of a surface whose colours are known, and what must not get into them."""

import math
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from nerf.effects.exposure import expose
from stages.io.files import write_png
from stages.mesh.files import ColouredMesh, glb_bytes, obj_files
from stages.mesh.photos.best_photos import find_best_photos
from stages.mesh.photos.photo import sampled_picture
from stages.mesh.rasteriser import barycentric, covered_pixels
from stages.mesh.surface import Surface, vertex_normals
from stages.mesh.texture import baking
from stages.mesh.texture.atlas import make_atlas
from stages.mesh.texture.baking import fill_gutters
from stages.mesh.texture.charts import cut_into_charts
from stages.mesh.texture.texturing import texture_of
from tests.refusals import refused
from tests.stages.mesh.plane_photos import known, ring_of_views, scene_of, sheet, square_camera, write_plane_photos

SIDE, GREY, VOXEL, CELLS = 160, 128, 0.05, 16
CAMERA = square_camera(SIDE)


def pattern(points):
    """Colours (n, 3) in [0.2, 0.8], with detail finer than the surface's edges."""
    x, y = points[:, 0], points[:, 1]
    waves = np.stack([np.sin(40 * x), np.sin(35 * y), np.sin(30 * (x + y))], axis=1)
    return 0.5 + 0.15 * waves + 0.15 * np.stack([x, y, -x], axis=1)


VIEWS = ring_of_views(6, 0.5, 2.0)


@pytest.fixture
def shoot(tmp_path):
    """Write photos of the plane: ``change(index, colours, points)`` may alter what one shows; the scene of them."""

    def write(change=lambda index, colours, points: colours, some=None, masks=(), alpha=None):
        taken = some or VIEWS
        write_plane_photos(tmp_path, CAMERA, taken, lambda index, points: change(index, pattern(points), points), alpha)
        for index, mask in masks:
            write_png(tmp_path / f"masks/{index}.png", mask)
            taken = (*taken[:index], replace(taken[index], mask=f"masks/{index}.png"), *taken[index + 1 :])
        return scene_of(CAMERA, taken)

    return write


@pytest.fixture
def baked(tmp_path):
    """The texture of a surface, as (points, colours) of its texels, and what texture_of gives."""

    def bake(surface, scene, effects=None, size=512):
        grey = np.full((len(surface.vertices), 3), GREY, np.uint8)
        field = {"effects": effects or {}}
        seen = find_best_photos(surface, scene, tmp_path, field, known(surface, VOXEL), lambda done: None)
        found = texture_of(surface, grey, seen, size, lambda what, done: None)
        assert found is not None
        atlas, picture = found.texture
        blocks = list(covered_pixels(atlas.uv[atlas.corner], atlas.width, atlas.height))
        face, row, column = (np.concatenate(part) for part in zip(*blocks, strict=True))
        at = np.stack([column, row], axis=1) + 0.5
        points = (barycentric(atlas.uv[atlas.corner[face]], at)[:, None] @ surface.vertices[surface.faces[face]])[:, 0]
        return points, picture[row, column] / 255, found

    return bake


def error(points, colours, expected=None):
    """Mean absolute error away from the borders, which no photo may show whole."""
    inside = (np.abs(points[:, :2]) < 0.6).all(axis=1)
    assert inside.sum() > 1000
    return np.abs(colours - (pattern(points) if expected is None else expected))[inside].mean()


def test_the_texture_shows_what_the_photos_show(shoot, baked):
    points, colours, found = baked(sheet(CELLS), shoot())
    assert 0 < error(points, colours) < 0.015
    assert 0.8 < found.texture.atlas.texels_per_pixel <= 1 and found.outliers < 0.01
    coarse = np.full_like(colours, 0.5)
    assert error(points, coarse) > 0.1, "the pattern is no grey"


def test_exposure_is_undone_before_photos_are_blended(shoot, baked):
    gains = [0.0, -0.9, 0.0, -0.8, 0.1, -0.9]
    taken = shoot(lambda index, colours, _: expose(torch.tensor(colours), torch.full((1, 3), gains[index])).numpy())
    learnt = {"exposure": {f"{index}.png": [gain] * 3 for index, gain in enumerate(gains)}}
    points, colours, _ = baked(sheet(CELLS), taken, learnt)
    reference = torch.full((1, 3), sorted(gains)[2])  # torch's median of an even number is the lower one
    assert 0 < error(points, colours, expose(torch.tensor(pattern(points)), reference).numpy()) < 0.015
    points, colours, _ = baked(sheet(CELLS), taken)
    assert error(points, colours, expose(torch.tensor(pattern(points)), reference).numpy()) > 0.02


def test_a_passer_by_leaves_no_ghost(shoot, baked):
    def blocked(index, colours, points):
        there = np.linalg.norm(points[:, :2] - [0.1, 0.1], axis=1) < 0.25
        return np.where((index == 2) & there[:, None], [0.9, 0.05, 0.9], colours)

    points, colours, found = baked(sheet(CELLS), shoot(blocked))
    near = np.linalg.norm(points[:, :2] - [0.1, 0.1], axis=1) < 0.3
    wrong = np.abs(colours - pattern(points)).max(axis=1)[near] > 0.2
    assert found.outliers > 0.01 and wrong.mean() < 0.01
    clean = baked(sheet(CELLS), shoot())
    assert error(points, colours) < error(*clean[:2]) + 0.005


def test_masked_pixels_are_never_used(shoot, baked):
    """A photo that shows nothing else counts nowhere but where its mask lets it, alone as it is."""
    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[:, : SIDE // 2] = 0
    magenta = [1.0, 0, 1]

    def left_is_magenta(index, colours, points):
        left = np.tile(np.arange(SIDE) < SIDE // 2, SIDE)
        return np.where(left[:, None], magenta, colours)

    _, colours, found = baked(sheet(CELLS), shoot(left_is_magenta, VIEWS[:1], [(0, mask)]))
    assert 0.3 < found.unseen < 0.7
    assert (np.abs(colours - magenta).max(axis=1) > 0.2).all()
    unmasked = baked(sheet(CELLS), shoot(left_is_magenta, VIEWS[:1]))[1]
    assert (np.abs(unmasked - magenta).max(axis=1) < 0.1).mean() > 0.2


@pytest.mark.parametrize(("has_alpha", "unseen"), [(True, 0.5), (False, 0.0)])
def test_alpha_counts_where_it_says_what_is_background(has_alpha, unseen, shoot, baked):
    """A soft matte is 250 where it is opaque; alpha that trained as part of no background is none here, either."""
    matte = np.full((SIDE, SIDE), 250, np.uint8)
    matte[:, : SIDE // 2] = 0

    def left_is_magenta(index, colours, points):
        left = np.tile(np.arange(SIDE) < SIDE // 2, SIDE)
        return np.where(left[:, None] & has_alpha, [1.0, 0, 1], colours)

    taken = replace(shoot(left_is_magenta, VIEWS[:1], alpha=matte), has_alpha=has_alpha)
    _, colours, found = baked(sheet(CELLS), taken)
    assert found.unseen == pytest.approx(unseen, abs=0.2)
    assert (np.abs(colours - [1.0, 0, 1]).max(axis=1) > 0.2).all()


def test_saturated_surfaces_have_as_many_texels(shoot, baked):
    def red(_, colours, points):
        return np.column_stack([np.ones(len(points)), colours[:, 1:]])

    _, _, plain = baked(sheet(CELLS), shoot())
    _, _, saturated = baked(sheet(CELLS), shoot(red))
    assert saturated.texture.atlas.width > 0.9 * plain.texture.atlas.width


def test_what_lies_behind_gets_nothing_of_what_hides_it(shoot, baked):
    """A red plate above the sheet; photos from all sides see what each other cannot."""
    plate = sheet(4, half=0.15)
    plate = Surface(plate.vertices + np.array([0, 0, 0.5]), plate.faces)
    both = Surface(
        np.concatenate([sheet(CELLS).vertices, plate.vertices]),
        np.concatenate([sheet(CELLS).faces, plate.faces + len(sheet(CELLS).vertices)]),
    )
    taken = VIEWS

    def with_plate(index, colours, points):
        centre = taken[index].scene_from_camera[:, 3]
        at_plate = points + (centre - points) * (0.5 / centre[2])
        return np.where((np.abs(at_plate[:, :2]) < 0.15).all(axis=1)[:, None], [1.0, 0, 0], colours)

    points, colours, _ = baked(both, shoot(with_plate))
    low = points[:, 2] < 0.1
    red = np.abs(colours - [1.0, 0, 0]).max(axis=1) < 0.3
    assert red[~low].mean() > 0.9 and red[low].mean() < 0.002


def bumps():
    """A surface that takes many charts."""
    flat = sheet(40)
    x, y = flat.vertices[:, 0], flat.vertices[:, 1]
    return Surface(flat.vertices + np.stack([0 * x, 0 * x, 0.12 * np.sin(9 * x) * np.sin(9 * y)], axis=1), flat.faces)


def test_charts_meet_in_the_same_colours(shoot, baked):
    surface = bumps()
    _, _, found = baked(surface, shoot())
    atlas, picture = found.texture
    assert len(atlas.uv) > len(surface.vertices) + 50
    shown = sampled_picture(picture, atlas.uv).astype(float)
    count = np.bincount(atlas.vertex)
    spread = np.zeros(len(count))
    for vertex in np.flatnonzero(count > 1):
        spread[vertex] = np.ptp(shown[atlas.vertex == vertex], axis=0).max()
    assert np.median(spread[count > 1]) < 15 and (spread[count > 1] < 45).mean() > 0.95


def test_charts_hold_each_face_once_and_do_not_overlap():
    surface = bumps()
    charts = cut_into_charts(surface)
    assert charts.chart.shape == (len(surface.faces),) and 1 < charts.chart.max() + 1 < 200
    atlas = make_atlas(surface, np.full(len(surface.faces), 100.0), 1024)
    hits = np.zeros(atlas.width * atlas.height, int)
    for _, row, column in covered_pixels(atlas.uv[atlas.corner], atlas.width, atlas.height):
        np.add.at(hits, row * atlas.width + column, 1)
    assert (hits > 1).sum() < 1e-3 * hits.sum() and hits.sum() > 10_000
    np.testing.assert_array_equal(atlas.vertex[atlas.corner], surface.faces)


def test_a_surface_folded_over_itself_is_cut(shoot):
    """A spiral stair looks up everywhere, and its turns lie over each other."""
    turn = np.linspace(0, 6 * math.pi, 120)
    rim = np.stack([np.cos(turn), np.sin(turn), 0.05 * turn], axis=1)
    vertices = np.concatenate([0.3 * rim + [0, 0, 1] * rim * 0.7, rim])
    low = np.arange(119)
    faces = np.concatenate([np.stack([low, low + 120, low + 121], 1), np.stack([low, low + 121, low + 1], 1)])
    atlas = make_atlas(Surface(vertices, faces.astype(np.int32)), np.full(len(faces), 60.0), 1024)
    hits = np.zeros(atlas.width * atlas.height, int)
    for _, row, column in covered_pixels(atlas.uv[atlas.corner], atlas.width, atlas.height):
        np.add.at(hits, row * atlas.width + column, 1)
    assert 0 <= (hits > 1).sum() < 0.01 * hits.sum()


def test_a_single_face_and_one_without_area_have_texels(shoot, baked):
    corner = Surface(
        np.array([[-0.4, -0.4, 0], [0.4, -0.4, 0], [0, 0.4, 0], [0.8, -0.4, 0]]), np.array([[0, 1, 2]], np.int32)
    )
    _, colours, found = baked(corner, shoot())
    assert len(colours) > 100 and found.unseen <= 0.25
    line = corner._replace(faces=np.array([[0, 1, 2], [0, 1, 3]], np.int32))
    assert len(baked(line, shoot())[1]) > 100


def test_a_texture_of_one_texel_is_refused(shoot, baked):
    with refused("mesh.texture-too-small", "1"):
        baked(bumps(), shoot(), size=1)


def test_a_photo_that_is_gone_is_named(shoot, baked, tmp_path):
    scene = shoot()
    (tmp_path / "images/3.png").unlink()
    with refused("mesh.photo-unreadable", "3.png"):
        baked(sheet(CELLS), scene)


def test_a_surface_that_no_photo_sees_has_no_texture(shoot, tmp_path):
    turned = sheet(CELLS)._replace(faces=sheet(CELLS).faces[:, ::-1])
    grey = np.full((len(turned.vertices), 3), GREY, np.uint8)
    seen = find_best_photos(turned, shoot(), tmp_path, {"effects": {}}, known(turned, VOXEL), lambda done: None)
    found = texture_of(turned, grey, seen, 64, lambda what, done: None)
    assert found is None


def test_gutters_repeat_the_nearest_texel(monkeypatch):
    picture, covered = np.zeros((8, 9, 3), np.uint8), np.zeros((8, 9), bool)
    covered[2, 1], covered[6, 7] = True, True
    picture[2, 1], picture[6, 7] = 50, 200
    whole, banded = picture.copy(), picture.copy()
    fill_gutters(whole, covered)
    assert whole[0, 0].tolist() == [50] * 3 and whole[7, 8].tolist() == [200] * 3 and whole[2, 1, 0] == 50
    assert set(np.unique(whole)) == {50, 200}
    monkeypatch.setattr(baking, "GUTTER_ROWS", 3)
    fill_gutters(banded, covered)
    assert np.array_equal(banded, whole), "the same in bands, whose reach covers the picture"
    monkeypatch.setattr(baking, "GUTTER_REACH", 1)
    fill_gutters(picture, covered)
    assert set(np.unique(picture)) == {50, 200}, "nothing stays black"


def test_files_hold_the_texture_the_right_way_up(shoot, baked, tmp_path):
    surface = sheet(8)
    _, _, found = baked(surface, shoot())
    colours = np.zeros_like(surface.vertices, dtype=np.uint8)
    mesh = ColouredMesh(*surface, vertex_normals(surface), colours, found.texture)
    for name, content in (obj_files(mesh) | {"mesh.glb": glb_bytes(mesh, np.eye(3))}).items():
        (tmp_path / name).write_bytes(content)
    for name in ("mesh.obj", "mesh.glb"):
        loaded = trimesh.load_scene(tmp_path / name, process=False).to_geometry()
        assert isinstance(loaded, trimesh.Trimesh)
        visual = loaded.visual
        assert isinstance(visual, TextureVisuals)
        material = visual.material
        picture = material.baseColorTexture if isinstance(material, PBRMaterial) else material.image
        picture = np.ascontiguousarray(np.asarray(picture)[..., :3])
        at = np.asarray(visual.uv) * [picture.shape[1], -picture.shape[0]] + [0, picture.shape[0]]
        inner = (np.abs(np.asarray(loaded.vertices)[:, :2]) < 0.6).all(axis=1)
        difference = sampled_picture(picture, at)[inner] / 255 - pattern(np.asarray(loaded.vertices)[inner])
        assert inner.sum() > 20 and np.abs(difference).mean() < 0.03


VALIDATE = """
let validator
try { validator = require("gltf-validator") } catch { process.exit(77) }
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]))
validator.validateBytes(bytes).then(report => console.log(report.issues.numErrors, report.issues.numWarnings))
"""


@pytest.mark.parametrize("textured", [True, False])
def test_khronos_validator_finds_no_fault(shoot, baked, tmp_path, textured):
    """Needs Node.js and `npm install gltf-validator` in a folder that NODE_PATH names."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    surface = sheet(8)
    texture = baked(surface, shoot())[2].texture if textured else None
    mesh = ColouredMesh(*surface, vertex_normals(surface), np.zeros((len(surface.vertices), 3), np.uint8), texture)
    (tmp_path / "mesh.glb").write_bytes(glb_bytes(mesh, np.eye(3)))
    done = subprocess.run(["node", "-e", VALIDATE, tmp_path / "mesh.glb"], capture_output=True, text=True)
    if done.returncode == 77:
        pytest.skip("npm's gltf-validator is not installed")
    assert (done.stdout.split(), done.stderr) == (["0", "0"], "")
