"""Rows of a table by their numbers (``nerf.kernels.torch.gather``)."""

import warp as wp
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})


def gather_rows(values: Float[Tensor, "rows width"], rows: Int32[Tensor, "chosen"]) -> Float[Tensor, "chosen width"]:
    """As in nerf.kernels.torch.gather."""
    if not values.is_cuda:
        return values.index_select(0, rows)
    # Torch gives each row of 16 to 64 numbers a block of threads of its own, which takes several times as long
    # (docs/experiments/gpu.md).
    gathered, vectors = values.new_empty(len(rows), values.shape[1]), values.shape[1] // 4
    launch(_gather_rows, vectors * len(rows), vectors, values, rows, gathered)
    return gathered


@wp.kernel
def _gather_rows(vectors: int, values: wp.array[wp.vec4], rows: wp.array[int], gathered: wp.array[wp.vec4]):
    i = wp.tid()
    gathered[i] = values[rows[i / vectors] * vectors + i % vectors]
