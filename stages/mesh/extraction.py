"""From a trained field to a mesh: density grid, iso-level, marching cubes, cleaning, decimation, colours, files."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from nerf.fields.density_grid import DensityGrid, sample_density_grid
from nerf.fields.interface import RadianceModel
from nerf.geometry.scene import Scene
from nerf.rendering.volume_rendering import composite
from stages.contract import Inputs, Progress, StageResult
from stages.effects.image_effects import new_view_words
from stages.hardware.device import compute_device
from stages.hardware.memory import available_bytes, check_memory
from stages.io.field_files import load_field
from stages.io.files import read_scene, read_tensors, write_png
from stages.mesh.cleaning import Cleaned, boundary, clean
from stages.mesh.files import WRITERS, Z_UP_TO_Y_UP, ColouredMesh
from stages.mesh.iso_level import IsoLevel, check_range, choose_iso_level
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.preview import preview
from stages.mesh.resolution import CHUNK, grid_box, point_cost, points_per_edge, slab_factor
from stages.mesh.surface import Surface, decimate, face_areas, vertex_normals
from stages.mesh.visibility import ShadowMap, sample_rays, shadow_maps, vertex_visibility

if TYPE_CHECKING:
    from stages.mesh import Config

ISO_LEVEL_RAYS = 1024
COLOUR_SAMPLES = 8  # through the two voxels around a vertex
BYTES_PER_POINT = 20  # density, occupancy, its averages and marching cubes; 16 measured at 208³


class Source(NamedTuple):
    """What a mesh is made from: the field and its ``info`` (field.json), the scene, sparse ``points`` (n, 3) in the
    scene frame, the folder of stage ``ingest`` with the masks."""

    model: RadianceModel
    info: dict[str, Any]
    scene: Scene
    points: np.ndarray
    ingest: Path
    device: str


class Extracted(NamedTuple):
    """``mesh`` in the scene frame, how it came about, and ``boundary``: where it ends. ``voxel`` is in scene units."""

    mesh: ColouredMesh
    iso_level: IsoLevel
    cleaned: Cleaned
    boundary: str
    voxel: float


def load(inputs: Inputs, progress: Progress) -> Source:
    """Read the field, the scene and the sparse points."""
    device = compute_device()
    model, info = load_field(inputs["train"], device, progress)
    points = read_tensors(inputs["normalise"] / "points.safetensors")["xyz"].astype(float)
    return Source(model, info, read_scene(inputs["normalise"]), points, inputs["ingest"], device)


def extract_mesh(config: "Config", source: Source, progress: Progress) -> Extracted:
    """The mesh of the field; ``config.resolution`` must be set. Raises StageError without a surface."""
    box = grid_box(source.scene.capture_type, source.points)
    grid = _density_grid(config, source, box, progress)
    voxel = float(grid.spacing().max())
    views = source.scene.of_split("train")
    maps = shadow_maps(
        grid, source.scene, source.ingest, views, lambda done: progress.update("visibility", 0.6 + 0.2 * done)
    )
    iso_level = _iso_level(config, grid, source.model, maps, progress)
    progress.update("marching cubes", 0.8)
    raw = extract_surface(grid, iso_level.density)
    visibility = vertex_visibility(raw.vertices, vertex_normals(raw), maps, voxel)
    progress.update("cleaning", 0.85)
    min_views = min(config.min_views, len(views))
    cleaned = clean(raw, visibility, source.points, config.keep, min_views, config.min_component)
    surface = decimate(cleaned.surface, config.max_faces)
    progress.update("colours", 0.9)
    nearest = KDTree(cleaned.surface.vertices).query(surface.vertices)[1]
    directions = visibility.direction[cleaned.vertex[nearest]]
    colours = vertex_colours(source.model, cleaned.surface.vertices[nearest], directions, voxel, source.device)
    mesh = ColouredMesh(*surface, vertex_normals(surface), colours)
    return Extracted(mesh, iso_level, cleaned, boundary(surface, box, voxel), voxel)


def _density_grid(config: "Config", source: Source, box: np.ndarray, progress: Progress) -> DensityGrid:
    assert config.resolution is not None
    bytes_per_point = BYTES_PER_POINT * point_cost(slab_factor(box))
    fits = int((available_bytes() / bytes_per_point) ** (1 / 3)) // 16 * 16
    hint = f"Try --mesh.resolution {fits}." if fits >= 16 else "Close other programs."
    needed = bytes_per_point * config.resolution**3
    check_memory(needed, "the mesh", f"a density grid of {config.resolution}³ points needs", hint)
    low, high = torch.tensor(box, dtype=torch.float32, device=source.device)

    def report(done: float) -> None:
        progress.update(f"density at {config.resolution}³ points", 0.6 * done)

    return sample_density_grid(source.model, points_per_edge(box, config.resolution), low, high, CHUNK, report)


def _iso_level(
    config: "Config", grid: DensityGrid, model: RadianceModel, maps: list[ShadowMap], progress: Progress
) -> IsoLevel:
    """The one asked for, or the one chosen from some of the maps' rays."""
    check_range(grid, config.iso_level)
    if config.iso_level is not None:
        return IsoLevel(config.iso_level, "given", None, True)
    chosen = choose_iso_level(grid, model, sample_rays(maps, ISO_LEVEL_RAYS))
    progress.note("mesh.iso-level", f"surface at density {chosen.density:.3g}: {chosen.reason}")
    return chosen


