"""The two small networks behind the grids, without biases, forward and backward by hand: no autograd in the hot loop.

Weights are (inputs, outputs), rows of activations are samples. The backward passes are those of the chain rule for
matrix products: of Y = X W, dW = Xᵀ dY and dX = dY Wᵀ.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

HIDDEN = 64
GEOMETRY = 16  # numbers that the density network hands to the colour network; the first is the logarithm of density
DIRECTION = 16  # spherical harmonics
LARGEST_LOG_DENSITY = 15.0


class Weights(NamedTuple):
    """Of features -> hidden -> geometry, and geometry and direction -> hidden -> colour. Also holds gradients."""

    density_hidden: Float[Tensor, "features hidden"]
    density_out: Float[Tensor, "hidden geometry"]
    colour_hidden: Float[Tensor, "geometry_and_direction hidden"]
    colour_out: Float[Tensor, "hidden 3"]


class DensityPass(NamedTuple):
    """What the density network made of ``features``, layer by layer."""

    features: Float[Tensor, "samples features"]
    hidden: Float[Tensor, "samples hidden"]
    geometry: Float[Tensor, "samples geometry"]

    @property
    def sigma(self) -> Float[Tensor, "samples"]:
        """exp(min(x, 15)) of the first output. At the limit an interval as short as 0.001 stops all light but e^-3000,
        so that what the limit takes from the gradient is zero already."""
        return self.geometry[:, 0].clamp(max=LARGEST_LOG_DENSITY).exp()

    def select(self, index: Tensor) -> "DensityPass":
        """The pass of some of the samples."""
        return DensityPass(*(part.index_select(0, index) for part in self))


class ColourPass(NamedTuple):
    """What the colour network made of ``inputs``, layer by layer."""

    inputs: Float[Tensor, "samples geometry_and_direction"]
    hidden: Float[Tensor, "samples hidden"]
    colour: Float[Tensor, "samples 3"]


def initial_weights(features: int, random: torch.Generator) -> Weights:
    """Glorot-uniform weights (Glorot and Bengio 2010, eq. 16)."""
    shapes = ((features, HIDDEN), (HIDDEN, GEOMETRY), (GEOMETRY + DIRECTION, HIDDEN), (HIDDEN, 3))
    return Weights(*(_glorot(inputs, outputs, random) for inputs, outputs in shapes))


def density_forward(weights: Weights, features: Float[Tensor, "samples features"]) -> DensityPass:
    """Features to geometry."""
    hidden = (features @ weights.density_hidden).relu_()
    return DensityPass(features, hidden, hidden @ weights.density_out)


def colour_forward(
    weights: Weights,
    geometry: Float[Tensor, "samples geometry"],
    harmonics: Float[Tensor, "samples direction"],
) -> ColourPass:
    """Geometry and viewing direction to colour, through a sigmoid."""
    inputs = torch.cat([geometry, harmonics], -1)
    hidden = (inputs @ weights.colour_hidden).relu_()
    return ColourPass(inputs, hidden, (hidden @ weights.colour_out).sigmoid_())


def backward(
    weights: Weights,
    density: DensityPass,
    colour: ColourPass,
    grad_sigma: Float[Tensor, "samples"],
    grad_colour: Float[Tensor, "samples 3"],
) -> tuple[Weights, Float[Tensor, "samples features"], Float[Tensor, "samples direction"]]:
    """Gradients of the weights, of the features and of the harmonics, given those of density and colour."""
    grad_logits = grad_colour * colour.colour * (1 - colour.colour)
    grad_hidden = _relu_backward(colour.hidden, grad_logits @ weights.colour_out.T)
    grad_inputs = grad_hidden @ weights.colour_hidden.T
    of_colour = (colour.inputs.T @ grad_hidden, colour.hidden.T @ grad_logits)

    grad_geometry, grad_harmonics = grad_inputs.split([GEOMETRY, DIRECTION], -1)
    within = density.geometry[:, 0] <= LARGEST_LOG_DENSITY
    grad_geometry = grad_geometry.contiguous()
    grad_geometry[:, 0] += torch.where(within, grad_sigma * density.sigma, 0)
    grad_hidden = _relu_backward(density.hidden, grad_geometry @ weights.density_out.T)
    of_density = (density.features.T @ grad_hidden, density.hidden.T @ grad_geometry)
    return Weights(*of_density, *of_colour), grad_hidden @ weights.density_hidden.T, grad_harmonics


def _relu_backward(
    hidden: Float[Tensor, "samples hidden"], grad: Float[Tensor, "samples hidden"]
) -> Float[Tensor, "samples hidden"]:
    return grad.mul_(hidden.sign())  # several times faster than a mask


def _glorot(inputs: int, outputs: int, random: torch.Generator) -> Float[Tensor, "inputs outputs"]:
    limit = (6 / (inputs + outputs)) ** 0.5
    return (2 * torch.rand(inputs, outputs, generator=random) - 1) * limit
