"""Stage mesh on fields with known surfaces: the files, their frame, what is said, and what is refused."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
import pytest
import torch
import trimesh

from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages import mesh
from stages.contract import run_stage
from stages.io.files import write_json, write_tensors
from stages.io.photos import write_photos
from stages.mesh import extraction, preview, resolution, visibility
from stages.mesh.extraction import vertex_colours
from stages.mesh.face_count import default_faces
from stages.report.page import MESH_FIGURES
from tests.refusals import refused
from tests.stages.mesh.test_files import colours_of, upright_mesh

RADIUS = 0.4
TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
SCENE_FROM_SFM = Similarity(0.25, TURN, np.array([0.1, -0.2, 0.3]))
VOXEL = 1.8 / 47
NO_POINTS = np.zeros((0, 3), np.float32)


SMALL = (
    (preview, "WIDTH", 60),
    (preview, "HEIGHT", 50),
    (visibility, "MAX_MAP_SIDE", 32),
    (extraction, "ISO_LEVEL_RAYS", 256),
)


class Solid:
    """A stand-in field: solid where the signed distance is negative, coloured by position."""

    chunk_rays = 64

    def __init__(self, distance, inside=300.0):
        self.distance, self.inside = distance, inside

    def density(self, points):
        return self.inside * torch.sigmoid(-self.distance(points) / 0.01)

    def density_and_colour(self, points, directions):
        return self.density(points), self.colour(points)

    def colour(self, points):
        return 0.5 + points / 1.8

    def render(self, rays, background):
        raise NotImplementedError


def ball(points):
    return points.norm(dim=-1) - RADIUS


def hollow_ball_and_speck(points):
    """A ball with a cavity that no photo sees, and a speck that they all see."""
    speck = (points - torch.tensor([0.7, 0.7, 0.7])).norm(dim=-1) - 0.05
    return torch.minimum(torch.maximum(ball(points), 0.2 - points.norm(dim=-1)), speck)


def two_balls(points):
    apart = torch.tensor([0.0, 0.0, 0.5])
    return torch.minimum((points - apart).norm(dim=-1), (points + apart).norm(dim=-1)) - 0.3


def plain(points):
    return points[..., 2] + 0.2


def plain_with_ditch(points):
    return points[..., 2] + 0.2 + 0.6 * (points[..., 0].abs() < 0.2)


def scene_around(count=12):
    views = []
    for number in range(count):
        angle, height = 2 * math.pi * number / count, 0.6 + 0.4 * (number % 3)
        centre = 2.0 * np.array([math.cos(angle), math.sin(angle), height])
        pose = look_at(centre[None], np.zeros(3))[0]
        split = "test" if number % 8 == 0 else "train"
        views.append(View(f"{number}.jpg", f"images/{number}.png", 0, pose, 1.0, 6.0, split))
    camera = Camera("SIMPLE_RADIAL", 80, 60, (75.0, 40.0, 30.0, 0.02))
    return Scene((camera,), tuple(views), SCENE_FROM_SFM, True, True, "object-centric", True)


@pytest.fixture
def run_mesh(tmp_path, progress, monkeypatch):
    """Run the stage on a stand-in field; returns the result and the folder it wrote."""
    for module, name, small in SMALL:
        monkeypatch.setattr(module, name, small)

    def run(model, folder="mesh", scene=None, points=NO_POINTS, learnt=None, metres=None, **settings):
        inputs = {name: tmp_path / name for name in mesh.STAGE.inputs}
        for path in (*inputs.values(), tmp_path / folder):
            path.mkdir(exist_ok=True)
        write_photos(inputs["ingest"], [], [], {})
        write_json(inputs["normalise"] / "scene.json", (scene or scene_around()).to_json())
        write_tensors(inputs["normalise"] / "points.safetensors", {"xyz": points})
        info = {"rays": 1000, "effects": learnt or {}, "settings": {"space": {"kind": "box"}}}
        write_json(inputs["train"] / "field.json", info)
        write_json(inputs["scale"] / "scale.json", {"metres_per_unit": metres})
        monkeypatch.setattr(extraction, "load_field", lambda *_: (model, info))
        config = mesh.Config.model_validate({"resolution": 48, "texture_size": 0, "refine": False} | settings)
        return run_stage(mesh.STAGE, config, inputs, tmp_path / folder, progress), tmp_path / folder

    return run


def test_files_are_in_metres_where_the_scale_is_known(run_mesh, progress):
    sizes = {}
    for metres, frame in ((None, None), (2.0, None), (2.0, "sfm")):
        result, folder = run_mesh(
            Solid(ball), folder=f"{metres} {frame}", metres=metres, frame=frame, formats=("ply", "glb", "stl")
        )
        loaded = {name: trimesh.load(folder / f"mesh.{name}", force="mesh") for name in ("ply", "glb", "stl")}
        sizes[metres, frame] = [float(max(mesh.extents)) for mesh in loaded.values()]
        assert result.facts["frame"] == (frame or ("metric" if metres else "sfm"))
    plain = sizes[None, None]
    assert plain == pytest.approx([2 * RADIUS / 0.25] * 3, rel=0.1) and sizes[2.0, "sfm"] == plain
    assert sizes[2.0, None] == pytest.approx([2 * plain[0], 2 * plain[1], 2000 * plain[2]], rel=1e-4)


def test_metres_need_a_scale_that_is_known(run_mesh):
    with refused("mesh.no-metres"):
        run_mesh(Solid(ball), frame="metric")


def test_a_ball_becomes_a_closed_ball_in_the_sfm_frame(run_mesh, progress):
    result, folder = run_mesh(Solid(ball), formats=("glb", "ply", "obj"))
    assert result.outputs == ("preview.png", "small_mesh.safetensors", "mesh.glb", "mesh.obj", "mesh.ply")
    assert all((folder / name).stat().st_size > 1000 for name in result.outputs)
    assert result.line.endswith("faces, 1 component, watertight")
    for name in ("mesh.ply", "mesh.obj"):
        loaded = trimesh.load_mesh(folder / name, process=False)
        in_scene = SCENE_FROM_SFM.points(np.asarray(loaded.vertices))
        radii = np.linalg.norm(in_scene, axis=1)
        assert abs(radii.mean() - RADIUS) < VOXEL and radii.std() < 0.2 * VOXEL
        assert loaded.is_watertight and loaded.volume > 0
        assert 0 < abs(loaded.volume / (4 / 3 * np.pi * (radii.mean() / 0.25) ** 3) - 1) < 0.02
        expected = np.rint(255 * (0.5 + in_scene / 1.8))
        assert np.abs(colours_of(loaded) - expected).max() <= 255 * VOXEL / 1.8, "those of a grid cell away, at most"
    assert "mesh.iso-level" in progress.codes
    assert any("density at 48³ points" in message for message, _ in progress.updates)


class Painted(Solid):
    """A field that is red where there is something, blue deeper in, and white where there is nothing."""

    def density(self, points):
        return self.inside * (self.distance(points) < 0)

    def colour(self, points):
        distance = self.distance(points)[..., None]
        inside = torch.where(distance > -0.5 * VOXEL, torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]))
        return torch.where(distance < 0, inside, torch.ones(3))


def test_colours_are_those_of_the_first_surface_seen(run_mesh):
    _, folder = run_mesh(Painted(ball, inside=3000.0), max_faces=1500)
    colours = colours_of(trimesh.load_mesh(folder / "mesh.ply", process=False))
    assert (colours[:, :2] < (256, 64)).mean() > 0.99, "not white: what is outside"
    assert (colours[:, 2] < 64).mean() > 0.99, "nor blue: what is hidden by the red"


class Sheet:
    """A thin red sheet before nothing, where colours are white."""

    def density_and_colour(self, points, directions):
        density = 10.0 * ((points[..., 2] > 0) & (points[..., 2] < 0.5 * VOXEL))
        red, white = torch.tensor([1.0, 0, 0]), torch.ones(3)
        return density, torch.where(density[..., None] > 0, red, white)


def test_a_sheet_that_lets_light_through_has_its_own_colour():
    vertices, along_z = np.array([[0.0, 0, 0], [0.3, 0, 5.0]]), np.tile([0.0, 0, 1], (2, 1))
    sheet: Any = Sheet()
    colours = vertex_colours(sheet, vertices, along_z, np.full(len(vertices), VOXEL), "cpu")
    assert colours.tolist() == [[255, 0, 0], [255, 255, 255]], "the second vertex has nothing about it"


def test_the_facts_are_those_of_the_files(run_mesh):
    result, folder = run_mesh(Solid(ball))
    loaded = trimesh.load_mesh(folder / "mesh.ply", process=False)
    facts = result.facts
    assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    assert facts.keys() - MESH_FIGURES.keys() == {"grid_space"}, "the report has no words for others"
    assert (facts["vertices"], facts["faces"]) == (len(loaded.vertices), len(loaded.faces))
    assert facts["watertight"] is True and facts["boundary"] == "watertight"
    assert facts["surface_area"] == pytest.approx(loaded.area, rel=1e-5)
    assert facts["voxel"] == pytest.approx(VOXEL / 0.25)
    assert (facts["components_kept"], facts["components_dropped"], facts["faces_outside_photos"]) == (1, 0, 0)
    assert (facts["resolution"], facts["frame"]) == (48, "sfm")
    assert 0 < facts["iso_level"] < 300 and 0 < facts["surface_error_voxels"] < 0.5


def test_colours_at_a_reference_exposure_say_at_which(run_mesh):
    result, _ = run_mesh(Solid(ball))
    assert "appearance" not in result.facts and "expos" not in result.line
    stop = math.log(2)
    photos = {"1.jpg": [0.0, 0.1 * stop, 0.2 * stop], "2.jpg": [stop] * 3, "3.jpg": [2 * stop] * 3}
    result, _ = run_mesh(Solid(ball), "exposed", learnt={"exposure": photos})
    assert result.facts["appearance"] == "reference exposure, +0.90 EV over the least exposed photo"
    assert result.line.endswith("watertight · reference exposure, +0.90 EV over the least exposed photo")


def test_glb_stands_upright_and_the_scene_frame_can_be_had(run_mesh):
    """glTF's up is +y, the scene's is +z."""
    for frame in ("sfm", "scene"):
        _, folder = run_mesh(Solid(ball), folder=frame, frame=frame)
        vertices = np.asarray(upright_mesh(folder / "mesh.glb").vertices)
        centre = np.zeros(3) if frame == "scene" else mesh_centre_upright()
        scale = 1.0 if frame == "scene" else 4.0
        np.testing.assert_allclose(np.linalg.norm(vertices - centre, axis=1), scale * RADIUS, atol=scale * VOXEL)
    scene_vertices = np.asarray(trimesh.load_mesh(folder / "mesh.ply", process=False).vertices)
    np.testing.assert_allclose(vertices, scene_vertices @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), atol=1e-6)


def mesh_centre_upright():
    """Where the scene's origin comes to lie in the GLB of the sfm frame."""
    x, y, z = TURN @ SCENE_FROM_SFM.inverse().points(np.zeros(3))
    return np.array([x, z, -y])


