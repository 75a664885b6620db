"""From a trained field to a mesh: density grid, iso-level, marching cubes, cleaning, decimation, refinement, texture,
files."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from nerf.fields.density_grid import DensityGrid, sample_density_grid
from nerf.fields.interface import RadianceModel
from nerf.geometry.scene import Scene, Similarity
from nerf.geometry.space_maps import SpaceMap, space_map
from nerf.rendering.volume_rendering import composite
from stages.contract import Inputs, Progress, StageError, StageResult
from stages.effects.image_effects import learnt_poses, new_view_words
from stages.hardware.device import compute_device
from stages.hardware.memory import available_bytes, check_memory
from stages.io.amounts import counted
from stages.io.field_files import load_field
from stages.io.files import SMALL_COPY, read_scene, read_tensors, write_png, write_tensors
from stages.mesh.cleaning import Cleaned, boundary, clean, cut_unseen
from stages.mesh.face_count import default_faces
from stages.mesh.files import WRITERS, Z_UP_TO_Y_UP, ColouredMesh
from stages.mesh.grid_space import (
    DensityIn,
    GridSpace,
    VoxelSize,
    box_in,
    grid_space,
    in_scene,
    points_of_grid,
    to_scene,
)
from stages.mesh.iso_level import DIVERGED_HINT, IsoLevel, check_range, choose_iso_level
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.photos.best_photos import BestPhotos, find_best_photos
from stages.mesh.photos.refinement import Refined, refine
from stages.mesh.preview import preview, small_copy
from stages.mesh.resolution import CHUNK, grid_box, point_cost, slab_factor
from stages.mesh.surface import Surface, components, face_areas, is_watertight, keep_faces, vertex_normals
from stages.mesh.surface.decimation import decimate
from stages.mesh.surface.holes import Closed, close_holes
from stages.mesh.surface.smoothing import smoothed
from stages.mesh.texture.texturing import Textured, texture_of
from stages.mesh.visibility import ShadowMap, sample_rays, seen_share, shadow_maps, vertex_visibility
from stages.scale import metres_per_unit

if TYPE_CHECKING:
    from stages.mesh import Config

ISO_LEVEL_RAYS = 1024
COLOUR_SAMPLES = 8  # through the two voxels around a vertex
PRINTED = ("stl", "3mf")  # read in millimetres by the programs that print
BYTES_PER_POINT = 20  # density, occupancy, its averages and marching cubes; 16 measured at 208³


class Source(NamedTuple):
    """What a mesh is made from: the field, its ``info`` (field.json) and ``space``, the scene, sparse ``points`` (n, 3)
    in the scene frame, the folder of stage ``ingest`` with the masks, and metres a unit of the sfm frame where they are
    known."""

    model: RadianceModel
    info: dict[str, Any]
    space: SpaceMap
    scene: Scene
    points: np.ndarray
    ingest: Path
    device: str
    metres_per_unit: float | None

    def files_from_scene(self, frame: str | None) -> Similarity:
        """The similarity from the scene frame to the frame of the files."""
        if frame == "scene":
            return Similarity(1.0, np.eye(3), np.zeros(3))
        sfm = self.scene.scene_from_sfm.inverse()
        if frame == "sfm":
            return sfm
        assert frame == "metric" and self.metres_per_unit, "plan() sets the frame"
        metres = self.metres_per_unit
        return Similarity(metres * sfm.scale, sfm.rotation, metres * sfm.translation)


class Extracted(NamedTuple):
    """``mesh`` in the scene frame with the number of its ``components``, how it came about, how many faces its
    ``fringes`` had (:func:`stages.mesh.cleaning.cut_unseen`), what was ``refined`` and ``closed``, ``boundary``: where
    it ends, and the texture with what is known of it. ``voxel`` is in scene units, the median over the vertices."""

    mesh: ColouredMesh
    components: int
    iso_level: IsoLevel
    cleaned: Cleaned
    fringes: int
    refined: Refined | None
    closed: Closed
    boundary: str
    voxel: float
    textured: Textured | None


def load(inputs: Inputs, progress: Progress) -> Source:
    """Read the field, the scene with the poses that the field learnt, and the sparse points."""
    device = compute_device()
    model, info = load_field(inputs["train"], device, progress)
    points = read_tensors(inputs["normalise"] / "points.safetensors")["xyz"].astype(float)
    scene = learnt_poses(info, read_scene(inputs["normalise"]))
    space = space_map(**info["settings"]["space"])
    return Source(model, info, space, scene, points, inputs["ingest"], device, metres_per_unit(inputs["scale"]))


def extract_mesh(config: "Config", source: Source, progress: Progress) -> Extracted:
    """The mesh of the field; ``config`` must be planned. Raises StageError without a surface."""
    space = grid_space(source.space)
    field = DensityIn(space, source.model)
    region = grid_box(source.scene.capture_type, source.points)
    extent = region, box_in(space, region)
    grid = _density_grid(config, field, extent, source, progress)
    voxel_size = VoxelSize(space, grid.spacing().cpu().numpy())
    views = source.scene.of_split("train")
    maps = shadow_maps(
        grid, space, source.scene, source.ingest, views, lambda done: progress.update("visibility", 0.4 + 0.1 * done)
    )
    iso_level = _iso_level(config, grid, field, maps, progress)
    progress.update("marching cubes", 0.5)
    raw = in_scene(_raw_surface(config, grid, iso_level, space, maps), space, region)
    visibility = vertex_visibility(raw.vertices, vertex_normals(raw), maps, voxel_size.at(raw.vertices).along)
    progress.update("cleaning", 0.55)
    min_views = min(config.min_views, len(views))
    cleaned = clean(
        raw, visibility, source.points, config.keep, min_views, config.min_component, source.scene.has_alpha
    )
    cropped = _cropped(config, cleaned.surface, source, progress)
    decimated = _decimated(config, cropped, source.space)
    seen, best_photos = _seen_part(config, decimated, source, voxel_size, progress)
    ends = boundary(seen, extent, voxel_size, cropped=len(cropped.faces) < len(cleaned.surface.faces))
    surface, refined = _refined(config, seen, best_photos, voxel_size, progress)
    surface = smoothed(surface) if config.smooth else surface
    if config.close:
        surface, closed = close_holes(surface, config.close)
        ends = "watertight" if is_watertight(surface) else ends
        if config.texture_size > 0:  # of the new vertices, too
            best_photos = _best_photos(surface, source, voxel_size, progress, 0.65)
    else:
        closed = Closed(0, 0, 0.0)
    if config.max_faces is not None and len(surface.faces) > config.max_faces:
        progress.note(
            "mesh.more-faces",
            f"{len(surface.faces)} faces are left, more than --mesh.max-faces {config.max_faces}: decimation leaves "
            "open borders as they are, and closing holes adds faces",
        )
    progress.update("colours", 0.7)
    nearest = KDTree(cleaned.surface.vertices).query(surface.vertices)[1]
    directions, of_raw = visibility.direction[cleaned.vertex[nearest]], cleaned.surface.vertices[nearest]
    colours = vertex_colours(source.model, of_raw, directions, voxel_size.at(of_raw).along, source.device)
    textured = _textured(config, surface, colours, best_photos, progress)
    mesh = ColouredMesh(*surface, vertex_normals(surface), colours, textured and textured.texture)
    voxel = float(np.median(voxel_size.at(surface.vertices).along))
    parts = int(components(surface).max()) + 1
    fringes = len(decimated.faces) - len(seen.faces)
    return Extracted(mesh, parts, iso_level, cleaned, fringes, refined, closed, ends, voxel, textured)


def _raw_surface(
    config: "Config", grid: DensityGrid, iso_level: IsoLevel, space: GridSpace, maps: list[ShadowMap]
) -> Surface:
    """In the grid's space; of cavities only where everything is asked for."""

    def seen(points: np.ndarray) -> np.ndarray:
        return seen_share(to_scene(points, space), maps)

    return extract_surface(grid, iso_level.density, seen if config.keep == "visible" else None)


