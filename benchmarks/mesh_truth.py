"""How far meshes are from true surfaces: photos with exact cameras, a field and a mesh of each.

    python -m benchmarks.mesh_truth FOLDER [--scenes demo spot_ground …] [--width 800] [--steps 1500]

Photos are drawn into FOLDER and a field is trained for each scene, once (benchmarks/mesh_scenes.py). Printed, and
written as JSON with ``--out``, in percent of the scene's size: mean distance from the mesh to the true surface and from
what at least two photos show of the true surface to the mesh, and their mean (chamfer). F-score: harmonic mean of the
shares of both that are within 0.5 %. Normals: mean angle. Flatness: deviation of flat parts from planes fitted
to them. To break it: --shift moves each mesh by so many percent, --iso-factor multiplies the iso-level.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.mesh_scenes import SCENES, Plane, Points, SyntheticPhotos, scene_of, write_photos
from benchmarks.record import Record, add_out
from pipeline.cli.commands import run_command
from pipeline.engine.workspace import Workspace
from stages import mesh
from stages.contract import Inputs, SilentProgress, plan_stage
from stages.mesh import Config
from stages.mesh.extraction import Source, extract_mesh, load
from stages.mesh.surface import Surface, face_area_vectors, sampled_faces

MESH_SAMPLES = 100_000
F_TOLERANCE = 0.5  # percent of the size
ON_PLANE = 1e-3  # world units
MAX_OFF_PLANE = 2.0  # percent of the size; beyond, a flat part is missing and not uneven


def samples_of(surface: Surface) -> Points:
    """Points and normals, uniform by area."""
    points, face = sampled_faces(surface.vertices, surface.faces, MESH_SAMPLES, seed=0)
    normal = face_area_vectors(surface.vertices, surface.faces)[face]
    return Points(points, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))


def distances(points: np.ndarray, surface: Points) -> tuple[np.ndarray, np.ndarray]:
    """From points to a sampled surface, and the number of the nearest sample.

    To the tangent plane there, as far as samples are apart: a perfect surface is at zero.
    """
    tree = KDTree(surface.position)
    apart = 3 * np.median(tree.query(surface.position[::100], 2)[0][:, 1])
    distance, nearest = tree.query(points)
    across = ((points - surface.position[nearest]) * surface.normal[nearest]).sum(axis=1)
    along = np.sqrt(np.maximum(distance**2 - across**2, 0))
    return np.hypot(across, np.maximum(along - apart, 0)), np.asarray(nearest)


def compared(surface: Surface, scene: SyntheticPhotos) -> dict[str, Any]:
    """A mesh in the world's frame beside the truth."""
    made, percent = samples_of(surface), 100 / scene.size
    made = made.where(scene.asked(made.position))
    to_truth, _ = distances(made.position, scene.surface)
    to_mesh, nearest = distances(scene.visible.position, made)
    precision, recall = ((percent * each < F_TOLERANCE).mean() for each in (to_truth, to_mesh))
    cosine = (scene.visible.normal * made.normal[nearest]).sum(axis=1)
    flat = [flatness(plane, scene.visible, made.position[nearest]) * percent for plane in scene.planes]
    thin = scene.thin(scene.visible.position)
    return {
        "faces": len(surface.faces),
        "to_truth_percent": round(percent * float(to_truth.mean()), 3),
        "to_mesh_percent": round(percent * float(to_mesh.mean()), 3),
        "chamfer_percent": round(percent * float(to_truth.mean() + to_mesh.mean()) / 2, 3),
        "f_score": round(float(2 * precision * recall / max(precision + recall, 1e-9)), 3),
        "normal_deg": round(float(np.degrees(np.arccos(cosine.clip(-1, 1))).mean()), 2),
        "flatness_percent": round(float(np.mean(flat)), 3) if flat else None,
        "thin_percent": round(100 * float((percent * to_mesh[thin] < 2 * F_TOLERANCE).mean()), 1)
        if thin.any()
        else None,
    }


def flatness(plane: Plane, visible: Points, nearest: np.ndarray) -> float:
    """Deviation of the mesh's points nearest to a flat part from the plane fitted to them: 1.48 times the median
    one, so that what stands there does not count."""
    offset = visible.position - plane.point
    on = (np.abs(offset @ plane.normal) < ON_PLANE) & (np.abs(offset) <= plane.reach).all(axis=1)
    on &= (visible.normal @ plane.normal) > 0.99
    found = nearest[on] - plane.point
    found = found[np.abs(found @ plane.normal) < MAX_OFF_PLANE / 100 * np.linalg.norm(plane.reach)]
    across = np.linalg.svd(found - found.mean(axis=0), full_matrices=False)[2][2]
    off = (found - found.mean(axis=0)) @ across
    return 1.4826 * float(np.median(np.abs(off - np.median(off))))


def trained(scene: SyntheticPhotos, folder: Path, name: str, steps: int, depth: bool) -> Inputs:
    """The folders of the stages that a mesh reads; what is there already is not made again."""
    photos, workspace = folder / "photos" / name, folder / ("ws-depth" if depth else "ws") / name
    write_photos(scene, photos)
    words = [
        "run",
        str(photos / "transforms.json"),
        "-o",
        str(workspace),
        "--until",
        "train",
        "--train.steps",
        str(steps),
        *(["--train.depth"] if depth else []),
    ]
    if run_command(words) != 0:
        raise SystemExit(f"{name} was not trained")
    return stages_of(workspace)


def stages_of(root: Path) -> Inputs:
    """The finished folders of a workspace."""
    workspace = Workspace.existing(root)
    keys = workspace.read_run().keys
    return {stage: workspace.folder(stage, key) for stage, key in keys.items()}


def in_world(surface: Surface, source: Source, shift: float = 0.0) -> Surface:
    """A surface of the scene frame in the world's: that of the imported cameras."""
    return surface._replace(vertices=source.files_from_scene("sfm").points(surface.vertices) + shift)


def row(scene: SyntheticPhotos, source: Source, config: Config, given: argparse.Namespace) -> dict[str, Any]:
    """The mesh's figures, and the seconds of a core that it took."""
    began = time.process_time()
    if given.iso_factor != 1:
        level = extract_mesh(config.model_copy(update={"keep": "all"}), source, SilentProgress()).iso_level.density
        config = config.model_copy(update={"iso_level": given.iso_factor * level})
    made = extract_mesh(config, source, SilentProgress()).mesh
    seconds = time.process_time() - began
    surface = in_world(Surface(made.vertices, made.faces), source, given.shift * scene.size / 100)
    return compared(surface, scene) | {"cpu_seconds": round(seconds, 1)}


def main() -> None:
    """A row for each scene and surface."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--solids", type=Path, default=Path("../shared/data/solids"))
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--photos", type=int, help="how many (default: 40 of the demo, 60 of a solid, 20 of the room)")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--depth", action="store_true", help="supervise the fields by depth maps")
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--shift", type=float, default=0.0)
    parser.add_argument("--iso-factor", type=float, default=1.0)
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for name in given.scenes:
        scene = scene_of(name, given.solids, given.width, given.photos)
        folders = trained(scene, given.folder, name, given.steps, given.depth)
        source = load(folders, SilentProgress())
        asked = Config(resolution=given.resolution, texture_size=0)
        config = plan_stage(mesh.STAGE, asked, folders, SilentProgress())
        facts = {"set": name, "steps": given.steps, "width": given.width, "resolution": config.resolution}
        record.add(**facts, **row(scene, source, config, given))


if __name__ == "__main__":
    main()
