"""Whole images, rendered in fixed chunks so that memory is bounded and results do not depend on threads."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.runtime.parallel import in_order

GPU_CHUNKS = 16  # a GPU renders as much at once as so many cores, and waits for the host less often
# A small picture is cut into so many chunks, of so many rays at least: with fewer, most cores would have nothing to do.
CHUNKS, MIN_CHUNK_RAYS = 16, 1024


def render_image(
    model: RadianceModel,
    rays: Rays,
    background: Float[Tensor, "3"],
    chunk: int | None = None,
    on_chunk: Callable[[float], None] | None = None,
) -> Rendering:
    """Render rays of shape (height, width), ``chunk`` at a time in row order; by default as many as suit the
    model and the picture.

    ``on_chunk`` is told the finished share, in (0, 1], after each chunk.
    """
    height, width = rays.near.shape
    if chunk is None and rays.near.device.type == "cpu":
        chunk = min(model.chunk_rays, max(MIN_CHUNK_RAYS, math.ceil(height * width / CHUNKS)))
    chunk = chunk or GPU_CHUNKS * model.chunk_rays
    flat = rays.each(lambda part: part.reshape(height * width, *part.shape[2:]))

    def render(start: int) -> Rendering:
        with torch.inference_mode():  # a property of the thread
            return model.render(flat.each(lambda part: part[start : start + chunk]), background)

    chunks = []
    for rendering in in_order(render, range(0, height * width, chunk), rays.near.device):
        chunks.append(rendering)
        if on_chunk:
            on_chunk(min(1.0, len(chunks) * chunk / (height * width)))
    colour, depth, opacity = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    shape = (height, width)
    return Rendering(colour.reshape(*shape, 3), depth.reshape(shape), opacity.reshape(shape))
