"""The hash-grid field's hot loops as NVIDIA Warp kernels: one source for CPU and CUDA (:class:`nerf.kernels.Backend`).

Float32 and int32 tensors, but for the binary occupancy (int64, uint8) and optical depths (float64). On the CPU a call
uses the thread it is made from; results do not depend on how many threads call. On a GPU, gradients of the table are
added in no fixed order.
"""

from nerf.kernels.warp.adam import adam
from nerf.kernels.warp.colour_sampling import accumulate_colours, select_colour_samples
from nerf.kernels.warp.compositing import composite, composite_backward, visible_samples
from nerf.kernels.warp.depth_loss import depth_loss, depth_loss_backward
from nerf.kernels.warp.distortion_loss import distortion, distortion_backward
from nerf.kernels.warp.early_termination import finish_round, pack_rounds
from nerf.kernels.warp.encoding import encode, encode_backward_points, encode_backward_table
from nerf.kernels.warp.gather import gather_rows
from nerf.kernels.warp.launch import compile_kernels, unavailable_reason
from nerf.kernels.warp.marching import march, sample_points, sample_points_backward
from nerf.kernels.warp.mlp import mlp_backward, mlp_forward
from nerf.kernels.warp.occupancy import cell_corners, occupancy_bits, scatter_max
from nerf.kernels.warp.spherical_harmonics import spherical_harmonics, spherical_harmonics_backward

CAPTURABLE: bool = True

__all__ = [
    "CAPTURABLE",
    "accumulate_colours",
    "adam",
    "cell_corners",
    "compile_kernels",
    "composite",
    "composite_backward",
    "depth_loss",
    "depth_loss_backward",
    "distortion",
    "distortion_backward",
    "encode",
    "encode_backward_points",
    "encode_backward_table",
    "finish_round",
    "gather_rows",
    "march",
    "mlp_backward",
    "mlp_forward",
    "occupancy_bits",
    "pack_rounds",
    "sample_points",
    "sample_points_backward",
    "scatter_max",
    "select_colour_samples",
    "spherical_harmonics",
    "spherical_harmonics_backward",
    "unavailable_reason",
    "visible_samples",
]
