"""What a mesh costs: seconds and distance to what is known of the surface, against the grid's resolution.

    pipeline run PHOTOS --until train --train.steps 1500
    python -m benchmarks.mesh_cost PHOTOS.nerf
    python -m benchmarks.mesh_cost demo/demo.nerf --truth demo/truth.json

With --truth (of `pipeline demo`'s photos) distances are two-sided, to the exact surface, in percent of the scene's
size. Without, they go from the sparse points within the region of interest to the mesh, in percent of the region's
size: nothing else is known of a real scene's surface, and where there is no texture not even that.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.record import Record, add_out
from nerf import REGION_HALF_SIZE
from pipeline.demo.truth import Truth, compare_with_truth
from pipeline.engine.workspace import Workspace
from stages.contract import Inputs, SilentProgress
from stages.mesh import STAGE, Config
from stages.mesh.extraction import Source, extract_mesh, load, write_mesh
from stages.mesh.files import ColouredMesh
from stages.mesh.surface import sample_surface

SAMPLES = 200_000  # of the mesh


def to_truth(mesh: "ColouredMesh", source: Source, normalise: Path, truth: Truth) -> dict[str, float]:
    """Mesh to truth, and truth to mesh, in percent of the scene's size."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(normalise / "transforms.json", folder)
        write_mesh(Config(formats=("ply",), frame="sfm"), mesh, source, Path(folder))
        error = compare_with_truth(Path(folder), truth).mesh
    assert error is not None, "the mesh has just been written"
    return {"mesh_to_truth_percent": error.accuracy, "truth_to_mesh_percent": error.completeness}


def to_points(mesh: "ColouredMesh", points: np.ndarray) -> dict[str, float]:
    """From the sparse points in the region to the mesh: median, and nine in ten, in percent of the region's size."""
    inside = points[np.abs(points).max(1) < REGION_HALF_SIZE]
    distance = KDTree(sample_surface(mesh.vertices, mesh.faces, SAMPLES, seed=0)).query(inside)[0]
    median, most = np.percentile(distance, [50, 90]) * 100 / (2 * REGION_HALF_SIZE)
    return {"point_to_mesh_percent": median, "nine_in_ten_percent": most}


def figures(folders: Inputs, resolution: int, truth: Truth | None) -> dict[str, Any]:
    """One resolution's row of the table."""
    source = load(folders, SilentProgress())
    started = time.perf_counter()
    made = extract_mesh(Config(resolution=resolution, texture_size=0), source, SilentProgress())
    seconds = time.perf_counter() - started
    if truth is None:
        known = to_points(made.mesh, source.points)
    else:
        known = to_truth(made.mesh, source, folders["normalise"], truth)
    rounded = {name: round(value, 2) for name, value in known.items()}
    return {"resolution": resolution, "faces": len(made.mesh.faces), "seconds": round(seconds, 1), **rounded}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--resolutions", type=int, nargs="+", default=[48, 64, 96, 128, 192, 256])
    parser.add_argument("--truth", type=Path, default=None)
    add_out(parser)
    given = parser.parse_args()
    workspace = Workspace.existing(given.workspace)
    keys = workspace.read_run().keys
    folders = {stage: workspace.folder(stage, keys[stage]) for stage in STAGE.inputs}
    truth = Truth.read(given.truth) if given.truth else None
    record = Record(given.out)
    for resolution in given.resolutions:
        record.add(set=given.workspace.stem, **figures(folders, resolution, truth))


if __name__ == "__main__":
    main()
