"""The specification of the hash-grid field's hot loops: plain torch, readable, on any device, in float32 or float64.

Also a backend of its own (:class:`nerf.kernels.Backend`), for machines where no other runs.
"""

from nerf.kernels.torch.adam import adam
from nerf.kernels.torch.colour_sampling import accumulate_colours, select_colour_samples
from nerf.kernels.torch.compositing import composite, composite_backward, visible_samples
from nerf.kernels.torch.depth_loss import depth_loss, depth_loss_backward
from nerf.kernels.torch.distortion_loss import distortion, distortion_backward
from nerf.kernels.torch.early_termination import finish_round, pack_rounds
from nerf.kernels.torch.encoding import encode, encode_backward_points, encode_backward_table
from nerf.kernels.torch.gather import gather_rows
from nerf.kernels.torch.marching import march, sample_points, sample_points_backward
from nerf.kernels.torch.mlp import mlp_backward, mlp_forward
from nerf.kernels.torch.occupancy import cell_corners, occupancy_bits, scatter_max
from nerf.kernels.torch.spherical_harmonics import spherical_harmonics, spherical_harmonics_backward

CAPTURABLE: bool = False

__all__ = [
    "CAPTURABLE",
    "accumulate_colours",
    "adam",
    "cell_corners",
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
    "visible_samples",
]
