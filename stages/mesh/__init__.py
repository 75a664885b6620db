"""Stage mesh: the field's density becomes a coloured triangle mesh.

density lattice over the region of interest → marching cubes at the density where the photos' rays stop → only
what the photos cover, see and locate → decimation → colours from the field, seen as the photos saw it → PLY, OBJ, GLB.
A surface that leaves the region of interest ends there, open: closing it would invent geometry.
"""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from pydantic import Field

from stages.contract import Inputs, Progress, StageConfig, StageResult
from stages.io.files import read_json, read_scene, read_tensors, write_png
from stages.mesh.size import (
    affordable_resolution,
    flatness,
    lattice_box,
    point_cost,
    points_along,
    resolution_in,
    seconds_per_density,
    yardstick,
)

if TYPE_CHECKING:
    import numpy as np

    from nerf.fields.density_grid import Lattice
    from nerf.fields.interface import RadianceModel
    from nerf.geometry.scene import Scene
    from stages.mesh.cleaning import Cleaned
    from stages.mesh.files import ColouredMesh
    from stages.mesh.iso_level import Level
    from stages.mesh.visibility import ShadowMap

INPUTS = ("ingest", "normalise", "train")
VERSION = 11
RESUMES = False
PUBLISHED = ("mesh.glb", "mesh.ply", "mesh.obj")
NOT_HASHED = ("seconds",)  # it decides the resolution, and that enters the key

CHUNK = 1 << 16
LEVEL_RAYS = 1024
COLOUR_SAMPLES = 8  # through the two lattice cells about a vertex
BYTES_PER_POINT = 20  # density, occupancy, its averages and marching cubes; 16 measured at 208³

Format = Literal["glb", "ply", "obj"]
Keep = Literal["visible", "largest", "all"]


class Config(StageConfig):
    """Settings of stage mesh."""

    resolution: int | None = Field(
        default=None,
        ge=16,
        le=1024,
        description="lattice points per edge of a cube, as many in all in a flat box; none: from the training",
    )
    seconds: float | None = Field(
        default=None, gt=0, description="that the stage may take; none: about a tenth of the training"
    )
    level: float | None = Field(
        default=None, gt=0, description="density of the surface; none: where the photos' rays stop"
    )
    keep: Keep = Field(default="visible", description="which parts of the raw surface")
    min_views: int = Field(default=2, ge=1, description="photos that must look at a part for it to be visible")
    min_component: float = Field(
        default=0.01, ge=0, le=1, description="smallest component kept, in areas of the largest"
    )
    max_faces: int = Field(default=300_000, ge=100, description="faces left by decimation")
    formats: tuple[Format, ...] = Field(default=("glb", "ply"), min_length=1, description="files to write")
    frame: Literal["sfm", "scene"] = Field(default="sfm", description="frame of the coordinates in the files")


