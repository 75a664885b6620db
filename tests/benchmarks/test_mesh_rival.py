"""Another program's mesh is read as that program means it."""

import numpy as np
import pytest

from benchmarks.mesh_rival import read_obj
from stages.mesh.files import ColouredMesh, obj_files
from stages.mesh.texture.atlas import Atlas, Texture


@pytest.fixture
def mesh():
    rng = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = rng.uniform(0, 9, (6, 2))
    atlas = Atlas(uv, np.arange(6).reshape(2, 3), faces.reshape(-1), 10, 9, 1.0)
    picture = rng.integers(0, 255, (9, 10, 3)).astype(np.uint8)
    none = np.zeros((4, 3), np.uint8)
    return ColouredMesh(rng.normal(size=(4, 3)), faces, np.zeros((4, 3)), none, Texture(atlas, picture))


@pytest.fixture
def file(mesh, tmp_path):
    for name, content in obj_files(mesh).items():
        (tmp_path / name).write_bytes(content)
    return tmp_path / "mesh.obj"


def test_an_obj_file_with_a_texture_is_read_as_written(mesh, file):
    read = read_obj(file)
    assert read.texture and mesh.texture
    assert np.allclose(read.vertices, mesh.vertices, atol=1e-6) and np.array_equal(read.faces, mesh.faces)
    atlas, written = read.texture.atlas, mesh.texture.atlas
    assert np.allclose(atlas.uv[atlas.corner], written.uv[written.corner], atol=1e-5)
    assert np.array_equal(atlas.vertex[atlas.corner], read.faces)
    assert np.array_equal(read.texture.picture, mesh.texture.picture)


def test_an_obj_file_with_two_textures_is_refused(file):
    with file.with_name("mesh.mtl").open("a") as stream:
        stream.write("newmtl second\nmap_Kd second.png\n")
    with pytest.raises(ValueError, match="2 textures"):
        read_obj(file)
