"""Whole images, rendered in fixed chunks so that memory is bounded and results do not depend on threads."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.model import RadianceModel, Rendering
from nerf.rays import Rays


@torch.inference_mode()
def render_image(
    model: RadianceModel,
    rays: Rays,
    background: Float[Tensor, "3"],
    chunk: int = 4096,
    on_chunk: Callable[[float], None] | None = None,
) -> Rendering:
    """Render rays of shape (height, width), ``chunk`` at a time in row order.

    ``on_chunk`` is told the finished share, in (0, 1], after each chunk.
    """
    height, width = rays.near.shape
    flat = Rays(*(part.reshape(height * width, *part.shape[2:]) for part in rays))
    chunks = []
    for start in range(0, height * width, chunk):
        chunks.append(model.render(Rays(*(part[start : start + chunk] for part in flat)), background))
        if on_chunk:
            on_chunk(min(1.0, (start + chunk) / (height * width)))
    colour, depth, opacity = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    shape = (height, width)
    return Rendering(colour.reshape(*shape, 3), depth.reshape(shape), opacity.reshape(shape))