def test_equal_inputs_give_equal_bytes(run_mesh):
    results = [run_mesh(Solid(ball), folder=name, formats=("glb", "ply", "obj")) for name in ("one", "two")]
    for name in results[0][0].outputs:
        assert (results[0][1] / name).read_bytes() == (results[1][1] / name).read_bytes()
    assert results[0][0] == results[1][0]


def test_faces_are_smoothed_where_asked_for(run_mesh):
    rough, smooth = (
        trimesh.load_mesh(run_mesh(Solid(ball), folder=str(asked), smooth=asked)[1] / "mesh.ply", process=False)
        for asked in (False, True)
    )
    np.testing.assert_array_equal(rough.faces, smooth.faces)
    apart = np.linalg.norm(rough.vertices - smooth.vertices, axis=1)
    assert 0 < apart.max() < VOXEL / 0.25


def test_specks_and_cavities_are_dropped(run_mesh):
    result, folder = run_mesh(Solid(hollow_ball_and_speck), min_component=0.05)
    assert result.line.endswith("1 component, watertight")
    assert (result.facts["components_kept"], result.facts["components_dropped"]) == (1, 2)
    loaded = trimesh.load_mesh(folder / "mesh.ply", process=False)
    radii = np.linalg.norm(SCENE_FROM_SFM.points(np.asarray(loaded.vertices)), axis=1)
    assert np.abs(radii - RADIUS).max() < VOXEL
    everything, _ = run_mesh(Solid(hollow_ball_and_speck), folder="all", keep="all")
    assert everything.facts["components_kept"] == 3


