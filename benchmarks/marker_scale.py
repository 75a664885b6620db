"""How exactly printed markers tell metres: synthetic photos with two markers, the whole chain from photos to scale.

    python -m benchmarks.marker_scale FOLDER [--seeds 0 1 2] [--photos 20]

For each seed photos of 960 × 720 of the demo's still life are drawn into FOLDER, with an ArUco marker and an AprilTag
of 16 % of the table's radius on the table; then ``pipeline run --until scale`` finds cameras and scale. Truth is the
similarity between the cameras found and the true ones. Printed, and written as JSON with ``--out``: how far the scale
is off, the standard error told, whether twice that covers it, and whether the same markers with one length wrong by
3 % are told to contradict each other.
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.record import Record, add_out
from nerf.geometry.alignment import align
from nerf.geometry.rays import Rays, rays_of_view
from nerf.geometry.scene import Camera
from nerf.rendering.srgb import srgb_to_linear
from nerf.rendering.srgb_arrays import srgb_values
from nerf.synthetic.scenes import Solid, SyntheticScene, ring_of_cameras, still_life
from nerf.synthetic.shapes import Box
from pipeline.cli.commands import run_command
from stages.io.files import read_json, read_scene
from stages.sfm.colmap.cameras import camera_rays

LENS = Camera("OPENCV", 960, 720, (1002.0, 999.0, 482.4, 358.6, -0.085, 0.032, 0.0011, -0.0008))
SAMPLES = 2  # along each side of a pixel
SIDE = 0.16  # of the black square; the table's radius is 1
MARGIN_CELLS = 1.5
MARKERS = (("4X4_50", 7, (0.10, 0.02), 0.4), ("APRILTAG_36h11", 3, (0.02, 0.76), -0.7))
CHUNK = 1 << 18


def plate(dictionary: str, number: int, place: tuple[float, float], turn: float) -> Solid:
    """A thin plate on the table that shows a marker."""
    predefined = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    cells = predefined.markerSize + 2
    bits = torch.from_numpy(cv2.aruco.generateImageMarker(predefined, number, cells, borderBits=1) / 255).float()
    half = SIDE / 2 + MARGIN_CELLS * SIDE / cells

    def texture(points: Tensor) -> Tensor:
        column, row = points[..., 0] / SIDE + 0.5, 0.5 - points[..., 1] / SIDE
        within = (column >= 0) & (column < 1) & (row >= 0) & (row < 1)
        at = [(each * cells).long().clamp(0, cells - 1) for each in (row, column)]
        return torch.where(within, 0.04 + 0.76 * bits[at[0], at[1]], 0.8)[..., None].expand(*points.shape[:-1], 3)

    cos, sin = math.cos(turn), math.sin(turn)
    return Solid(
        Box((half, half, 0.002)),
        torch.tensor([[cos, -sin, 0, place[0]], [sin, cos, 0, place[1]], [0, 0, 1, 0.002]]),
        texture,
    )


def draw(folder: Path, count: int, seed: int) -> np.ndarray:
    """Write the photos, averaged in linear light as a sensor does it; their true poses."""
    folder.mkdir(parents=True, exist_ok=True)
    life = still_life(seed)
    scene = SyntheticScene((*life.solids, *(plate(*marker) for marker in MARKERS)), life.noise)
    directions = torch.from_numpy(camera_rays(LENS, SAMPLES * LENS.width, SAMPLES * LENS.height)).reshape(-1, 3)
    poses, random = ring_of_cameras(count, seed), np.random.default_rng(seed)
    for number, pose in enumerate(poses):
        file = folder / f"photo_{number:03d}.jpg"
        if file.exists():
            continue
        rays = rays_of_view(directions, torch.tensor(pose, dtype=torch.float32), near=0.0, far=math.inf)
        chunks = zip(*(part.split(CHUNK) for part in rays), strict=True)
        with torch.inference_mode():
            light = torch.cat([srgb_to_linear(scene.trace(Rays(*chunk)).colour) for chunk in chunks]).numpy()
        light = light.reshape(LENS.height, SAMPLES, LENS.width, SAMPLES, 3).mean((1, 3))
        light = cv2.GaussianBlur(light, (0, 0), 0.6)
        pixels = srgb_values(light) + random.normal(0, 0.006, light.shape)
        Image.fromarray((255 * pixels.clip(0, 1)).round().astype(np.uint8)).save(file, quality=95, subsampling=0)
    return poses


def found(workspace: Path, poses: np.ndarray) -> tuple[dict, float]:
    """scale.json, and the true length of a unit of the sfm frame."""
    scene = read_scene(workspace / "output")
    centres = scene.scene_from_sfm.inverse().points(np.stack([view.scene_from_camera[:, 3] for view in scene.views]))
    numbers = [int(view.name.removesuffix(".jpg")[-3:]) for view in scene.views]
    return read_json(workspace / "output/scale.json"), align(centres, poses[numbers, :, 3]).scale


def main() -> None:
    """Every seed in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--photos", type=int, default=20)
    add_out(parser)
    asked = parser.parse_args()
    record = Record(asked.out)
    for seed in asked.seeds:
        photos, workspace = asked.folder / f"{seed}/photos", asked.folder / f"{seed}/photos.nerf"
        poses = draw(photos, asked.photos, seed)
        told = {}
        for length in (SIDE, 1.03 * SIDE):
            lengths = (f"4X4_50:7={SIDE}m", f"APRILTAG_36h11:3={length:g}m")
            options = [word for one in lengths for word in ("--scale.marker", one)]
            assert run_command(["run", str(photos), "-o", str(workspace), "--until", "scale", *options]) == 0
            told[length], truth = found(workspace, poses)
        right, wrong = told[SIDE], told[1.03 * SIDE]
        off = right["metres_per_unit"] / truth - 1
        record.add(
            seed=seed,
            off_percent=round(100 * off, 3),
            error_percent=round(100 * right["relative_error"], 3),
            covered=abs(off) < 2 * right["relative_error"],
            **{
                f"{one['name'].split(':')[0]}_percent": round(100 * (one["metres_per_unit"] / truth - 1), 3)
                for one in right["references"]
            },
            contradiction_named=wrong["metres_per_unit"] is None,
        )


if __name__ == "__main__":
    main()
