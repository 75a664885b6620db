"""Mesh files: read back by another library, upright, precise far from the origin, equal bytes."""

import io
import json
import struct
import zipfile
from typing import get_args
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals

from nerf.rendering.srgb_arrays import linear_light
from stages.mesh import Format
from stages.mesh.files import (
    WRITERS,
    Z_UP_TO_Y_UP,
    ColouredMesh,
    glb_bytes,
    obj_files,
    ply_bytes,
    stl_bytes,
    threemf_bytes,
    usdz,
    usdz_file,
)
from stages.mesh.texture.atlas import Atlas, Texture
from tests.refusals import refused

VERTICES = np.array([[0.1, 0, 0], [1, 0.2, 0], [0, 1, 0.3], [0.4, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
COLOURS = np.array([[0, 10, 255], [128, 1, 30], [200, 100, 50], [255, 255, 255]], np.uint8)
NORMALS = VERTICES / np.linalg.norm(VERTICES, axis=1, keepdims=True)
UV = np.array([[1.0, 1], [7, 1], [7, 3], [1, 3]])
FAR = np.array([5e6, -1e6, 200.0])
QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(params=[0.0, 1.0], ids=["at the origin", "far away"])
def mesh(request):
    return ColouredMesh(VERTICES + request.param * FAR, FACES, NORMALS, COLOURS)


def gltf_of(path):
    data = path.read_bytes()
    magic, version, total = struct.unpack("<4sII", data[:12])
    assert (magic, version, total) == (b"glTF", 2, len(data))
    length, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and length % 4 == 0
    binary_length, binary_kind = struct.unpack("<I4s", data[20 + length : 28 + length])
    assert binary_kind == b"BIN\0" and binary_length == len(data) - 28 - length and binary_length % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def colours_of(loaded):
    visual = loaded.visual
    assert isinstance(visual, ColorVisuals)
    return np.asarray(visual.vertex_colors)[:, :3].astype(int)


def upright_mesh(path):
    """The mesh of a GLB with its nodes' transforms applied."""
    geometry = trimesh.load_scene(path, process=False).to_geometry()
    assert isinstance(geometry, trimesh.Trimesh)
    return geometry


def tolerance(mesh):
    """A millionth of the mesh's size: what its own float32 coordinates hold."""
    return 1e-6 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def test_ply_is_read_back_as_it_was(tmp_path, mesh):
    (tmp_path / "mesh.ply").write_bytes(ply_bytes(mesh))
    loaded = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, rtol=0, atol=tolerance(mesh))
    np.testing.assert_array_equal(loaded.faces, FACES)
    np.testing.assert_array_equal(colours_of(loaded), COLOURS)
    header, _, body = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header\n")
    real = "<f8" if b"double x" in header else "<f4"
    stored = np.frombuffer(body, [("p", real, 3), ("n", "<f4", 3), ("c", "u1", 3)], count=4)
    np.testing.assert_allclose(stored["n"], NORMALS, atol=1e-6)


def test_obj_is_read_back_as_it_was(tmp_path, mesh):
    (tmp_path / "mesh.obj").write_bytes(obj_files(mesh)["mesh.obj"])
    loaded = trimesh.load_mesh(tmp_path / "mesh.obj", process=False)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, rtol=0, atol=tolerance(mesh))
    np.testing.assert_array_equal(loaded.faces, FACES)
    assert 0 <= np.abs(colours_of(loaded) - COLOURS).max() <= 1


def test_glb_is_read_back_and_stands_upright(tmp_path, mesh):
    upright = Z_UP_TO_Y_UP @ QUARTER_TURN
    (tmp_path / "mesh.glb").write_bytes(glb_bytes(mesh, upright))
    loaded = upright_mesh(tmp_path / "mesh.glb")
    np.testing.assert_allclose(loaded.vertices, mesh.vertices @ upright.T, rtol=0, atol=tolerance(mesh))
    np.testing.assert_array_equal(loaded.faces, FACES)


def test_shapes_for_printing_are_read_back(tmp_path, mesh):
    """3MF as its specification says, without a library: trimesh asks for lxml."""
    centre = (mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2 if np.abs(mesh.vertices).max() > 1e3 else 0.0
    (tmp_path / "mesh.stl").write_bytes(stl_bytes(mesh))
    stl = trimesh.load_mesh(tmp_path / "mesh.stl", process=False)
    np.testing.assert_allclose(stl.triangles, (mesh.vertices - centre)[FACES], atol=1e-6)
    (tmp_path / "mesh.3mf").write_bytes(threemf_bytes(mesh))
    with zipfile.ZipFile(tmp_path / "mesh.3mf") as archive:
        assert {"[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"} == set(archive.namelist())
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    assert model.attrib["unit"] == "millimeter"
    vertices = [[float(v.attrib[axis]) for axis in "xyz"] for v in model.iter() if v.tag.endswith("}vertex")]
    faces = [[int(t.attrib[f"v{i}"]) for i in (1, 2, 3)] for t in model.iter() if t.tag.endswith("}triangle")]
    np.testing.assert_allclose(vertices, mesh.vertices - centre, atol=1e-6)
    assert faces == FACES.tolist()


@pytest.mark.parametrize("textured", [True, False])
def test_usdz_is_read_back_and_valid(tmp_path, mesh, textured):
    atlas = Atlas(UV, FACES[:, ::-1].copy(), np.array([3, 2, 1, 0]), 8, 4, 1.0)
    picture = np.random.default_rng(0).integers(0, 256, (4, 8, 3), np.uint8)
    mesh = mesh._replace(texture=Texture(atlas, picture) if textured else None)
    upright = Z_UP_TO_Y_UP @ QUARTER_TURN
    content = usdz_file(mesh, upright)
    assert content == usdz_file(mesh, upright)
    (tmp_path / "mesh.usdz").write_bytes(content)
    Usd, UsdGeom, UsdValidation = (usdz.usd(name) for name in ("Usd", "UsdGeom", "UsdValidation"))
    scene = Usd.Stage.Open(str(tmp_path / "mesh.usdz"))
    found = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(scene)
    assert [each.GetMessage() for each in found] == []
    loaded = UsdGeom.Mesh(scene.GetPrimAtPath("/scene/mesh"))
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(loaded.GetPrim()))
    placed = np.array(loaded.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
    vertex = atlas.vertex if textured else np.arange(4)
    np.testing.assert_allclose(placed, mesh.vertices[vertex] @ upright.T, rtol=0, atol=tolerance(mesh))
    faces = np.array(loaded.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(faces, atlas.corner if textured else FACES)
    name, values = ("st", mesh.texture.coordinates()) if textured else ("displayColor", linear_light(COLOURS / 255))
    np.testing.assert_allclose(UsdGeom.PrimvarsAPI(loaded).GetPrimvar(name).Get(), values, atol=1e-6)
    with zipfile.ZipFile(tmp_path / "mesh.usdz") as archive:
        assert archive.namelist() == ["mesh.usdc", "mesh.png"][: 1 + textured]
        if textured:
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(archive.read("mesh.png")))), picture)


