"""Trains the hash-grid field on a scene with Blender-style cameras and prints held-out PSNR against training seconds.

python -m benchmarks.grid_field ../shared/data/lego_400 --downscale 2 --seconds 60 --picture lego.png
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.record import Record, add_out
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.rays import Rays
from nerf.kernels import torch as reference
from nerf.kernels import warp as fast
from nerf.rendering.images import render_image
from nerf.runtime.parallel import take_over_cores, workers
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.psnr import mean_squared_error, psnr
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from nerf.training.trainer import composite_over

SCENE_PER_BLENDER = 0.75  # takes the objects of the NeRF-synthetic set into [-0.9, 0.9]^3
WHITE = torch.ones(3)


def read_dataset(folder: Path, split: str, downscale: int, every: int) -> RayDataset:
    """All photos of a split, RGBA, made smaller by averaging premultiplied pixels."""
    cameras = json.loads((folder / f"transforms_{split}.json").read_text())
    photos, poses = [], []
    for frame in cameras["frames"][::every]:
        image = Image.open(folder / f"{frame['file_path']}.png").convert("RGBA")
        photos.append(torch.from_numpy(_smaller(np.asarray(image) / 255, downscale)))
        pose = np.array(frame["transform_matrix"])[:3] * [1, -1, -1, SCENE_PER_BLENDER]
        poses.append(torch.tensor(pose, dtype=torch.float32))
    height, width = photos[0].shape[:2]
    focal = width / 2 / math.tan(cameras["camera_angle_x"] / 2)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    ray_directions = torch.stack([(x - width / 2) / focal, (y - height / 2) / focal, torch.ones_like(x)], -1)
    near, far = torch.full((len(poses),), 0.1), torch.full((len(poses),), 10.0)
    ray_directions /= ray_directions.norm(dim=-1, keepdim=True)
    return ray_dataset_from_images(photos, [0] * len(poses), [ray_directions], torch.stack(poses), near, far)


def _smaller(pixels: np.ndarray, factor: int) -> np.ndarray:
    height, width = (size // factor for size in pixels.shape[:2])
    alpha = pixels[..., 3:]
    mean = np.concatenate([pixels[..., :3] * alpha, alpha], -1)
    mean = mean[: height * factor, : width * factor].reshape(height, factor, width, factor, 4).mean((1, 3))
    colour = np.divide(mean[..., :3], mean[..., 3:], out=np.zeros_like(mean[..., :3]), where=mean[..., 3:] > 0)
    return np.round(255 * np.concatenate([colour, mean[..., 3:]], -1)).astype(np.uint8)


def heldout(model: HashGridField, dataset: RayDataset) -> tuple[float, list[torch.Tensor]]:
    """Mean PSNR over the views, and [picture, truth] of the first."""
    values, first = [], []
    for view in range(len(dataset.near)):
        pixels = torch.arange(int(dataset.first_pixel[view]), int(dataset.first_pixel[view + 1]))
        side = math.isqrt(len(pixels))
        rays, colour, alpha, _ = dataset.lookup(pixels)
        square = Rays(*(part.reshape(side, side, *part.shape[1:]) for part in rays))
        truth = composite_over(colour, alpha, WHITE).view(side, side, 3)
        picture = render_image(model, square, WHITE).colour
        values.append(psnr(mean_squared_error(picture, truth)))
        first = first or [picture, truth]
    return sum(values) / len(values), first


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--num-levels", type=int, default=5)
    parser.add_argument("--log2-hashmap-size", type=int, default=18)
    parser.add_argument("--max-res", type=int, default=384)
    parser.add_argument("--steps", type=int, default=384)
    parser.add_argument("--samples", type=int, default=1 << 14)
    parser.add_argument("--backend", choices=("warp", "torch"), default="warp")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--test-every", type=int, default=5)
    parser.add_argument("--picture", type=Path, default=None)
    parser.add_argument("--processor-time", action="store_true", help="count this, not the clock: on a busy machine")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    print(f"{torch.get_num_threads()} threads")
    take_over_cores()
    settings = HashGridSettings(
        given.num_levels, 4, given.log2_hashmap_size, 16, given.max_res, diagonal_steps=given.steps
    )
    train = read_dataset(given.folder, "train", given.downscale, 1)
    test = read_dataset(given.folder, "test", given.downscale, given.test_every)
    model = HashGridField(settings, given.seed, fast if given.backend == "warp" else reference)
    trainer = HashGridTrainer(
        model, train, HashGridTrainerSettings(given.seed, "random", given.samples, micro_batches=workers())
    )
    print(f"{settings}\n{model.layout.rows:,} rows")
    clock = time.process_time if given.processor_time else time.perf_counter
    seconds, step, rays, due = 0.0, 0, 0, 5.0
    while seconds < given.seconds:
        started = clock()
        result = trainer.step(step, seconds / given.seconds)
        seconds += clock() - started
        step, rays = step + 1, rays + result.rays
        if seconds >= min(due, given.seconds):
            quality, pictures = heldout(model, test)
            per_ray = round(float(trainer.samples_per_ray), 1)
            speed = {"steps": step, "rays_per_second": rays / seconds, "samples_per_ray": per_ray}
            record.add(seconds=round(seconds, 1), psnr=quality, train_psnr=round(result.psnr, 2), **speed)
            due *= 2
            if given.picture:
                both = (255 * torch.cat(pictures, 1).clamp(0, 1)).round().to(torch.uint8)
                Image.fromarray(both.numpy()).save(given.picture)


if __name__ == "__main__":
    main()
