"""USDZ: a mesh in Universal Scene Description, packed with its picture, as phones and tablets show it in a room.

Written by usd-core (Pixar), which is an extra. A unit is written as a metre, as phones show a mesh in its size. The
material gives off the colours and reflects nothing (UsdPreviewSurface), for they are what the photos saw.
"""

import zipfile
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from stages.contract import StageError

INSTALL = "`pip install -c constraints.txt '.[usdz]'` in the clone"
ALIGNMENT = 64  # bytes: where each file of a package begins
LOCAL_HEADER, EXTRA_HEADER = 30, 4  # bytes of a ZIP file before its content, besides names


class Drawn(NamedTuple):
    """What is drawn: ``points`` (n, 3) and unit ``normals`` (n, 3), float32, ``faces`` (m, 3), ``uv`` (n, 2) in [0, 1],
    v upwards, or linear ``colours`` (n, 3) float32 in their place, and the picture as PNG."""

    points: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    colours: np.ndarray
    picture: bytes


def check_installed() -> None:
    """Raises StageError without usd-core."""
    if find_spec("pxr") is None:
        raise StageError(
            "mesh.usd-not-installed",
            "cannot write USDZ",
            "the package usd-core is not installed",
            f"Install it with {INSTALL}, or leave usdz out of --mesh.formats.",
        )


def usd(module: str) -> Any:
    """A module of usd-core, which names no types."""
    return import_module(f"pxr.{module}")


def usdz_bytes(drawn: Drawn, upright_from_mesh: np.ndarray) -> bytes:
    """A package of the mesh, moved by ``upright_from_mesh`` (4, 4) to +y up. Equal meshes give equal bytes."""
    with TemporaryDirectory() as folder:
        layer = Path(folder) / "mesh.usdc"
        _write_layer(drawn, upright_from_mesh, layer)
        files = {layer.name: layer.read_bytes()}
    if drawn.uv is not None:
        files["mesh.png"] = drawn.picture
    return _packed(files)


def _write_layer(drawn: Drawn, upright_from_mesh: np.ndarray, path: Path) -> None:
    Gf, Sdf, Usd, UsdGeom, Vt = (usd(name) for name in ("Gf", "Sdf", "Usd", "UsdGeom", "Vt"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/scene")
    root.AddTransformOp().Set(Gf.Matrix4d(upright_from_mesh.T.tolist()))  # USD's vectors are rows
    stage.SetDefaultPrim(root.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/scene/mesh")
    points = drawn.points.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(drawn.faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(drawn.faces.astype(np.int32).reshape(-1)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(drawn.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    if drawn.uv is None:
        colour = primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
        colour.Set(Vt.Vec3fArray.FromNumpy(drawn.colours.astype(np.float32)))
    else:
        at = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        at.Set(Vt.Vec2fArray.FromNumpy(drawn.uv.astype(np.float32)))
    _add_material(stage, mesh, textured=drawn.uv is not None)
    stage.GetRootLayer().Save()


def _add_material(stage: Any, mesh: Any, textured: bool) -> None:
    """Black, and giving off the colours: phones' light neither shades nor tints them."""
    UsdShade, types = usd("UsdShade"), usd("Sdf").ValueTypeNames
    material = UsdShade.Material.Define(stage, "/scene/radiance")

    def shader(name: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"/scene/radiance/{name}")
        made.CreateIdAttr(kind)
        return made

    surface = shader("surface", "UsdPreviewSurface")
    for name, value in (("roughness", 1.0), ("metallic", 0.0)):
        surface.CreateInput(name, types.Float).Set(value)
    surface.CreateInput("diffuseColor", types.Color3f).Set((0.0, 0.0, 0.0))
    if textured:
        place = shader("place", "UsdPrimvarReader_float2")
        place.CreateInput("varname", types.String).Set("st")
        colour, output = shader("picture", "UsdUVTexture"), "rgb"
        colour.CreateInput("file", types.Asset).Set("mesh.png")
        colour.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
        for axis in ("wrapS", "wrapT"):
            colour.CreateInput(axis, types.Token).Set("clamp")
        colour.CreateInput("st", types.Float2).ConnectToSource(place.CreateOutput("result", types.Float2))
    else:
        colour, output = shader("colours", "UsdPrimvarReader_float3"), "result"
        colour.CreateInput("varname", types.String).Set("displayColor")
    surface.CreateInput("emissiveColor", types.Color3f).ConnectToSource(colour.CreateOutput(output, types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _packed(files: dict[str, bytes]) -> bytes:
    """A ZIP archive without compression, whose contents begin at multiples of ALIGNMENT (USDZ specification 1.3)."""
    package = BytesIO()
    with zipfile.ZipFile(package, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))  # usd-core's packages hold the time
            begins = package.tell() + LOCAL_HEADER + len(name) + EXTRA_HEADER
            padding = -begins % ALIGNMENT
            entry.extra = b"\x86\x19" + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(entry, content)
    return package.getvalue()
