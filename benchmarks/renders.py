"""Renders of test photos as stage evaluate wrote them, and the photos that they are compared with."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerf.geometry.scene import Scene, View
from stages.train.data import PhotoReader


def read_render_and_photo(
    file: Path, ingest: Path, scene: Scene, view: View, background: Sequence[float]
) -> tuple[Float[Tensor, "1 3 h w"], Float[Tensor, "1 3 h w"]]:
    """A render, and its photo at the same size and over the same background, both sRGB in [0, 1]."""
    with Image.open(file) as picture:
        render = torch.from_numpy(np.asarray(picture.convert("RGB")) / np.float32(255))
    downscale = scene.cameras[view.camera].width / render.shape[1]
    photo = PhotoReader(ingest, scene, downscale).pixels(view, background)
    one, other = (pixels.permute(2, 0, 1)[None] for pixels in (render, photo))
    return one, other
