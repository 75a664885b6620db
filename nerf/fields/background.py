"""What folded space stands before: a colour of the viewing direction alone, as if it were infinitely far away.

Without it a ray that nothing stops ends in black. So skies, haze and other smooth distance have to be drawn in space,
where nothing about them tells how far away they are, and directions that no photo looked in are black holes.

That light from infinity depends on the direction alone is Rematas et al. 2022 (Urban Radiance Fields, section 3.2),
who use a network; here it is a coarse feature grid like the field's own, read where the direction meets the unit
sphere: colour = sigmoid(sum of the levels' features).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import Backend, grid_layout

# Of the last, one cell is 7° wide: skies and far hills, not what has parallax. Three features are a colour; the kernels
# read four.
LAYOUT = grid_layout(levels=2, coarsest=4, finest=16, log2_rows=13, features=4)
# Of the field's. The sky must be found before fog near the cameras takes its place (docs/experiments/learning_rate.md).
RATE = 10.0
# Pulls what rays run to towards grey, as hard as so much of a ray's light pulls towards the photo. What is hidden gets
# less light than that, which Adam, whose steps are as long for faint gradients, would follow to black and white.
PRIOR = 1e-5


def initial_background() -> Float[Tensor, "rows 4"]:
    """Grey in every direction."""
    return torch.zeros(LAYOUT.rows, LAYOUT.features)


def background_colour(
    backend: Backend, sky: Float[Tensor, "rows 4"], directions: Float[Tensor, "rays 3"]
) -> Float[Tensor, "rays 3"]:
    """The colour seen in each direction (unit vectors)."""
    features = backend.encode(LAYOUT, sky, _on_sphere(directions))
    return features.view(-1, len(LAYOUT.resolutions), LAYOUT.features).sum(1)[:, :3].sigmoid()


def background_backward(
    backend: Backend,
    directions: Float[Tensor, "rays 3"],
    colour: Float[Tensor, "rays 3"],
    grad: Float[Tensor, "rays 3"],
) -> Float[Tensor, "rows 4"]:
    """Gradient of the sky, given the colours it was seen in and theirs."""
    features, unit = _features_backward(colour, grad), _on_sphere(directions)
    of_sky = grad.new_zeros(LAYOUT.rows, LAYOUT.features)
    for level in range(len(LAYOUT.resolutions)):
        backend.encode_backward_table(LAYOUT, level, unit, features, of_sky)
    return of_sky


def directions_backward(
    backend: Backend,
    sky: Float[Tensor, "rows 4"],
    directions: Float[Tensor, "rays 3"],
    colour: Float[Tensor, "rays 3"],
    grad: Float[Tensor, "rays 3"],
) -> Float[Tensor, "rays 3"]:
    """Gradient of the directions, each taken as a free vector."""
    features = _features_backward(colour, grad)
    return backend.encode_backward_points(LAYOUT, sky, _on_sphere(directions), features) / 2


def _features_backward(colour: Float[Tensor, "rays 3"], grad: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays width"]:
    of_logits = torch.nn.functional.pad(grad * colour * (1 - colour), (0, 1))
    return of_logits.repeat(1, len(LAYOUT.resolutions))


def _on_sphere(directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
    """Where a direction meets the unit sphere, in the unit coordinates of the grid around it."""
    return directions / 2 + 0.5