def _decimated(config: "Config", surface: Surface, space: SpaceMap) -> Surface:
    """The surface with as many faces as asked for, more where it has many open borders."""
    most = config.max_faces or default_faces(len(surface.faces), config.texture_size > 0)
    decimated = decimate(surface, most, space)
    if not len(decimated.faces):
        raise StageError(
            "mesh.decimated-away",
            f"--mesh.max-faces {most} leaves nothing of the mesh",
            f"it has {int(components(surface).max()) + 1} components, and each takes at least 4 faces",
            "Try more --mesh.max-faces, or --mesh.keep largest.",
        )
    return decimated


def _cropped(config: "Config", surface: Surface, source: Source, progress: Progress) -> Surface:
    """The faces that lie in the box asked for. In which frame is told: once a length is given the files are in metres,
    and so is the box."""
    if config.box is None:
        return surface
    vertices = source.files_from_scene(config.frame).points(surface.vertices)
    low, high = np.array(config.box).reshape(2, 3)
    within = np.all((vertices >= low) & (vertices <= high), axis=1)
    inside = np.all(within[surface.faces], axis=1)
    if not inside.any():
        ends = [", ".join(f"{x:.4g}" for x in end) for end in (vertices.min(axis=0), vertices.max(axis=0))]
        why = f"in the {config.frame} frame the mesh reaches from {ends[0]} to {ends[1]}"
        raise StageError(
            "mesh.nothing-in-box", "no face of the mesh lies in --mesh.box", why, "Give a box within that."
        )
    unit = "metres" if config.frame == "metric" else f"units of the {config.frame} frame"
    progress.note("mesh.cropped", f"{inside.mean():.0%} of the faces lie in --mesh.box, which is in {unit}")
    return keep_faces(surface, inside)[0]