def test_a_part_that_no_sparse_point_locates_is_dropped(run_mesh):
    direction = np.random.default_rng(0).normal(size=(500, 3))
    above = (0.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True) + [0, 0, 0.5]).astype(np.float32)
    result, folder = run_mesh(Solid(two_balls), points=above)
    assert (result.facts["components_kept"], result.facts["components_dropped"]) == (1, 1)
    loaded = trimesh.load_mesh(folder / "mesh.ply", process=False)
    assert SCENE_FROM_SFM.points(np.asarray(loaded.vertices))[:, 2].min() > 0.15
    unknown, _ = run_mesh(Solid(two_balls), folder="unknown")
    assert unknown.facts["components_kept"] == 2


def test_a_plain_ends_at_box_or_photos(run_mesh):
    result, folder = run_mesh(Solid(plain))
    assert result.facts["watertight"] is False
    assert "open at the edge of the region" in result.line
    loaded = trimesh.load_mesh(folder / "mesh.ply", process=False)
    in_scene = SCENE_FROM_SFM.points(np.asarray(loaded.vertices))
    assert np.abs(in_scene[:, 2] + 0.2).max() < VOXEL  # nothing was invented below to close it
    far = replace(scene_around(), views=tuple(replace(v, far=2.2) for v in scene_around().views))
    near_part, _ = run_mesh(Solid(plain), folder="near", scene=far)
    assert 0 < near_part.facts["surface_area"] < 0.9 * result.facts["surface_area"]
    assert "where too few photos see it" in near_part.line


