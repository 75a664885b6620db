"""The exponential map of rotations, exact and with exact derivatives down to no rotation at all."""

import torch
from jaxtyping import Float
from torch import Tensor

SERIES_BELOW = 1e-2  # radians²: the series' first left-out term, θ⁶/5040, is then below 2e-10 of the value


def rotation_from_vector(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """R = I + (sin θ / θ) [v] + ((1 - cos θ) / θ²) [v]², θ = |v| in radians (Rodrigues' formula).

    Near 0 both factors are their series in θ², whose derivatives are finite there: refinement begins at v = 0, where
    the closed forms are 0/0. 1 - cos θ is taken as 2 sin²(θ/2), which does not cancel.
    """
    square = vector.square().sum(-1)
    small = square < SERIES_BELOW
    angle = torch.where(small, 1.0, square).sqrt()  # away from 0, so that no infinite derivative is multiplied by 0
    sine = torch.where(small, 1 - square / 6 + square.square() / 120, angle.sin() / angle)
    versine = torch.where(
        small, 0.5 - square / 24 + square.square() / 720, 0.5 * ((angle / 2).sin() / (angle / 2)) ** 2
    )
    cross = cross_matrix(vector)
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + sine[..., None, None] * cross + versine[..., None, None] * (cross @ cross)


def cross_matrix(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """[v] with [v] w = v × w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
