"""The two small networks behind the grids, without biases, forward and backward by hand: no autograd in the hot loop.

All weights have rows of HIDDEN numbers: hidden layers are (inputs, HIDDEN), outputs (outputs, HIDDEN), which matrix
products with few outputs need to be fast: (n, 64) x (64, 3) takes three times as long as with the smaller one
transposed. Backward is the chain rule: of Y = X W, dW = Xᵀ dY and dX = dY Wᵀ.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels import Backend, Samples
from nerf.runtime.profiler import WorkCounts, span

HIDDEN = 64
GEOMETRY_FEATURES = (
    16  # numbers that the density network hands to the colour network; the first is the logarithm of density
)
DIRECTION_FEATURES = 16  # spherical harmonics, where colour depends on the direction
MAX_LOG_DENSITY = 15.0
# Samples whose hidden layer of the density network exists at a time: as many as stay in a core's cache
# (docs/experiments/step_time.md); on a GPU all.
BLOCK = {"cpu": 1 << 12, "cuda": 1 << 22}


class Weights(NamedTuple):
    """Of features -> hidden -> geometry, and geometry and direction -> hidden -> colour. Also holds gradients."""

    density_hidden: Float[Tensor, "features hidden"]
    density_out: Float[Tensor, "geometry_features hidden"]
    colour_hidden: Float[Tensor, "geometry_features_and_direction hidden"]
    colour_out: Float[Tensor, "3 hidden"]


class DensityPass(NamedTuple):
    """What the density network made of ``features``. Its hidden layer, larger than all of them, is not kept: to compute
    it again takes less time than to fetch it from memory."""

    features: Float[Tensor, "samples features"]
    geometry_features: Float[Tensor, "samples geometry_features"]
    sigma: Float[Tensor, "samples"]


class ColourPass(NamedTuple):
    """What the colour network made of the samples' ``geometry_features`` and their rays, layer by layer."""

    geometry_features: Float[Tensor, "samples geometry_features"]
    hidden: Float[Tensor, "samples hidden"]
    colour: Float[Tensor, "samples 3"]


class DensityGradients(NamedTuple):
    """Of the density network's weights and features."""

    density_hidden: Float[Tensor, "features hidden"]
    density_out: Float[Tensor, "geometry_features hidden"]
    features: Float[Tensor, "samples features"]


class ColourGradients(NamedTuple):
    """Of the colour network's weights and inputs."""

    colour_hidden: Float[Tensor, "geometry_features_and_direction hidden"]
    colour_out: Float[Tensor, "3 hidden"]
    geometry_features: Float[Tensor, "samples geometry_features"]
    harmonics: Float[Tensor, "rays direction"]


def initial_weights(features: int, direction: int, random: torch.Generator) -> Weights:
    """Glorot-uniform weights (Glorot and Bengio 2010, eq. 16); ``direction``: DIRECTION_FEATURES, or 0 for colours that
    are the same from everywhere."""
    return Weights(*(_glorot(rows, random) for rows in (features, GEOMETRY_FEATURES, GEOMETRY_FEATURES + direction, 3)))


