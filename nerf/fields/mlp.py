"""The two small networks behind the grids, without biases: features to density and geometry features, these and the
viewing direction to colour. Forward and backward by hand (``nerf.kernels``): no autograd in the hot loop.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels import HIDDEN, Backend, Layers, Samples
from nerf.runtime.profiler import WorkCounts, span

GEOMETRY_FEATURES = (
    16  # numbers that the density network hands to the colour network; the first is the logarithm of density
)
DIRECTION_FEATURES = 16  # spherical harmonics, where colour depends on the direction
MAX_LOG_DENSITY = 15.0


class Weights(NamedTuple):
    """Of features -> hidden -> geometry, and geometry and direction -> hidden -> colour. Also holds gradients."""

    density_hidden: Float[Tensor, "features hidden"]
    density_out: Float[Tensor, "geometry_features hidden"]
    colour_hidden: Float[Tensor, "geometry_features_and_direction hidden"]
    colour_out: Float[Tensor, "3 hidden"]

    @property
    def density(self) -> Layers:
        """The density network."""
        return Layers(self.density_hidden, self.density_out)

    @property
    def colour(self) -> Layers:
        """The colour network, as far as it is the samples' own (:func:`direction_hidden`)."""
        return Layers(self.colour_hidden[:GEOMETRY_FEATURES], self.colour_out)


class DensityPass(NamedTuple):
    """What the density network made of ``features``."""

    features: Float[Tensor, "samples features"]
    geometry_features: Float[Tensor, "samples geometry_features"]
    sigma: Float[Tensor, "samples"]


class ColourPass(NamedTuple):
    """What the colour network made of the samples' geometry features and of their rays' ``harmonics``, which add
    ``ray_hidden`` to its hidden layer."""

    harmonics: Float[Tensor, "rays direction"]
    ray_hidden: Float[Tensor, "rays hidden"]
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
    """Multiplications and additions of a sample's colour, without what its ray shares; the way back as of density."""
    return 2 * (GEOMETRY_FEATURES * HIDDEN + weights.colour_out.numel())


def density_forward(weights: Weights, backend: Backend, features: Float[Tensor, "samples features"]) -> DensityPass:
    """Features to geometry and density."""
    with span("mlp", WorkCounts(matmul_flops=density_flops(weights) * len(features))):
        geometry_features = backend.mlp_forward(weights.density, features)
        return DensityPass(features, geometry_features, sigma_of(geometry_features))


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
    ray: Int32[Tensor, "samples"],
    geometry_features: Float[Tensor, "samples geometry_features"],
    ray_hidden: Float[Tensor, "rays hidden"],
) -> Float[Tensor, "samples 3"]:
    """Geometry and each sample's ray (:func:`direction_hidden`) to colour, through a sigmoid."""
    with span("mlp", WorkCounts(matmul_flops=colour_flops(weights) * len(geometry_features))):
        return backend.mlp_forward(weights.colour, geometry_features, ray, ray_hidden).sigmoid_()


def colour_backward(
    weights: Weights,
    backend: Backend,
    samples: Samples,
    geometry_features: Float[Tensor, "samples geometry_features"],
    done: ColourPass,
    grad_colour: Float[Tensor, "samples 3"],
) -> ColourGradients:
    """Gradients of the network's weights and of its inputs, given that of the colour."""
    grad_logits = grad_colour * done.colour * (1 - done.colour)
    of_hidden, of_out, of_geometry_features, of_rays = backend.mlp_backward(
        weights.colour, geometry_features, grad_logits, samples, done.ray_hidden
    )
    assert of_rays is not None, "rays were given"
    return ColourGradients(
        torch.cat([of_hidden, done.harmonics.T @ of_rays]),
        of_out,
        of_geometry_features,
        of_rays @ weights.colour_hidden[GEOMETRY_FEATURES:].T,
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
    return DensityGradients(*backend.mlp_backward(weights.density, done.features, grad_geometry_features)[:3])


def _glorot(others: int, random: torch.Generator) -> Float[Tensor, "others hidden"]:
    """Between the hidden units and ``others``, inputs or outputs alike."""
    limit = (6 / (others + HIDDEN)) ** 0.5
    return (2 * torch.rand(others, HIDDEN, generator=random) - 1) * limit