def _best_photos(
    surface: Surface, source: Source, voxel_size: VoxelSize, progress: Progress, begin: float
) -> BestPhotos:
    """The photos that see the vertices; ``begin``: how far the stage is."""

    def report(done: float) -> None:
        progress.update("which photos see the surface", begin + 0.05 * done)

    voxels = voxel_size.at(surface.vertices)
    return find_best_photos(surface, source.scene, source.ingest, source.info, voxels, report)


def _seen_part(
    config: "Config", surface: Surface, source: Source, voxel_size: VoxelSize, progress: Progress
) -> tuple[Surface, BestPhotos | None]:
    """The surface without fringes, where only what is visible is asked for, and the photos that see it: None where
    nothing needs them."""
    if config.keep != "visible" and not config.refine and config.texture_size == 0:
        return surface, None
    best_photos = _best_photos(surface, source, voxel_size, progress, 0.55)
    if config.keep != "visible":
        return surface, best_photos
    seen, vertex = cut_unseen(surface, best_photos.seen(), config.min_component)
    return seen, best_photos.of_part(seen, vertex)


def _refined(
    config: "Config", surface: Surface, best_photos: BestPhotos | None, voxel_size: VoxelSize, progress: Progress
) -> tuple[Surface, Refined | None]:
    """The surface moved to where the photos agree, if asked for, and what that gained."""
    if not config.refine or best_photos is None:
        return surface, None

    def report(done: float) -> None:
        progress.update("refining the surface", 0.6 + 0.05 * done)

    refined = refine(surface, best_photos, voxel_size.at(surface.vertices), report)
    if refined is None:
        progress.note("mesh.not-refined", "hardly any of the surface is visible in two photos: it is not refined")
        return surface, None
    if not refined.kept:
        progress.note("mesh.no-better-refined", "the photos agree no better on the refined surface: it stays as it was")
    return refined.surface, refined