class Extracted(NamedTuple):
    """What the compute part hands over; ``mesh`` is in the scene frame."""

    mesh: "ColouredMesh"
    level: "Level"
    cleaned: "Cleaned"
    ends: str
    voxel: float


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """Choose the resolution: from how much was trained, or by the time there is and what things take here."""
    if config.resolution is not None:
        return config
    if config.seconds is not None:
        progress.update("trying how fast the field tells its density")
        began = time.perf_counter()
        box = lattice_box(read_scene(inputs["normalise"]).layout, _sparse_points(inputs["normalise"]))
        speeds = seconds_per_density(inputs["train"], box, CHUNK), yardstick()
        resolution = resolution_in(config.seconds - (time.perf_counter() - began), *speeds, flatness(box))
        return config.model_copy(update={"resolution": resolution})
    rays = read_json(inputs["train"] / "field.json")["rays"]
    return config.model_copy(update={"resolution": affordable_resolution(rays)})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Extract the mesh and write it in every format asked for, with a picture of it."""
    from stages.effects.decisions import neutral_in_words
    from stages.hardware.device import compute_device
    from stages.io.field_files import load_field

    scene = read_scene(inputs["normalise"])
    device = compute_device()
    model, info = load_field(inputs["train"], device, progress)
    config = plan(config, inputs, progress)
    points = _sparse_points(inputs["normalise"])
    result = reconstruct(config, model, scene, inputs["ingest"], points, device, progress)
    progress.update("writing", 0.95)
    outputs = write_mesh(config, result.mesh, scene, folder)
    faces, parts = len(result.mesh.faces), result.cleaned.kept
    count = f"{faces / 1000:.0f} k faces" if faces >= 10_000 else f"{faces} faces"
    line = f"{count}, {parts} component{'s' * (parts > 1)}, {result.ends}"
    if not result.level.clear:
        line += "; the field has no clear surface yet, train for longer"
    exposure = neutral_in_words(info)
    line += "" if exposure is None else f" · {exposure}"
    facts = _facts(config, result, scene) | ({} if exposure is None else {"exposure": exposure})
    return StageResult(outputs, line, facts=facts)


def _sparse_points(normalise: Path) -> "np.ndarray":
    """(n, 3) in the scene frame."""
    return read_tensors(normalise / "points.safetensors")["xyz"].astype(float)


def reconstruct(
    config: Config,
    model: "RadianceModel",
    scene: "Scene",
    ingest: Path,
    points: "np.ndarray",
    device: str,
    progress: Progress,
) -> Extracted:
    """The mesh of ``model`` in the scene frame, where sparse ``points`` (n, 3) are, too; ``config.resolution`` must be
    set. Masks lie in the folder of stage ``ingest``. Raises StageError without a surface."""
    from scipy.spatial import KDTree

    from stages.mesh.cleaning import clean, openness
    from stages.mesh.files import ColouredMesh
    from stages.mesh.surface import decimate, extract, vertex_normals
    from stages.mesh.visibility import look, shadow_maps

    box = lattice_box(scene.layout, points)
    lattice = _density(config, model, box, device, progress)
    voxel = float(lattice.spacing().max())
    views = scene.of_split("train")
    maps = shadow_maps(lattice, scene, ingest, views, lambda done: progress.update("visibility", 0.6 + 0.2 * done))
    level = _level(config, lattice, model, maps, progress)
    progress.update("marching cubes", 0.8)
    raw = extract(lattice, level.level)
    sight = look(raw.vertices, vertex_normals(raw), maps, voxel)
    progress.update("cleaning", 0.85)
    cleaned = clean(raw, sight, points, config.keep, min(config.min_views, len(views)), config.min_component)
    surface = decimate(cleaned.surface, config.max_faces)
    progress.update("colours", 0.9)
    nearest = KDTree(cleaned.surface.vertices).query(surface.vertices)[1]
    directions = sight.direction[cleaned.vertex[nearest]]
    colours = _colours(model, cleaned.surface.vertices[nearest], directions, voxel, device)
    mesh = ColouredMesh(*surface, vertex_normals(surface), colours)
    return Extracted(mesh, level, cleaned, openness(surface, box, voxel), voxel)


def _density(config: Config, model: "RadianceModel", box: "np.ndarray", device: str, progress: Progress) -> "Lattice":
    import torch

    from nerf.fields.density_grid import density_lattice
    from stages.hardware.memory import available_bytes, check_memory

    assert config.resolution is not None
    needed = BYTES_PER_POINT * point_cost(flatness(box))
    fits = int((available_bytes() / needed) ** (1 / 3)) // 16 * 16
    hint = f"Try --mesh.resolution {fits}." if fits >= 16 else "Close other programs."
    check_memory(needed * config.resolution**3, "the mesh", f"a lattice of {config.resolution}³ points needs", hint)
    low, high = torch.tensor(box, dtype=torch.float32, device=device)

    def report(done: float) -> None:
        progress.update(f"density at {config.resolution}³ points", 0.6 * done)

    return density_lattice(model, points_along(box, config.resolution), low, high, CHUNK, report)


def _level(
    config: Config, lattice: "Lattice", model: "RadianceModel", maps: "list[ShadowMap]", progress: Progress
) -> "Level":
    """The level asked for, or the one chosen from some of the maps' rays."""
    from stages.mesh.iso_level import Level, check_range, choose_level
    from stages.mesh.visibility import drawn_rays

    check_range(lattice, config.level)
    if config.level is not None:
        return Level(config.level, "as asked", None, True)
    level = choose_level(lattice, model, drawn_rays(maps, LEVEL_RAYS))
    progress.note(f"surface at density {level.level:.3g}: {level.reason}")
    return level


