"""The background model of a contracted scene: a colour that depends on the viewing direction alone.

Without it a ray that hits nothing ends in black. The field then has to place skies, haze and other smooth distance in
space, where nothing tells how far away they are, and directions that no photo looked in are black holes.

A background that depends on the direction alone is Rematas et al. 2022 (Urban Radiance Fields, section 3.2), who use a
network; here it is a coarse feature grid like the field's own, read where the direction meets the unit sphere:
colour = sigmoid(sum of the levels' features).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import Backend, grid_layout

# A cell of the finest level is 7° wide: enough for skies and far hills, too coarse for what has parallax. Three of the
# four features that the kernels read are a colour.
BACKGROUND_LAYOUT = grid_layout(num_levels=2, base_res=4, max_res=16, log2_hashmap_size=13, features_per_level=4)
# Times the field's learning rate: the background must be learnt before floaters near the cameras take its place
# (docs/experiments/learning_rate.md).
BACKGROUND_LR_SCALE = 10.0
# Weight of the prior that the background is grey, in the unit of a ray's transmittance. Where the background is hidden,
# rays reach it with less, and Adam, whose steps are as long for faint gradients, would drive it to black or white.
BACKGROUND_PRIOR = 1e-5


def initial_background() -> Float[Tensor, "rows 4"]:
    """Grey in every direction."""
    return torch.zeros(BACKGROUND_LAYOUT.rows, BACKGROUND_LAYOUT.features)


def background_colour(
    backend: Backend, table: Float[Tensor, "rows 4"], directions: Float[Tensor, "rays 3"]
) -> Float[Tensor, "rays 3"]:
    """The colour seen in each direction (unit vectors)."""
    features = backend.encode(BACKGROUND_LAYOUT, table, _on_sphere(directions))
    return features.view(-1, len(BACKGROUND_LAYOUT.resolutions), BACKGROUND_LAYOUT.features).sum(1)[:, :3].sigmoid()


def background_backward(
    backend: Backend,
    directions: Float[Tensor, "rays 3"],
    colour: Float[Tensor, "rays 3"],
    grad: Float[Tensor, "rays 3"],
) -> Float[Tensor, "rows 4"]:
    """Gradient of the table, given the colours it was seen in and theirs."""
    features, unit = _features_backward(colour, grad), _on_sphere(directions)
    grad_table = grad.new_zeros(BACKGROUND_LAYOUT.rows, BACKGROUND_LAYOUT.features)
    levels = range(len(BACKGROUND_LAYOUT.resolutions))
    backend.encode_backward_table(BACKGROUND_LAYOUT, levels, unit, features, grad_table)
    return grad_table


def directions_backward(
    backend: Backend,
    table: Float[Tensor, "rows 4"],
    directions: Float[Tensor, "rays 3"],
    colour: Float[Tensor, "rays 3"],
    grad: Float[Tensor, "rays 3"],
) -> Float[Tensor, "rays 3"]:
    """Gradient of the directions, each taken as a free vector."""
    features = _features_backward(colour, grad)
    return backend.encode_backward_points(BACKGROUND_LAYOUT, table, _on_sphere(directions), features) / 2


def _features_backward(colour: Float[Tensor, "rays 3"], grad: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays width"]:
    of_logits = torch.nn.functional.pad(grad * colour * (1 - colour), (0, 1))
    return of_logits.repeat(1, len(BACKGROUND_LAYOUT.resolutions))


def _on_sphere(directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
    """Where a direction meets the unit sphere, in the unit coordinates of the grid around it."""
    return directions / 2 + 0.5