def _textured(
    config: "Config", surface: Surface, colours: np.ndarray, best_photos: BestPhotos | None, progress: Progress
) -> Textured | None:
    """The texture asked for; None for one colour per vertex."""
    if config.texture_size == 0 or best_photos is None:
        return None

    def report(what: str, done: float) -> None:
        progress.update(what, 0.7 + 0.25 * done)

    textured = texture_of(surface, colours, best_photos, config.texture_size, report)
    if textured is None:
        progress.note("mesh.no-photo-sees-it", "no photo sees the surface: it has colours of the field and no texture")
    return textured


def _density_grid(
    config: "Config", field: DensityIn, extent: tuple[np.ndarray, np.ndarray], source: Source, progress: Progress
) -> DensityGrid:
    """Over the region of the scene and the grid's box in its space that are its ``extent``."""
    assert config.resolution is not None
    region, box = extent
    bytes_per_point = BYTES_PER_POINT * point_cost(slab_factor(region))
    fits = int((available_bytes() / bytes_per_point) ** (1 / 3)) // 16 * 16
    hint = f"Try --mesh.resolution {fits}." if fits >= 16 else "Close other programs."
    needed = bytes_per_point * config.resolution**3
    check_memory(needed, "the mesh", f"a density grid of {config.resolution}³ points needs", hint)
    low, high = torch.tensor(box, dtype=torch.float32, device=source.device)
    counts = points_of_grid(field.space, box, config.resolution, source.points)

    def report(done: float) -> None:
        progress.update(f"density at {config.resolution}³ points", 0.4 * done)

    return sample_density_grid(field, counts, low, high, CHUNK, report)


def _iso_level(
    config: "Config", grid: DensityGrid, field: DensityIn, maps: list[ShadowMap], progress: Progress
) -> IsoLevel:
    """The one asked for, or the one chosen from some of the maps' rays."""
    check_range(grid, config.iso_level)
    if config.iso_level is not None:
        return IsoLevel(config.iso_level, "given", None, True)
    rays = field.space.map_rays(sample_rays(maps, ISO_LEVEL_RAYS)).rays
    chosen = choose_iso_level(grid, field, rays)
    progress.note("mesh.iso-level", f"surface at density {chosen.density:.3g}: {chosen.reason}")
    return chosen


