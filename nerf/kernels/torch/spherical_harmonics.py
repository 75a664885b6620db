"""The viewing direction as the sixteen real spherical harmonics up to degree 3."""

import torch
from jaxtyping import Float
from torch import Tensor


def spherical_harmonics(directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 16"]:
    """The orthonormal basis on the unit sphere, as polynomials in x, y, z (Sloan 2008, appendix A2)."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            -0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        -1,
    )


def spherical_harmonics_backward(
    directions: Float[Tensor, "rays 3"], grad: Float[Tensor, "rays 16"]
) -> Float[Tensor, "rays 3"]:
    """Gradient of the directions, each taken as a free vector: the polynomials' derivatives."""
    x, y, z = directions.unbind(-1)
    _, g1, g2, g3, g4, g5, g6, g7, g8, g9, g10, g11, g12, g13, g14, g15 = grad.unbind(-1)
    a, b, c = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005
    d, e, f = 0.5462742152960396, 0.5900435899266435, 2.890611442640554
    p, q, r = 0.4570457994644658, 0.3731763325901154, 1.445305721320277
    ring, cone = 5 * z * z - 1, 3 * (x * x - y * y)
    grad_x = -a * g3 + b * (y * g4 - z * g7) + 2 * d * x * g8 - 6 * e * x * y * g9 + f * y * z * g10
    grad_x = grad_x - p * ring * g13 + 2 * r * x * z * g14 - e * cone * g15
    grad_y = -a * g1 + b * (x * g4 - z * g5) - 2 * d * y * g8 - e * cone * g9 + f * x * z * g10
    grad_y = grad_y - p * ring * g11 - 2 * r * y * z * g14 + 6 * e * x * y * g15
    grad_z = a * g2 - b * (y * g5 + x * g7) + 6 * c * z * g6 + f * x * y * g10 - 10 * p * z * (y * g11 + x * g13)
    grad_z = grad_z + q * (15 * z * z - 3) * g12 + r * (x * x - y * y) * g14
    return torch.stack([grad_x, grad_y, grad_z], -1)
