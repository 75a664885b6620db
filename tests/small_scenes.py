"""Tiny photo sets of the synthetic still life, written fresh by the tests that need them."""

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerf.geometry.rays import rays_of_view
from nerf.synthetic.scenes import ring_of_cameras, still_life

SIZE, FOCAL_PX = 40, 52.0
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])


def pinhole_directions(width: int, height: int, focal_px: float) -> torch.Tensor:
    """Unit ray directions (height, width, 3) of the pixel centres of an ideal camera."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x, y, np.full_like(x, focal_px)], -1)
    return torch.tensor(rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype=torch.float32)


def write_blender_scene(folder: Path, train: int = 10, test: int = 2, size: int = SIZE) -> Path:
    """A folder like the NeRF-synthetic ones: RGBA photos, transforms_train.json and transforms_test.json."""
    scene, directions = still_life(), pinhole_directions(size, size, FOCAL_PX * size / SIZE)
    poses = ring_of_cameras(train + test)
    for split, numbers in (("train", range(train)), ("test", range(train, train + test))):
        (folder / split).mkdir(parents=True)
        frames = []
        for number in numbers:
            pose = torch.tensor(poses[number], dtype=torch.float32)
            trace = scene.trace(rays_of_view(directions, pose, 0.0, 10.0))
            pixels = torch.cat([trace.colour, trace.hit[..., None].float()], -1)
            Image.fromarray((pixels * 255).round().byte().numpy()).save(folder / split / f"r_{number}.png")
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = poses[number][:, :3] @ OPENGL_FROM_OPENCV, poses[number][:, 3]
            frames.append({"file_path": f"./{split}/r_{number}", "transform_matrix": matrix.tolist()})
        angle = 2 * np.arctan(size / 2 / (FOCAL_PX * size / SIZE))
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder
