"""Photos and cameras as training and comparison read them, at any reduction in size."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from nerf.ray_bank import RayBank
    from nerf.rays import Rays
    from nerf.scene import Camera, Scene, Split, View


def scaled_size(camera: "Camera", downscale: float) -> tuple[int, int]:
    """(width, height) of a camera's photos made ``downscale`` times smaller, rounded half up, at least one pixel."""
    return max(1, int(camera.width / downscale + 0.5)), max(1, int(camera.height / downscale + 0.5))


def camera_directions(camera: "Camera", downscale: float) -> "Tensor":
    """The unit bearing vectors (H, W, 3) of a camera's pixel centres at a reduced size."""
    import torch

    from stages.colmap import camera_rays

    return torch.from_numpy(camera_rays(camera, *scaled_size(camera, downscale)))


def training_bank(ingest: Path, scene: "Scene", split: "Split", downscale: float) -> "RayBank":
    """All pixels and rays of one split, on the CPU."""
    import numpy as np
    import torch

    from nerf.ray_bank import build_ray_bank

    views = scene.of_split(split)
    used = sorted({view.camera for view in views})
    return build_ray_bank(
        photos=[torch.tensor(_stored_pixels(ingest, scene, view, downscale)) for view in views],
        camera_of=[used.index(view.camera) for view in views],
        camera_directions=[camera_directions(scene.cameras[camera], downscale) for camera in used],
        poses=torch.tensor(np.stack([view.scene_from_camera for view in views]), dtype=torch.float32),
        near=torch.tensor([view.near for view in views]),
        far=torch.tensor([view.far for view in views]),
    )


def view_rays(scene: "Scene", view: "View", downscale: float) -> "Rays":
    """One ray per pixel of a view, (H, W), on the CPU."""
    import torch

    from nerf.rays import rays_of_view

    pose = torch.tensor(view.scene_from_camera, dtype=torch.float32)
    return rays_of_view(camera_directions(scene.cameras[view.camera], downscale), pose, view.near, view.far)


def view_pixels(
    ingest: Path, scene: "Scene", view: "View", downscale: float, background: Sequence[float] = (1.0, 1.0, 1.0)
) -> "Tensor":
    """The photo of a view as (H, W, 3) float32 in [0, 1], over ``background`` where it has alpha."""
    import torch

    from nerf.training import over

    pixels = torch.tensor(_stored_pixels(ingest, scene, view, downscale)).float() / 255
    alpha = pixels[..., 3] if scene.has_alpha else None
    return over(pixels[..., :3], alpha, torch.tensor(background, dtype=torch.float32))


def _stored_pixels(ingest: Path, scene: "Scene", view: "View", downscale: float) -> "np.ndarray":
    """The photo of a view as uint8: (H, W, 4) in a scene with alpha, else (H, W, 3) with stray alpha over white."""
    import numpy as np

    from stages.photos import load_pixels

    pixels = load_pixels(ingest / view.file, *scaled_size(scene.cameras[view.camera], downscale))
    if scene.has_alpha or pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float32) / 255
    return np.rint(255 + alpha * (pixels[..., :3] - 255.0)).astype(np.uint8)
