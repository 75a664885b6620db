"""Mesh files; equal meshes give equal bytes.

A new format is a function and its line in WRITERS. GLB and OBJ show the texture where there is one; PLY has a colour
per vertex; STL and 3MF, for printing, hold the shape; USDZ is for phones. GLB and STL are written by trimesh, and OBJ
without a texture. PLY is not, because trimesh stores its coordinates as float32, nor is OBJ with a texture, which it
would take apart into charts. Coordinates stay in the frame they are given in. Two consequences:

* **GLB** is +y up by definition, and so is USDZ here: the mesh's node turns it upright and nothing else moves.
* An sfm frame may lie a million units from its origin (georeferenced cameras), where float32 has steps of 6 cm.
  A mesh that lies further from the origin than 16 times its size is therefore stored around its own centre in GLB and
  USDZ, with the offset in its node, in STL and 3MF, without it, and with double coordinates in PLY. OBJ gets as many
  decimals as 1e-7 of the size asks for.

glTF wants linear colours at vertices and has no word for radiance: they are made linear and the material is unlit
(KHR_materials_unlit; programs without it shade the mesh instead).
"""

import io
import zipfile
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.exchange.stl import export_stl
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from nerf.rendering.srgb_arrays import linear_light
from stages.mesh.files.usdz import Drawn, usdz_bytes
from stages.mesh.texture.atlas import Texture

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MIN_DECIMALS, MAX_DECIMALS = 4, 40  # colours need 4; a scene of 1e-30 units needs 40, and there are no smaller ones
FAR_FROM_ORIGIN = 16  # in sizes of the mesh: beyond it float32 keeps less than a millionth of the size
UNLIT = {
    "name": "radiance",
    "extensions": {"KHR_materials_unlit": {}},
    "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
    "doubleSided": True,
}
MTL = b"newmtl texture\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd mesh.png\n"
THREEMF_PARTS = {
    "[Content_Types].xml": '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
    "_rels/.rels": '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0"'
    ' Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
}


class ColouredMesh(NamedTuple):
    """``vertices`` (n, 3) float64, ``faces`` (m, 3), unit ``normals`` (n, 3), ``colours`` (n, 3) sRGB uint8, and the
    ``texture`` of the faces, if there is one."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    texture: Texture | None = None


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


def obj_files(mesh: ColouredMesh) -> dict[str, bytes]:
    """Wavefront OBJ. With a texture, its material and picture beside it; without one, colours after the coordinates, as
    MeshLab, Blender and CloudCompare read them."""
    decimals = int(np.clip(np.ceil(7 - np.log10(_size(mesh.vertices))), MIN_DECIMALS, MAX_DECIMALS))
    if mesh.texture is None:
        coloured = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
        text = export_obj(coloured, include_normals=False, digits=decimals, header="vertex colours are sRGB")
        return {"mesh.obj": text.encode("ascii")}
    corners = np.stack([mesh.faces, mesh.texture.atlas.corner], axis=2).reshape(-1, 6) + 1
    parts = (
        ["mtllib mesh.mtl"],
        _lines("v" + f" %.{decimals}f" * 3, mesh.vertices),
        _lines("vt %.7f %.7f", mesh.texture.coordinates()),
        ["usemtl texture"],
        _lines("f %d/%d %d/%d %d/%d", corners),
    )
    text = "".join(line + "\n" for part in parts for line in part)
    return {"mesh.obj": text.encode("ascii"), "mesh.mtl": MTL, "mesh.png": _png(mesh.texture.picture).getvalue()}


def _lines(form: str, rows: np.ndarray) -> Iterator[str]:
    return (form % tuple(row) for row in rows.tolist())


def stl_bytes(mesh: ColouredMesh) -> bytes:
    """Binary STL: the shape alone, around its own centre where float32 would be too coarse."""
    vertices = mesh.vertices - offset_for_float32(mesh.vertices)
    return export_stl(trimesh.Trimesh(vertices, mesh.faces, process=False))


def threemf_bytes(mesh: ColouredMesh) -> bytes:
    """3MF (3D Manufacturing Format, core specification 1.3): the shape alone, for printing. A unit of ``mesh`` is
    written as a millimetre. Not trimesh's, which asks for lxml and names objects at random."""
    vertices = mesh.vertices - offset_for_float32(mesh.vertices)
    model = [
        '<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xml:lang="en-US"'
        ' xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        '<resources><object id="1" type="model"><mesh><vertices>',
        *_lines('<vertex x="%.9g" y="%.9g" z="%.9g"/>', vertices),
        "</vertices><triangles>",
        *_lines('<triangle v1="%d" v2="%d" v3="%d"/>', mesh.faces),
        '</triangles></mesh></object></resources><build><item objectid="1"/></build></model>',
    ]
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in (*THREEMF_PARTS.items(), ("3D/3dmodel.model", "".join(model))):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))  # equal meshes give equal bytes
            archive.writestr(entry, text, zipfile.ZIP_DEFLATED, compresslevel=5)
    return content.getvalue()