def _colours(
    model: "RadianceModel", vertices: "np.ndarray", directions: "np.ndarray", voxel: float, device: str
) -> "np.ndarray":
    """sRGB bytes (n, 3) of what is seen along ``directions`` (n, 3) from a lattice cell before each vertex of the raw
    surface to one behind it.

    A field's colour means something where the field is dense, and a vertex is as far from there as the lattice is
    coarse. Only the light that is stopped there counts; where nothing stops any, the last sample does.
    """
    import torch

    from nerf.rendering.volume_rendering import composite

    t = torch.linspace(-voxel, voxel, COLOUR_SAMPLES + 1, device=device)
    colours = []
    for start in range(0, len(vertices), CHUNK // COLOUR_SAMPLES):
        some = slice(start, start + CHUNK // COLOUR_SAMPLES)
        points, views = (torch.tensor(a[some], dtype=torch.float32, device=device) for a in (vertices, directions))
        along = points[:, None] + t[:-1, None] * views[:, None]
        with torch.no_grad():
            density, each = model.density_and_colour(along, views[:, None].expand_as(along))
            seen, _ = composite(density, each, t.expand(len(points), -1), torch.zeros(1, 3, device=device))
        something = seen.opacity[:, None] > 0
        colours.append(torch.where(something, seen.colour / seen.opacity[:, None], each[:, -1]))
    return (torch.cat(colours).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def write_mesh(config: Config, mesh: "ColouredMesh", scene: "Scene", folder: Path) -> tuple[str, ...]:
    """Write the files asked for, in the frame asked for, and preview.png; their names."""
    from stages.mesh.files import Z_UP_TO_Y_UP, write_glb, write_obj, write_ply
    from stages.mesh.picture import picture

    write_png(folder / "preview.png", picture(mesh, scene))
    upright = Z_UP_TO_Y_UP
    if config.frame == "sfm":
        to_sfm = scene.scene_from_sfm.inverse()
        mesh = mesh._replace(vertices=to_sfm.points(mesh.vertices), normals=mesh.normals @ to_sfm.rotation.T)
        upright = upright @ scene.scene_from_sfm.rotation
    formats = sorted(set(config.formats))
    for kind in formats:
        path = folder / f"mesh.{kind}"
        if kind == "glb":
            write_glb(path, mesh, upright)
        elif kind == "ply":
            write_ply(path, mesh)
        else:
            write_obj(path, mesh)
    return (*(f"mesh.{kind}" for kind in formats), "preview.png")


def _facts(config: Config, result: Extracted, scene: "Scene") -> dict[str, object]:
    """Plain values for the report; lengths are in the frame of the files."""
    from stages.mesh.surface import Surface, face_areas

    unit = 1 / scene.scene_from_sfm.scale if config.frame == "sfm" else 1.0
    mesh = result.mesh
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": result.ends == "watertight",
        "ends": result.ends,
        "components_kept": result.cleaned.kept,
        "components_dropped": result.cleaned.dropped,
        "faces_uncovered": result.cleaned.uncovered,
        "faces_hidden": result.cleaned.hidden,
        "level": result.level.level,
        "level_reason": result.level.reason,
        "level_miss_voxels": result.level.miss_voxels,
        "resolution": config.resolution,
        "voxel": result.voxel * unit,
        "surface_area": float(face_areas(Surface(mesh.vertices, mesh.faces)).sum()) * unit**2,
        "frame": config.frame,
    }
