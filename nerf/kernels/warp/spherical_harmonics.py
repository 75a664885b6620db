"""Spherical harmonics (``nerf.kernels.torch.spherical_harmonics``): one launch in the place of some fifty small
operations."""

import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels.torch.spherical_harmonics import spherical_harmonics_backward
from nerf.kernels.warp.launch import launch, vec16

wp.set_module_options({"enable_backward": False})

__all__ = [
    "spherical_harmonics",
    "spherical_harmonics_backward",
]  # the latter runs where poses are refined: torch will do


def spherical_harmonics(directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 16"]:
    """As in nerf.kernels.torch.spherical_harmonics."""
    harmonics = directions.new_empty(len(directions), 16)
    launch(_spherical_harmonics, len(directions), directions, harmonics)
    return harmonics


@wp.kernel
def _spherical_harmonics(directions: wp.array[wp.vec3], harmonics: wp.array[vec16]):
    ray = wp.tid()
    d = directions[ray]
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    harmonics[ray] = vec16(
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (3.0 * zz - 1.0),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5.0 * zz - 1.0),
        0.3731763325901154 * z * (5.0 * zz - 3.0),
        -0.4570457994644658 * x * (5.0 * zz - 1.0),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    )