def glb_bytes(mesh: ColouredMesh, upright_from_mesh: np.ndarray) -> bytes:
    """Binary glTF 2.0 with the texture in it, or colours of vertices; ``upright_from_mesh`` (3, 3) is the rotation to
    +y up. A vertex on the border of charts is there once for each."""
    offset, (vertex, faces) = offset_for_float32(mesh.vertices), _split_at_charts(mesh)
    if mesh.texture is None:
        visual, colours = None, _linear_rgba(mesh.colours)
    else:
        colours = None
        with Image.open(_png(mesh.texture.picture)) as picture:
            picture.load()
            material = PBRMaterial(baseColorTexture=picture)
        visual = TextureVisuals(uv=mesh.texture.coordinates(), material=material)
    centred = trimesh.Trimesh(
        mesh.vertices[vertex] - offset,
        faces,
        vertex_normals=mesh.normals[vertex],
        vertex_attributes=None if colours is None else {"_COLOR_0": colours},
        visual=visual,
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(centred, node_name="mesh", geom_name="mesh", transform=_upright(upright_from_mesh, offset))
    return export_glb(scene, include_normals=True, tree_postprocessor=_make_unlit)


def usdz_file(mesh: ColouredMesh, upright_from_mesh: np.ndarray) -> bytes:
    """USDZ with the texture in it, or colours of vertices; as :func:`glb_bytes`."""
    offset, (vertex, faces) = offset_for_float32(mesh.vertices), _split_at_charts(mesh)
    texture = mesh.texture
    drawn = Drawn(
        points=mesh.vertices[vertex] - offset,
        normals=mesh.normals[vertex],
        faces=faces,
        uv=None if texture is None else texture.coordinates(),
        colours=linear_light(mesh.colours[vertex] / 255),
        picture=b"" if texture is None else _png(texture.picture).getvalue(),
    )
    return usdz_bytes(drawn, _upright(upright_from_mesh, offset))


def _split_at_charts(mesh: ColouredMesh) -> tuple[np.ndarray, np.ndarray]:
    """The vertices, those on the border of charts once for each, as indices (n,), and the faces of these (m, 3)."""
    if mesh.texture is None:
        return np.arange(len(mesh.vertices)), mesh.faces
    return mesh.texture.atlas.vertex, mesh.texture.atlas.corner


def _upright(upright_from_mesh: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The matrix of the node of vertices less ``offset``."""
    upright = np.eye(4)
    upright[:3, :3], upright[:3, 3] = upright_from_mesh, upright_from_mesh @ offset
    return upright


def _png(picture: np.ndarray) -> io.BytesIO:
    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="PNG", compress_level=3)
    content.seek(0)
    return content


def _make_unlit(tree: dict[str, Any]) -> None:
    """Make the material unlit, and the custom attribute the vertex colour, for trimesh writes only 8 bits of that."""
    primitive = tree["meshes"][0]["primitives"][0]
    unlit = {**UNLIT, "pbrMetallicRoughness": dict(UNLIT["pbrMetallicRoughness"])}
    if "_COLOR_0" in primitive["attributes"]:
        colours = primitive["attributes"].pop("_COLOR_0")
        primitive["attributes"]["COLOR_0"] = colours
        tree["accessors"][colours]["normalized"] = True
    else:
        unlit["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    primitive["material"] = 0
    tree["materials"], tree["extensionsUsed"] = [unlit], ["KHR_materials_unlit"]


WRITERS: dict[str, Callable[[ColouredMesh, np.ndarray], dict[str, bytes]]] = {
    "glb": lambda mesh, upright: {"mesh.glb": glb_bytes(mesh, upright)},
    "ply": lambda mesh, _: {"mesh.ply": ply_bytes(mesh)},
    "obj": lambda mesh, _: obj_files(mesh),
    "stl": lambda mesh, _: {"mesh.stl": stl_bytes(mesh)},
    "3mf": lambda mesh, _: {"mesh.3mf": threemf_bytes(mesh)},
    "usdz": lambda mesh, upright: {"mesh.usdz": usdz_file(mesh, upright)},
}
"""By format: the mesh and its rotation to +y up, to files by name."""


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
