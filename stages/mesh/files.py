"""Mesh files with normals and vertex colours; equal meshes give equal bytes.

A new format is a function and its line in WRITERS. GLB and OBJ are written by trimesh; PLY is not, because trimesh
stores its coordinates as float32. Coordinates stay in the frame they are given in. Two consequences:

* **GLB** is +y up by definition: the mesh's node turns it upright and nothing else moves.
* An sfm frame may lie a million units from its origin (georeferenced cameras), where float32 has steps of 6 cm.
  A mesh that lies further from the origin than 16 times its size is therefore stored around its own centre in GLB, with
  the offset in its node, and with double coordinates in PLY. OBJ gets as many decimals as 1e-7 of the size asks for.

glTF wants linear colour and has no word for radiance: the colours are made linear and the material is unlit
(KHR_materials_unlit; programs without it shade the mesh instead).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj

from nerf.rendering.srgb import linear_light

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MIN_DECIMALS, MAX_DECIMALS = 4, 40  # colours need 4; a scene of 1e-30 units needs 40, and there are no smaller ones
FAR_FROM_ORIGIN = 16  # in sizes of the mesh: beyond it float32 keeps less than a millionth of the size
UNLIT = {
    "name": "radiance",
    "extensions": {"KHR_materials_unlit": {}},
    "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
    "doubleSided": True,
}


class ColouredMesh(NamedTuple):
    """``vertices`` (n, 3) float64, ``faces`` (m, 3), unit ``normals`` (n, 3), ``colours`` (n, 3) sRGB uint8."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def ply_bytes(mesh: ColouredMesh) -> bytes:
    """Binary little-endian PLY with normals and colours; double coordinates where float32 would be too coarse."""
    real, name = ("<f8", "double") if offset_for_float32(mesh.vertices).any() else ("<f4", "float")
    vertex = np.empty(len(mesh.vertices), [("p", real, 3), ("n", "<f4", 3), ("c", "u1", 3)])
    vertex["p"], vertex["n"], vertex["c"] = mesh.vertices, mesh.normals, mesh.colours
    face = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertex)}",
        *(f"property {name} {axis}" for axis in "xyz"),
        *(f"property float n{axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + vertex.tobytes() + face.tobytes()


def obj_bytes(mesh: ColouredMesh) -> bytes:
    """Wavefront OBJ with colours after the coordinates, as MeshLab, Blender and CloudCompare read them."""
    decimals = int(np.clip(np.ceil(7 - np.log10(_size(mesh.vertices))), MIN_DECIMALS, MAX_DECIMALS))
    coloured = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
    return export_obj(coloured, include_normals=False, digits=decimals, header="vertex colours are sRGB").encode(
        "ascii"
    )


def glb_bytes(mesh: ColouredMesh, upright_from_mesh: np.ndarray) -> bytes:
    """Binary glTF 2.0; ``upright_from_mesh`` (3, 3) is the rotation to +y up."""
    offset = offset_for_float32(mesh.vertices)
    centred = trimesh.Trimesh(
        mesh.vertices - offset,
        mesh.faces,
        vertex_normals=mesh.normals,
        vertex_attributes={"_COLOR_0": _linear_rgba(mesh.colours)},
        process=False,
    )
    upright = np.eye(4)
    upright[:3, :3], upright[:3, 3] = upright_from_mesh, upright_from_mesh @ offset
    scene = trimesh.Scene()
    scene.add_geometry(centred, node_name="mesh", geom_name="mesh", transform=upright)
    return export_glb(scene, include_normals=True, tree_postprocessor=_make_unlit)


def _make_unlit(tree: dict[str, Any]) -> None:
    """Make the custom attribute the vertex colour, for trimesh writes only 8 bits of that, and the material unlit."""
    primitive = tree["meshes"][0]["primitives"][0]
    colours = primitive["attributes"].pop("_COLOR_0")
    primitive["attributes"]["COLOR_0"] = colours
    primitive["material"] = 0
    tree["accessors"][colours]["normalized"] = True
    tree["materials"], tree["extensionsUsed"] = [UNLIT], ["KHR_materials_unlit"]


WRITERS: dict[str, Callable[[ColouredMesh, np.ndarray], bytes]] = {
    "glb": glb_bytes,
    "ply": lambda mesh, _: ply_bytes(mesh),
    "obj": lambda mesh, _: obj_bytes(mesh),
}
"""By extension: the mesh and its rotation to +y up, to the content of a file."""


def _linear_rgba(colours: np.ndarray) -> np.ndarray:
    """sRGB bytes to linear 16 bits (IEC 61966-2-1), opaque; 8 linear bits would band in the dark."""
    linear = linear_light(colours / 255)
    alpha = np.ones((len(colours), 1))
    return np.rint(np.concatenate([linear, alpha], axis=1) * 65535).astype("<u2")


def _size(vertices: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def offset_for_float32(vertices: np.ndarray) -> np.ndarray:
    """What must be subtracted from the vertices for float32 to hold them; zero for all but far-away meshes."""
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    far = np.abs(centre).max() > FAR_FROM_ORIGIN * _size(vertices)
    return centre if far else np.zeros(3)
