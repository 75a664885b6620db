"""Multi-resolution grids of features with trilinear interpolation (Müller et al. 2022, section 3)."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels import GridLayout

PRIMES = (1, 2654435761 - (1 << 32), 805459861)  # as signed 32-bit numbers, whose products wrap to the same bits


def encode(
    layout: GridLayout, table: Float[Tensor, "rows features"], points: Float[Tensor, "points 3"]
) -> Float[Tensor, "points width"]:
    """Features of points in unit coordinates: on every level the trilinear mean of the eight vertices around.

    A point on or beyond the border belongs to the nearest cell, whose interpolation goes on beyond it.
    """
    if not len(points):
        return points.new_zeros(0, layout.width)
    features = []
    for level in range(len(layout.resolutions)):
        cell, inside = _cell(layout.resolutions[level], points)
        rows, weights = (part.T.contiguous() for part in (_corner_rows(layout, level, cell), _corner_weights(inside)))
        features.append(torch.nn.functional.embedding_bag(rows, table, per_sample_weights=weights, mode="sum"))
    return torch.cat(features, -1)


def encode_backward_table(
    layout: GridLayout,
    levels: range,
    points: Float[Tensor, "points 3"],
    grad_features: Float[Tensor, "points width"],
    grad_table: Float[Tensor, "rows features"],
) -> None:
    """Add to the rows of some levels in ``grad_table``, in place: every vertex gets the gradient of each point around
    it, times its weight. Levels have no rows in common: several threads may each do some."""
    flat = grad_table.view(-1)
    for level in levels:
        first_column = level * layout.features
        columns = grad_features[:, first_column : first_column + layout.features].T.contiguous()
        cell, inside = _cell(layout.resolutions[level], points)
        first_entry = _corner_rows(layout, level, cell).flatten().long() * layout.features
        weights = _corner_weights(inside)
        for feature, column in enumerate(columns):
            flat.scatter_add_(0, first_entry + feature, (weights * column).flatten())


def encode_backward_points(
    layout: GridLayout,
    table: Float[Tensor, "rows features"],
    points: Float[Tensor, "points 3"],
    grad_features: Float[Tensor, "points width"],
) -> Float[Tensor, "points 3"]:
    """Gradient of the points: inside a cell, the features' own gradient; it jumps where a point changes its cell."""
    grad_points = torch.zeros_like(points)
    for level, grad in enumerate(grad_features.split(layout.features, -1)):
        resolution = layout.resolutions[level]
        cell, inside = _cell(resolution, points)
        rows = _corner_rows(layout, level, cell)
        corners = table.index_select(0, rows.flatten()).view(8, *grad.shape)
        grad_points += resolution * _corner_weights_backward(inside, (corners * grad).sum(-1))
    return grad_points


def _cell(
    resolution: int, points: Float[Tensor, "points 3"]
) -> tuple[Int32[Tensor, "3 points"], Float[Tensor, "3 points"]]:
    """The cell of each point and where in it the point is, in [0, 1]^3; an axis a row, which torch is fastest with."""
    scaled = points.T.contiguous() * resolution
    cell = scaled.floor().clamp_(0, resolution - 1)
    # The second clamp acts on NaN alone, which has no cell: its features must be NaN, not an index error.
    return cell.int().clamp_(0, resolution - 1), scaled - cell


def _corner_rows(layout: GridLayout, level: int, cell: Int32[Tensor, "3 points"]) -> Int32[Tensor, "8 points"]:
    """Table rows of the corners of each cell, z changing fastest."""
    if layout.is_hashed(level):
        x, y, z = (torch.stack([prime * c, prime * (c + 1)]) for prime, c in zip(PRIMES, cell, strict=True))
        number = x[:, None, None] ^ y[:, None] ^ z
        number = number & (layout.level_rows(level) - 1)
    else:
        side = layout.resolutions[level] + 1
        x, y, z = (torch.stack([c, c + 1]) for c in cell)
        number = (side * x[:, None] + y)[:, :, None] * side + z
    return (layout.level_offsets[level] + number).flatten(0, 2)


def _corner_weights(inside: Float[Tensor, "3 points"]) -> Float[Tensor, "8 points"]:
    """Trilinear weights of the corners: the product over axes of u at the far face and 1 - u at the near one."""
    x, y, z = (torch.stack([1 - u, u]) for u in inside)
    return ((x[:, None] * y)[:, :, None] * z).flatten(0, 2)


def _corner_weights_backward(
    inside: Float[Tensor, "3 points"], grad: Float[Tensor, "8 points"]
) -> Float[Tensor, "points 3"]:
    """Along an axis: the far face less the near one of the values interpolated on them."""
    x, y, z = (torch.stack([1 - u, u]) for u in inside)
    grad = grad.view(2, 2, 2, -1)
    grad_x = torch.einsum("ijkn,jn,kn->in", grad, y, z)
    grad_y = torch.einsum("ijkn,in,kn->jn", grad, x, z)
    grad_z = torch.einsum("ijkn,in,jn->kn", grad, x, y)
    return torch.stack([face[1] - face[0] for face in (grad_x, grad_y, grad_z)], -1)