def test_flat_scenes_have_smaller_voxels(run_mesh):
    """The same plain, by points on it that photos have which do not stand around it."""
    points = np.random.default_rng(0).uniform([-0.9, -0.9, -0.25], [0.9, 0.9, -0.15], (1000, 3)).astype(np.float32)
    scene = replace(scene_around(), capture_type="inside-out")
    cube, _ = run_mesh(Solid(plain), scene=scene, frame="scene")
    result, folder = run_mesh(Solid(plain), folder="flat", scene=scene, points=points, frame="scene")
    assert cube.facts["voxel"] == pytest.approx(VOXEL) and 0.4 * VOXEL < result.facts["voxel"] < 0.6 * VOXEL
    assert (result.facts["resolution"], result.facts["boundary"]) == (48, cube.facts["boundary"])
    assert result.facts["surface_area"] == pytest.approx(cube.facts["surface_area"], rel=0.02)
    heights = np.asarray(trimesh.load_mesh(folder / "mesh.ply", process=False).vertices)[:, 2]
    assert np.abs(heights + 0.2).max() < 0.5 * VOXEL


def test_decimation_leaves_as_many_faces_as_asked_for(run_mesh):
    result, _ = run_mesh(Solid(ball), max_faces=1000)
    assert 900 <= result.facts["faces"] <= 1000
    assert result.line == "1000 faces, 1 component, watertight"


def test_more_faces_than_asked_for_are_told(run_mesh, progress):
    """Borders stay in decimation, and closing them comes after it."""
    half = {"box": (-1.0, -1.0, 0.0, 1.0, 1.0, 1.0), "frame": "scene", "max_faces": 120}
    run_mesh(Solid(ball), max_faces=120)
    assert "mesh.more-faces" not in progress.codes
    for close in (0.0, 1.0):
        result, _ = run_mesh(Solid(ball), folder=f"{close}", close=close, **half)
        assert result.facts["faces"] > 120 and progress.names("mesh.more-faces", result.facts["faces"], 120)
        progress.clear()


