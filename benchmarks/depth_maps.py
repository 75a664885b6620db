"""What depth maps cost and how much they know: coverage, agreement with the sparse points, CPU seconds.

    pipeline run PHOTOS --until normalise
    python -m benchmarks.depth_maps PHOTOS.nerf … [--sides 320 500 640]

A row for each workspace and each length of the depth maps' longer side. Seconds are of a core. Those of a pair hold all
of matching (decoding photos, resampling, disparities, what neighbours agree on), without the fusion of points.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import Record, add_out
from nerf.runtime.parallel import take_over_cores
from pipeline.engine.workspace import Workspace
from stages.contract import Inputs, SilentProgress
from stages.depth import Config
from stages.depth.estimation import depth_maps, match_pairs
from stages.depth.files import FOLDER
from stages.depth.photos import one_thread_each, read_training_photos
from stages.depth.point_cloud import fuse
from stages.io.files import read_scene


def figures(inputs: Inputs, side: int) -> dict[str, Any]:
    """One row of the table."""
    camera = read_scene(inputs["normalise"]).cameras[0]
    photos = read_training_photos(inputs, max(1.0, max(camera.width, camera.height) / side))
    progress = SilentProgress()
    with tempfile.TemporaryDirectory() as name, one_thread_each():
        folder = Path(name)
        started = time.process_time()
        pairs, left_out = photos.pairs(Config().neighbours)
        match_pairs(photos, pairs, folder, progress)
        matched = time.process_time()
        read = depth_maps(photos, folder)
        maps = [read(number) for number in range(len(photos.views))]
        cloud = fuse(photos, read, sum(int(np.count_nonzero(m.distance)) for m in maps), lambda share: None)
        fused = time.process_time()
        packed = sum(path.stat().st_size for path in (folder / FOLDER).iterdir())
    off = np.concatenate([photos.sparse_depths(number).disagreement(depth) for number, depth in enumerate(maps)])
    off = off[np.isfinite(off)]
    width, height = photos.viewpoints[0].size
    return {
        "size": f"{width} × {height}",
        "photos": len(maps),
        "pairs": len(pairs),
        "left_out": len(left_out),
        "disparities": int(np.median([pair.disparities for pair in pairs.values()])),
        "pair_seconds": round((matched - started) / len(pairs), 3),
        "fusion_seconds": round((fused - matched) / len(maps), 3),
        "covered_percent": round(100 * float(np.mean([depth.coverage for depth in maps])), 1),
        "off_sparse_percent": round(100 * float(np.median(off)), 3),
        "over_3_percent": round(100 * float(np.mean(off > 0.03)), 2),
        "sigma_percent": round(
            100 * float(np.median([np.median(m.sigma[m.sigma > 0]) for m in maps if m.coverage])), 3
        ),
        "points": len(cloud.points),
        "bytes_per_pixel": round(packed / (len(maps) * width * height), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--sides", type=int, nargs="+", default=[500])
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    take_over_cores()
    for root in given.workspaces:
        workspace = Workspace(root)
        keys = workspace.read_run().keys
        inputs = {stage: workspace.folder(stage, keys[stage]) for stage in ("ingest", "normalise")}
        for side in given.sides:
            record.add(set=root.stem, **figures(inputs, side))


if __name__ == "__main__":
    main()
