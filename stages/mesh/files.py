"""PLY, OBJ and GLB with vertex colours; equal meshes give equal bytes.

Coordinates stay in the frame they are given in (the sfm frame unless asked otherwise). Two consequences:

* **GLB** is +y up by definition, so a root node's matrix turns the mesh upright and nothing else moves.
* An sfm frame may lie a million units from its origin (georeferenced cameras), where float32 has steps of 6 cm.
  glTF knows no doubles, so a mesh that lies further from the origin than 16 times its size is stored around its
  own centre, with the offset in the translation of the mesh's node. PLY then holds doubles, and OBJ as many
  decimals as 1e-7 of the size asks for.

glTF wants linear colour and has no word for radiance: the colours are made linear and the material is unlit
(KHR_materials_unlit; programs without it shade the mesh instead).
"""

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf.rendering.srgb import linear_light

FLOAT, UNSIGNED_INT, UNSIGNED_SHORT = 5126, 5125, 5123  # glTF component types
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MOST_DECIMALS = 40  # what a scene of 1e-30 units asks for, and there are no smaller ones
FAR_FROM_ORIGIN = 16  # in sizes of the mesh: beyond it float32 keeps less than a millionth of the size


class ColouredMesh(NamedTuple):
    """``vertices`` (n, 3) float64, ``faces`` (m, 3), unit ``normals`` (n, 3), ``colours`` sRGB uint8."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def write_ply(path: Path, mesh: ColouredMesh) -> None:
    """Binary little-endian PLY with normals and colours; double coordinates where float would be too coarse."""
    real, name = ("<f8", "double") if _offset(mesh.vertices).any() else ("<f4", "float")
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
    path.write_bytes("\n".join(header).encode("ascii") + vertex.tobytes() + face.tobytes())


def write_obj(path: Path, mesh: ColouredMesh) -> None:
    """Wavefront OBJ with colours after the coordinates, as MeshLab, Blender and CloudCompare read them."""
    decimals = int(np.clip(np.ceil(7 - np.log10(_size(mesh.vertices))), 0, MOST_DECIMALS))
    point = f"v %.{decimals}f %.{decimals}f %.{decimals}f %.4f %.4f %.4f"
    rows = np.concatenate([mesh.vertices, mesh.colours / 255], axis=1).tolist()
    lines = [point % tuple(row) for row in rows]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", "ascii")


def write_glb(path: Path, mesh: ColouredMesh, upright_from_mesh: np.ndarray) -> None:
    """Binary glTF 2.0; ``upright_from_mesh`` (3, 3) is the root node's rotation to +y up."""
    offset = _offset(mesh.vertices)
    blocks = {
        "POSITION": (mesh.vertices - offset).astype("<f4"),
        "NORMAL": mesh.normals.astype("<f4"),
        "COLOR_0": _linear_rgba(mesh.colours),
        "indices": mesh.faces.astype("<u4").reshape(-1),
    }
    document = json.dumps(_gltf(blocks, upright_from_mesh, offset), sort_keys=True, separators=(",", ":")).encode()
    document += b" " * (-len(document) % 4)
    binary = b"".join(block.tobytes() for block in blocks.values())
    chunks = (
        struct.pack("<I4s", len(document), b"JSON") + document + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _gltf(blocks: dict[str, np.ndarray], upright_from_mesh: np.ndarray, offset: np.ndarray) -> dict[str, Any]:
    """The JSON part: one mesh below an upright root; ``blocks`` follow one another in the one buffer."""
    matrix = np.eye(4)
    matrix[:3, :3] = upright_from_mesh
    views, accessors, start = [], [], 0
    for name, block in blocks.items():
        target = ELEMENT_ARRAY_BUFFER if name == "indices" else ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": start, "byteLength": block.nbytes, "target": target})
        accessors.append(_accessor(len(accessors), name, block))
        start += block.nbytes
    attributes = {name: index for index, name in enumerate(blocks) if name != "indices"}
    primitive = {"attributes": attributes, "indices": len(attributes), "material": 0}
    material = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}
    place = {"translation": offset.tolist()} if offset.any() else {}
    return {
        "asset": {"version": "2.0", "generator": "pipeline"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "upright", "matrix": matrix.T.reshape(-1).tolist(), "children": [1]},
            {"name": "mesh", "mesh": 0, **place},
        ],
        "meshes": [{"name": "mesh", "primitives": [primitive]}],
        "materials": [{"name": "radiance", "extensions": {"KHR_materials_unlit": {}}, **material}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _accessor(view: int, name: str, block: np.ndarray) -> dict[str, Any]:
    kinds = {
        "POSITION": {"componentType": FLOAT, "type": "VEC3"},
        "NORMAL": {"componentType": FLOAT, "type": "VEC3"},
        "COLOR_0": {"componentType": UNSIGNED_SHORT, "type": "VEC4", "normalized": True},
        "indices": {"componentType": UNSIGNED_INT, "type": "SCALAR"},
    }
    bounds = {}
    if name == "POSITION":  # demanded by the specification
        bounds = {"min": block.min(axis=0).tolist(), "max": block.max(axis=0).tolist()}
    return {"bufferView": view, "count": len(block), **kinds[name], **bounds}


def _linear_rgba(colours: np.ndarray) -> np.ndarray:
    """sRGB bytes to linear 16 bits (IEC 61966-2-1), opaque; 8 linear bits would band in the dark."""
    linear = linear_light(colours / 255)
    alpha = np.ones((len(colours), 1))
    return np.rint(np.concatenate([linear, alpha], axis=1) * 65535).astype("<u2")


def _size(vertices: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def _offset(vertices: np.ndarray) -> np.ndarray:
    """What must be taken off the vertices for float32 to hold them; zero for all but far-away meshes."""
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    far = np.abs(centre).max() > FAR_FROM_ORIGIN * _size(vertices)
    return centre if far else np.zeros(3)