def crumbs(points):
    """Balls on a cubic lattice, five along each axis, none at the edge of the region."""
    return (points - 0.3 * (points / 0.3).round().clamp(-2, 2)).norm(dim=-1) - 0.08


def test_a_mesh_that_decimation_would_remove_is_refused(run_mesh):
    with refused("mesh.decimated-away", "--mesh.max-faces 100", "125 components"):
        run_mesh(Solid(crumbs), keep="all", max_faces=100)


@pytest.mark.parametrize(
    ("model", "settings", "code"),
    [
        (Solid(ball, inside=0.0), {}, "mesh.empty-field"),
        (Solid(lambda p: torch.full_like(p[..., 0], -9.0)), {}, "mesh.uniform-field"),
        (Solid(ball), {"iso_level": 1e6}, "mesh.level-out-of-range"),
    ],
)
def test_fields_without_a_surface_write_nothing(run_mesh, tmp_path, model, settings, code):
    with refused(code, *(f"{value:g}" for value in settings.values())):
        run_mesh(model, **settings)
    assert list((tmp_path / "mesh").iterdir()) == []


def test_a_grid_beyond_memory_is_refused_with_one_that_fits(run_mesh, monkeypatch):
    memory = psutil.virtual_memory()._replace(available=16 * 40**3)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    with refused("hardware.not-enough-memory", "the mesh", "--mesh.resolution 32"):
        run_mesh(Solid(ball), resolution=64)


def test_resolution_for_seconds_follows_the_box(run_mesh, monkeypatch):
    asked = []
    monkeypatch.setattr(resolution, "reference_seconds", lambda: 0.02)
    monkeypatch.setattr(resolution, "density_query_seconds", lambda train, space, box: asked.append(box) or 2e-7)
    points = np.random.default_rng(0).uniform([-0.9, -0.9, -0.25], [0.9, 0.9, -0.15], (1000, 3)).astype(np.float32)
    for capture_type in ("object-centric", "inside-out"):
        scene = replace(scene_around(), capture_type=capture_type)
        run_mesh(Solid(plain), scene=scene, points=points, resolution=None, seconds=1.0)
    cube, flat = asked
    assert np.ptp(cube, axis=0).tolist() == [1.8, 1.8, 1.8]
    assert np.ptp(flat, axis=0) == pytest.approx([1.8, 1.8, 0.28], abs=0.01)


def test_fog_becomes_a_mesh_that_says_it_is_fog(run_mesh, progress):
    result, _ = run_mesh(Solid(ball, inside=0.3))
    assert result.facts["faces"] > 100 and result.facts["surface_error_voxels"] is None
    assert result.line.endswith("; the field has no clear surface yet, train for longer")
    assert progress.names("mesh.iso-level", "no surface yet")


def test_the_level_asked_for_is_taken(run_mesh):
    result, _ = run_mesh(Solid(ball), iso_level=150.0)
    assert (result.facts["iso_level"], result.facts["iso_level_reason"]) == (150.0, "given")


@pytest.mark.parametrize(
    ("rays", "resolution"), [(0, 96), (50_000, 96), (100_000, 128), (350_000, 192), (10**6, 256), (10**9, 256)]
)
def test_the_resolution_follows_the_training(tmp_path, progress, rays, resolution):
    write_json(tmp_path / "field.json", {"rays": rays})
    write_json(tmp_path / "scale.json", {"metres_per_unit": None})
    assert mesh.plan(mesh.Config(), {"train": tmp_path, "scale": tmp_path}, progress).resolution == resolution
    assert mesh.plan(mesh.Config(resolution=77), {"train": tmp_path, "scale": tmp_path}, progress).resolution == 77