def vertex_colours(
    model: RadianceModel, vertices: np.ndarray, directions: np.ndarray, voxel: float, device: str
) -> np.ndarray:
    """sRGB bytes (n, 3): what rays along ``directions`` (n, 3) see from one voxel before each vertex of the raw surface
    to one behind it.

    A field's colour means something only where the field is dense, and a vertex of a coarse grid may lie beside that.
    Colours are divided by the opacity; where the ray meets nothing, the last sample counts.
    """
    t = torch.linspace(-voxel, voxel, COLOUR_SAMPLES + 1, device=device)
    colours = []
    for start in range(0, len(vertices), CHUNK // COLOUR_SAMPLES):
        some = slice(start, start + CHUNK // COLOUR_SAMPLES)
        points, views = (torch.tensor(a[some], dtype=torch.float32, device=device) for a in (vertices, directions))
        samples = points[:, None] + t[:-1, None] * views[:, None]
        with torch.no_grad():
            density, colour = model.density_and_colour(samples, views[:, None].expand_as(samples))
            pixel, _ = composite(density, colour, t.expand(len(points), -1), torch.zeros(1, 3, device=device))
        opaque = pixel.opacity[:, None] > 0
        colours.append(torch.where(opaque, pixel.colour / pixel.opacity[:, None], colour[:, -1]))
    return (torch.cat(colours).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def save(config: "Config", extracted: Extracted, source: Source, folder: Path) -> StageResult:
    """Write the files; the summary line and the facts for the report."""
    outputs = write_mesh(config, extracted.mesh, source.scene, folder)
    faces, components = len(extracted.mesh.faces), extracted.cleaned.kept
    count = f"{faces / 1000:.0f} k faces" if faces >= 10_000 else f"{faces} faces"
    line = f"{count}, {components} component{'s' * (components > 1)}, {extracted.boundary}"
    if not extracted.iso_level.well_defined:
        line += "; the field has no clear surface yet, train for longer"
    appearance = new_view_words(source.info)
    line += "" if appearance is None else f" · {appearance}"
    facts = _facts(config, extracted, source.scene) | ({} if appearance is None else {"appearance": appearance})
    return StageResult(outputs, line, facts=facts)


def write_mesh(config: "Config", mesh: ColouredMesh, scene: Scene, folder: Path) -> tuple[str, ...]:
    """Write the files asked for, in the frame asked for, and preview.png; their names."""
    write_png(folder / "preview.png", preview(mesh, scene))
    upright = Z_UP_TO_Y_UP
    if config.frame == "sfm":
        sfm_from_scene = scene.scene_from_sfm.inverse()
        vertices, normals = sfm_from_scene.points(mesh.vertices), mesh.normals @ sfm_from_scene.rotation.T
        mesh = mesh._replace(vertices=vertices, normals=normals)
        upright = upright @ scene.scene_from_sfm.rotation
    names = [f"mesh.{extension}" for extension in sorted(set(config.formats))]
    for name in names:
        (folder / name).write_bytes(WRITERS[name.removeprefix("mesh.")](mesh, upright))
    return (*names, "preview.png")


def _facts(config: "Config", extracted: Extracted, scene: Scene) -> dict[str, object]:
    """Plain values for the report; lengths are in the frame of the files."""
    unit = 1 / scene.scene_from_sfm.scale if config.frame == "sfm" else 1.0
    mesh, cleaned, iso_level = extracted.mesh, extracted.cleaned, extracted.iso_level
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": extracted.boundary == "watertight",
        "boundary": extracted.boundary,
        "components_kept": cleaned.kept,
        "components_dropped": cleaned.dropped,
        "faces_outside_photos": cleaned.outside,
        "faces_hidden": cleaned.hidden,
        "iso_level": iso_level.density,
        "iso_level_reason": iso_level.reason,
        "surface_error_voxels": iso_level.surface_error_voxels,
        "resolution": config.resolution,
        "voxel": extracted.voxel * unit,
        "surface_area": float(face_areas(Surface(mesh.vertices, mesh.faces)).sum()) * unit**2,
        "frame": config.frame,
    }
