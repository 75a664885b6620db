"""What choosing pairs by retrieval saves and loses on a large set, against matching every pair.

    python -m benchmarks.retrieval [--photos 400] [--matchers exhaustive retrieval] [--neighbours 30]
                                   [--max-features 4096] [--folder DIR]

Draws photos of 320 × 240 along both sides of a synthetic street: each shows about a thirtieth of it, so that most pairs
share nothing, and their names are in random order. Then runs stage sfm with each way of choosing pairs, and prints
pairs, seconds of matching, seconds of the whole stage, registered photos, and the largest distance of a camera centre
from the truth, in share of the street's length.

On two cores busy with other work, 400 photos of 1359 features (--max-features 1000): retrieval matched 7923 of 79 800
pairs and registered 400. A sample of 640 pairs each took 15.8 ms of a processor per pair that retrieval chose (more of
them overlap) and 11.0 ms per pair of all: 126 s of a processor together, 1.5 s of it to find the pairs, against 878 s.
"""

import argparse
import math
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.record import Record, add_out
from benchmarks.sfm_speed import Timed
from nerf.geometry.alignment import align
from nerf.geometry.camera_paths import look_at
from nerf.geometry.scene import Camera
from nerf.synthetic import textures
from nerf.synthetic.scenes import Solid, SyntheticScene, photograph
from nerf.synthetic.shapes import Box
from nerf.synthetic.textures import make_noise
from stages import ingest, sfm
from stages.contract import run_stage
from stages.sfm.colmap.cameras import camera_rays
from stages.sfm.colmap.models import read_model

LENS = Camera("SIMPLE_RADIAL", 320, 240, (300.0, 160.0, 120.0, -0.05))
STEP = 0.25  # scene units between photos
AWAY = 2.5  # from the houses
VISIBLE = 4.0  # along the street
TEXTURES = (textures.marble, textures.wrapping, textures.doughnut, textures.peel)


def street(length: float, random: np.random.Generator) -> SyntheticScene:
    """Houses of width 1 along x, none like another: each has its own depth, height, texture and noise."""
    solids = []
    for house in range(-math.ceil(VISIBLE), math.ceil(length + VISIBLE)):
        depth, height = random.uniform(0.3, 0.8), random.uniform(0.6, 1.4)
        pose = torch.tensor([[1.0, 0, 0, house + 0.5], [0, 1, 0, 0], [0, 0, 1, 0]])
        texture = TEXTURES[random.integers(len(TEXTURES))]
        solids.append(Solid(Box((0.5, depth, height)), pose, partial(texture, make_noise(house + 1000))))
    return SyntheticScene(tuple(solids), make_noise(0))


def poses(count: int, random: np.random.Generator) -> np.ndarray:
    """World from camera, (count, 3, 4): along the houses and back again, hand-held."""
    there = (count + 1) // 2
    along = 2 * STEP * np.concatenate([np.arange(there), np.arange(count - there)[::-1] + 0.5])
    height = np.where(np.arange(count) < there, -0.15, 0.25)
    centres = np.stack([along, np.full(count, -AWAY), height], axis=1) + random.uniform(-0.08, 0.08, (count, 3))
    aims = np.stack([along, np.zeros(count), np.zeros(count)], axis=1) + random.uniform(-0.15, 0.15, (count, 3))
    turns = look_at(centres - aims, np.zeros(3))[:, :, :3]
    return np.concatenate([turns, centres[:, :, None]], axis=2)


def draw(folder: Path, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Write the photos that are not there yet; the true poses by name."""
    random = np.random.default_rng(seed)
    truth = dict(zip((f"{i:04d}.png" for i in random.permutation(count)), poses(count, random), strict=True))
    scene = street(STEP * count, random)
    directions = torch.from_numpy(camera_rays(LENS, LENS.width, LENS.height))
    folder.mkdir(parents=True, exist_ok=True)

    def take(name: str) -> None:
        if (folder / name).exists():
            return
        pose = truth[name]
        near = tuple(solid for solid in scene.solids if abs(float(solid.world_from_shape[0, 3]) - pose[0, 3]) < VISIBLE)
        with torch.inference_mode():
            image = photograph(scene._replace(solids=near), directions, torch.tensor(pose).float(), 1)
        Image.fromarray((255 * image).round().byte().numpy()).save(folder / name)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        torch.set_num_threads(1)  # whole photos side by side: threads that share a small one mostly wait
        list(pool.map(take, truth))
    return truth


def measure(config: sfm.Config, folder: Path, truth: dict[str, np.ndarray]) -> dict[str, Any]:
    """Run stage sfm; its row of the table."""
    progress, sfm_folder = Timed(), folder / str(config.matcher)
    begin = time.perf_counter()
    result = run_stage(sfm.STAGE, config, {"ingest": folder / "ingest"}, sfm_folder, progress)
    seconds = time.perf_counter() - begin
    model = read_model(sfm_folder / "sparse")
    true = np.stack([truth[image.file] for image in model.images])[:, :, 3]
    found = np.stack([image.sfm_from_camera for image in model.images])
    aligned = np.stack([align(found[:, :, 3], true).pose(pose) for pose in found])[:, :, 3]
    off = np.linalg.norm(aligned - true, axis=1).max() / np.ptp(true[:, 0])
    matching = sum(value for kind, value in progress.seconds.items() if kind.startswith("matched"))
    return {
        "matcher": config.matcher,
        "photos": len(truth),
        "registered": len(model.images),
        "centres_max_percent": round(100 * off, 2),
        "matching_seconds": round(matching),
        "seconds": round(seconds),
        "found": result.line,
    }


def main() -> None:
    """Draw the street, then measure every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=400)
    parser.add_argument("--matchers", nargs="+", default=["exhaustive", "retrieval"])
    parser.add_argument("--neighbours", type=int, default=sfm.Config().neighbours)
    parser.add_argument("--max-features", type=int, default=sfm.Config().max_features)
    parser.add_argument("--folder", type=Path, help="where the photos are drawn, and kept")
    add_out(parser)
    arguments = parser.parse_args()
    record = Record(arguments.out)
    with tempfile.TemporaryDirectory() as scratch:
        photos, folder = (arguments.folder or Path(scratch)) / "photos", Path(scratch)
        truth = draw(photos, arguments.photos)
        (folder / "ingest").mkdir()
        ingest.run(ingest.Config(photos=photos), {}, folder / "ingest", Timed())
        for matcher in arguments.matchers:
            config = {"matcher": matcher, "neighbours": arguments.neighbours, "max_features": arguments.max_features}
            record.add(**measure(sfm.Config.model_validate(config), folder, truth))


if __name__ == "__main__":
    main()