def test_usdz_needs_its_extra(monkeypatch):
    monkeypatch.setattr(usdz, "find_spec", lambda _: None)
    with refused("mesh.usd-not-installed"):
        usdz.check_installed()


def test_up_becomes_plus_y():
    np.testing.assert_array_equal(Z_UP_TO_Y_UP @ [0, 0, 1], [0, 1, 0])
    assert np.linalg.det(Z_UP_TO_Y_UP) == 1


def test_glb_holds_the_coordinates_themselves_unless_float_is_too_coarse(tmp_path):
    near, far = (ColouredMesh(VERTICES + offset, FACES, NORMALS, COLOURS) for offset in (0, FAR))
    for mesh, translated in ((near, False), (far, True)):
        (tmp_path / "mesh.glb").write_bytes(glb_bytes(mesh, np.eye(3)))
        document, binary = gltf_of(tmp_path / "mesh.glb")
        offset = np.array(document["nodes"][0].get("matrix", np.eye(4).reshape(-1)))[12:15]
        assert offset.any() == translated
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        stored = np.frombuffer(binary, "<f4", 12, start).reshape(4, 3)
        np.testing.assert_allclose(stored + offset, mesh.vertices, rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.array(accessor["max"]) - accessor["min"], np.ptp(VERTICES, axis=0), atol=1e-6)


def test_glb_colours_are_linear_light_and_unlit(tmp_path):
    (tmp_path / "mesh.glb").write_bytes(glb_bytes(ColouredMesh(VERTICES, FACES, NORMALS, COLOURS), np.eye(3)))
    document, binary = gltf_of(tmp_path / "mesh.glb")
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "KHR_materials_unlit" in document["materials"][0]["extensions"]
    view = document["bufferViews"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    stored = np.frombuffer(binary, "<u2", 16, view["byteOffset"]).reshape(4, 4) / 65535
    np.testing.assert_allclose(stored[3], 1)
    np.testing.assert_allclose(stored[:2, 0], [0, 0.2158605], atol=2e-5)  # sRGB 128 is 21.6 % of full light
    encoded = np.where(stored <= 0.0031308, 12.92 * stored, 1.055 * stored ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(255 * encoded[:, :3]), COLOURS)


@pytest.mark.parametrize("extension", WRITERS)
def test_equal_meshes_are_equal_bytes(mesh, extension):
    assert WRITERS[extension](mesh, np.eye(3)) == WRITERS[extension](mesh, np.eye(3))


def test_every_format_offered_has_a_writer():
    assert set(get_args(Format)) == set(WRITERS)