def vertex_colours(
    model: RadianceModel, vertices: np.ndarray, directions: np.ndarray, voxels: np.ndarray, device: str
) -> np.ndarray:
    """sRGB bytes (n, 3): what rays along ``directions`` (n, 3) see from one voxel before each vertex of the raw surface
    to one behind it; ``voxels`` (n,): how long these are.

    A field's colour means something only where the field is dense, and a vertex of a coarse grid may lie beside that.
    Colours are divided by the opacity; where the ray meets nothing, the last sample counts. Raises StageError where
    one is not finite.
    """
    places = torch.linspace(-1, 1, COLOUR_SAMPLES + 1, device=device)
    colours = []
    for start in range(0, len(vertices), CHUNK // COLOUR_SAMPLES):
        some = slice(start, start + CHUNK // COLOUR_SAMPLES)
        points, views, length = (
            torch.tensor(a[some], dtype=torch.float32, device=device) for a in (vertices, directions, voxels)
        )
        t = length[:, None] * places
        samples = points[:, None] + t[:, :-1, None] * views[:, None]
        with torch.no_grad():
            density, colour = model.density_and_colour(samples, views[:, None].expand_as(samples))
            pixel, _ = composite(density, colour, t, torch.zeros(1, 3, device=device))
        opaque = pixel.opacity[:, None] > 0
        colours.append(torch.where(opaque, pixel.colour / pixel.opacity[:, None], colour[:, -1]))
    found = torch.cat(colours)
    if broken := int((~found.isfinite()).any(dim=1).sum()):
        why = f"those of {broken} of {len(found)} vertices are NaN or infinite"
        raise StageError("mesh.colours-not-finite", "the field's colours are not finite", why, DIVERGED_HINT)
    return (found.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def save(config: "Config", extracted: Extracted, source: Source, folder: Path) -> StageResult:
    """Write the files; the summary line and the facts for the report."""
    outputs = write_mesh(config, extracted.mesh, source, folder)
    faces = len(extracted.mesh.faces)
    count = f"{faces / 1000:.0f} k faces" if faces >= 10_000 else f"{faces} faces"
    if (texture := extracted.mesh.texture) is not None:
        count += f", texture {texture.atlas.width} × {texture.atlas.height}"
    line = f"{count}, {counted(extracted.components, 'component')}, {extracted.boundary}"
    if extracted.closed.holes:
        line += f", {extracted.closed.area_share:.1%} of the area invented"
    if not extracted.iso_level.well_defined:
        line += "; the field has no clear surface yet, train for longer"
    appearance = new_view_words(source.info)
    line += "" if appearance is None else f" · {appearance}"
    facts = _facts(config, extracted, source) | ({} if appearance is None else {"appearance": appearance})
    return StageResult(outputs, line, facts=facts)


def write_mesh(config: "Config", mesh: ColouredMesh, source: Source, folder: Path) -> tuple[str, ...]:
    """Write the files asked for, in the frame asked for; preview.png and the small copy in the scene frame; their
    names."""
    write_png(folder / "preview.png", preview(mesh, source.scene))
    names = ["preview.png"]
    if (small := small_copy(mesh, source.space)) is not None:
        write_tensors(folder / SMALL_COPY, small)
        names.append(SMALL_COPY)
    files_from_scene = source.files_from_scene(config.frame)
    vertices, normals = files_from_scene.points(mesh.vertices), mesh.normals @ files_from_scene.rotation.T
    mesh, upright = mesh._replace(vertices=vertices, normals=normals), Z_UP_TO_Y_UP @ files_from_scene.rotation.T
    in_millimetres = mesh._replace(vertices=1000 * mesh.vertices) if config.frame == "metric" else mesh
    for extension in sorted(set(config.formats)):
        shown = in_millimetres if extension in PRINTED else mesh
        for name, content in WRITERS[extension](shown, upright).items():
            (folder / name).write_bytes(content)
            names.append(name)
    return tuple(names)


def _facts(config: "Config", extracted: Extracted, source: Source) -> dict[str, object]:
    """Plain values for the report; lengths are in the frame of the files."""
    unit = source.files_from_scene(config.frame).scale
    mesh, cleaned, iso_level = extracted.mesh, extracted.cleaned, extracted.iso_level
    return (
        _texture_facts(extracted.textured)
        | _refinement_facts(extracted.refined)
        | {
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "watertight": extracted.boundary == "watertight",
            "boundary": extracted.boundary,
            "components_kept": extracted.components,
            "components_dropped": cleaned.dropped,
            "faces_outside_photos": cleaned.outside,
            "faces_hidden": cleaned.hidden,
            "faces_in_fringes": extracted.fringes,
            "holes_closed": extracted.closed.holes,
            "holes_left": extracted.closed.left,
            "invented_area_share": extracted.closed.area_share,
            "iso_level": iso_level.density,
            "iso_level_reason": iso_level.reason,
            "surface_error_voxels": iso_level.surface_error_voxels,
            "resolution": config.resolution,
            "voxel": extracted.voxel * unit,
            "grid_space": grid_space(source.space).kind,
            "surface_area": float(face_areas(Surface(mesh.vertices, mesh.faces)).sum()) * unit**2,
            "frame": config.frame,
        }
    )


def _refinement_facts(refined: Refined | None) -> dict[str, object]:
    if refined is None:
        return {"refined_voxels": None}
    return {
        "refined_voxels": round(refined.shift, 3),
        "photo_agreement_before": round(refined.before, 3),
        "photo_agreement": round(refined.after, 3),
    }


def _texture_facts(textured: Textured | None) -> dict[str, object]:
    if textured is None:
        return {"texture": None}
    atlas = textured.texture.atlas
    return {
        "texture": f"{atlas.width} × {atlas.height}",
        "texels_per_pixel": round(atlas.texels_per_pixel, 3),
        "texture_without_photo": round(textured.unseen, 4),
        "texture_outliers": round(textured.outliers, 4),
    }