def no_directions(directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 0"]:
    """What colours that are the same from everywhere know of the viewing direction, in the place of harmonics."""
    return directions[:, :0]


def no_directions_backward(
    directions: Float[Tensor, "rays 3"], grad: Float[Tensor, "rays 0"]
) -> Float[Tensor, "rays 3"]:
    """They do not depend on it."""
    return torch.zeros_like(directions)


def density_flops(weights: Weights) -> int:
    """Multiplications and additions of a sample's density; the way back has twice as many, without those of the hidden
    layer, which is computed again."""
    return 2 * (weights.density_hidden.numel() + weights.density_out.numel())


def colour_flops(weights: Weights) -> int:
    """Multiplications and additions of a sample's colour, without what its ray shares; twice as many on the
    way back."""
    return 2 * (GEOMETRY_FEATURES * HIDDEN + weights.colour_out.numel())


def density_forward(weights: Weights, features: Float[Tensor, "samples features"]) -> DensityPass:
    """Features to geometry and density."""
    with span("mlp", WorkCounts(matmul_flops=density_flops(weights) * len(features))):
        geometry_features = features.new_empty(len(features), GEOMETRY_FEATURES)
        for rows in _blocks(features):
            torch.mm(_density_hidden(weights, features[rows]), weights.density_out.T, out=geometry_features[rows])
        return DensityPass(features, geometry_features, sigma_of(geometry_features))


def _density_hidden(weights: Weights, features: Float[Tensor, "samples features"]) -> Float[Tensor, "samples hidden"]:
    return (features @ weights.density_hidden).relu_()


def _blocks(samples: Float[Tensor, "samples _"]) -> Iterator[slice]:
    """All samples, BLOCK at a time."""
    size = BLOCK[samples.device.type]
    return (slice(first, first + size) for first in range(0, len(samples), size))


def sigma_of(geometry_features: Float[Tensor, "samples geometry_features"]) -> Float[Tensor, "samples"]:
    """exp(min(x, 15)) of the first output. At the limit an interval as short as 0.001 stops all light but e^-3000, so
    that what the limit takes from the gradient is zero already."""
    return geometry_features[:, 0].clamp(max=MAX_LOG_DENSITY).exp()


def direction_hidden(weights: Weights, harmonics: Float[Tensor, "rays direction"]) -> Float[Tensor, "rays hidden"]:
    """What a ray's viewing direction adds to the colour network's hidden layer, for all of its samples."""
    return harmonics @ weights.colour_hidden[GEOMETRY_FEATURES:]


def colour_forward(
    weights: Weights,
    backend: Backend,
    samples: Samples,
    geometry_features: Float[Tensor, "samples geometry_features"],
    ray_hidden: Float[Tensor, "rays hidden"],
) -> ColourPass:
    """Geometry and viewing direction (:func:`direction_hidden`) to colour, through a sigmoid."""
    with span("mlp", WorkCounts(matmul_flops=colour_flops(weights) * len(geometry_features))):
        hidden = geometry_features @ weights.colour_hidden[:GEOMETRY_FEATURES]
        backend.add_ray_relu(samples, hidden, ray_hidden)
        return ColourPass(geometry_features, hidden, (hidden @ weights.colour_out.T).sigmoid_())


def colour_of(
    weights: Weights,
    backend: Backend,
    ray: Int32[Tensor, "samples"],
    geometry_features: Float[Tensor, "samples geometry_features"],
    ray_hidden: Float[Tensor, "rays hidden"],
) -> Float[Tensor, "samples 3"]:
    """What :func:`colour_forward` says, for samples of rays ``ray``, where no way back is needed: nothing is kept."""
    with span("mlp", WorkCounts(matmul_flops=colour_flops(weights) * len(geometry_features))):
        logits = geometry_features.new_empty(len(geometry_features), 3)
        for rows in _blocks(geometry_features):
            hidden = backend.gather_rows(ray_hidden, ray[rows]).addmm_(
                geometry_features[rows], weights.colour_hidden[:GEOMETRY_FEATURES]
            )
            torch.mm(hidden.relu_(), weights.colour_out.T, out=logits[rows])
        return logits.sigmoid_()


def colour_backward(
    weights: Weights,
    backend: Backend,
    samples: Samples,
    done: ColourPass,
    harmonics: Float[Tensor, "rays direction"],
    grad_colour: Float[Tensor, "samples 3"],
) -> ColourGradients:
    """Gradients of the network's weights and of its inputs, given that of the colour."""
    grad_logits = grad_colour * done.colour * (1 - done.colour)
    grad_hidden = grad_logits @ weights.colour_out
    grad_of_ray = backend.add_ray_relu_backward(samples, done.hidden, grad_hidden)
    of_hidden = torch.cat([done.geometry_features.T @ grad_hidden, harmonics.T @ grad_of_ray])
    grad_geometry_features = grad_hidden @ weights.colour_hidden[:GEOMETRY_FEATURES].T
    return ColourGradients(
        of_hidden,
        grad_logits.T @ done.hidden,
        grad_geometry_features,
        grad_of_ray @ weights.colour_hidden[GEOMETRY_FEATURES:].T,
    )


def density_backward(
    weights: Weights,
    backend: Backend,
    done: DensityPass,
    grad_sigma: Float[Tensor, "samples"],
    grad_geometry_features: Float[Tensor, "samples geometry_features"],
) -> DensityGradients:
    """Gradients of the network's weights and of the features, given those of the density and of the geometry as the
    colour network saw it, to which the former's is added in place."""
    within = done.geometry_features[:, 0] <= MAX_LOG_DENSITY
    grad_geometry_features[:, 0] += torch.where(within, grad_sigma * done.sigma, 0)
    of_hidden, of_out = torch.zeros_like(weights.density_hidden), torch.zeros_like(weights.density_out)
    grad_features = torch.empty_like(done.features)
    for rows in _blocks(done.features):
        features, grad_out = done.features[rows], grad_geometry_features[rows]
        hidden, grad_hidden = _density_hidden(weights, features), grad_out @ weights.density_out
        backend.relu_backward(hidden, grad_hidden)
        of_hidden += features.T @ grad_hidden
        of_out += grad_out.T @ hidden
        torch.mm(grad_hidden, weights.density_hidden.T, out=grad_features[rows])
    return DensityGradients(of_hidden, of_out, grad_features)


def _glorot(others: int, random: torch.Generator) -> Float[Tensor, "others hidden"]:
    """Between the hidden units and ``others``, inputs or outputs alike."""
    limit = (6 / (others + HIDDEN)) ** 0.5
    return (2 * torch.rand(others, HIDDEN, generator=random) - 1) * limit