def test_faces_outside_of_the_box_are_left_out(run_mesh):
    upper = (-1.0, -1.0, 0.0, 1.0, 1.0, 1.0)
    result, folder = run_mesh(Solid(ball), box=upper, frame="scene")
    vertices = np.asarray(trimesh.load_mesh(folder / "mesh.ply", process=False).vertices)
    assert 0 <= vertices[:, 2].min() < VOXEL and abs(vertices[:, 2].max() - RADIUS) < VOXEL
    assert result.facts["watertight"] is False
    with refused("mesh.nothing-in-box", "0.4"):
        run_mesh(Solid(ball), folder="beside", box=(0.8, 0.8, 0.8, 0.9, 0.9, 0.9), frame="scene")


def test_the_frame_of_the_box_is_told(run_mesh, progress):
    """The same numbers mean another box once the scale is known."""
    below_the_middle, areas, shares = (-3.0, -3.0, -3.0, 3.0, 3.0, -0.4), [], []
    for metres, unit in ((None, "units of the sfm frame"), (0.5, "metres")):
        result, _ = run_mesh(Solid(ball), folder=unit, box=below_the_middle, metres=metres)
        (told,) = progress.said("mesh.cropped")
        assert told.endswith(unit)
        areas.append(result.facts["surface_area"] / (metres or 1.0) ** 2)
        shares.append(float(told.partition("%")[0]))
        progress.clear()
    assert 45 < shares[0] < 52 and 20 < shares[1] < 40
    assert areas[1] / areas[0] == pytest.approx(shares[1] / shares[0], rel=0.05)


@pytest.mark.parametrize("box", [(1, 1, 1, 0, 0, 0), (0, 0, 0, 1, 1, 0), (0, 2, 0, 1, 1, 1)])
def test_a_box_without_inside_is_refused(box):
    with pytest.raises(ValueError, match="lowest"):
        mesh.Config(box=box)


def test_components_are_those_of_the_files(run_mesh):
    """Not those before the box cut one away, or one into two."""
    lower, wall = (-1.0, -1.0, -1.0, 1.0, 1.0, 0.0), (-1.0, -1.0, -0.4, 1.0, 1.0, 0.4)
    for model, box, number in ((two_balls, lower, 1), (plain_with_ditch, wall, 2)):
        result, folder = run_mesh(Solid(model), folder=f"{number}", keep="all", box=box, frame="scene")
        loaded = trimesh.load_mesh(folder / "mesh.ply", process=False)
        assert loaded.body_count == number == result.facts["components_kept"]
        assert f"{number} component" in result.line


def test_closing_says_how_much_is_invented(run_mesh):
    upper = (-1.0, -1.0, 0.0, 1.0, 1.0, 1.0)
    result, folder = run_mesh(Solid(ball), box=upper, frame="scene", close=1.0, formats=("stl", "3mf", "ply"))
    assert result.facts["watertight"] is True and result.facts["boundary"] == "watertight"
    assert (result.facts["holes_closed"], result.facts["holes_left"]) == (1, 0)
    assert result.facts["invented_area_share"] == pytest.approx(1 / 3, abs=0.03), "a disc, beside half a ball"
    assert result.line.endswith("% of the area invented")
    for name in ("mesh.stl", "mesh.ply"):
        assert trimesh.load_mesh(folder / name).is_watertight
    kept, _ = run_mesh(Solid(ball), folder="open", box=upper, frame="scene", close=0.1)
    assert (kept.facts["holes_closed"], kept.facts["holes_left"]) == (0, 1)


class Undefined(Solid):
    """A field whose colours are not finite."""

    def colour(self, points):
        return super().colour(points) * math.nan


def test_colours_that_are_not_finite_are_refused(run_mesh, tmp_path):
    with refused("mesh.colours-not-finite", "NaN"):
        run_mesh(Undefined(ball))
    assert list((tmp_path / "mesh").iterdir()) == []


@pytest.mark.parametrize(
    ("size", "found", "kept"),
    [(4096, 50_000, 100_000), (4096, 800_000, 200_000), (4096, 9_000_000, 300_000), (0, 50_000, 300_000)],
)
def test_faces_follow_texture_and_surface(size, found, kept):
    assert default_faces(found, textured=size > 0) == kept
