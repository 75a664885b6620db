"""Multi-resolution feature grids (``nerf.kernels.torch.encoding``), for grids of four features."""

import functools

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from nerf.kernels import GridLayout
from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})

_PRIME_Y = wp.constant(wp.uint32(2654435761))
_PRIME_Z = wp.constant(wp.uint32(805459861))
FEATURES = 4  # of a vertex: a row of the table is one vec4
# Rows of the point so many ahead are fetched beforehand (docs/experiments/step_time.md).
_PREFETCH_DISTANCE = wp.constant(8)
vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


def encode(
    layout: GridLayout, table: Float[Tensor, "rows features"], points: Float[Tensor, "points 3"]
) -> Float[Tensor, "points width"]:
    """As in nerf.kernels.torch.encoding."""
    features = points.new_empty(len(points), layout.width)
    levels = _levels(layout, points.device)
    count = len(layout.resolutions)
    if points.is_cuda:
        launch(_encode_gpu, count * len(points), levels, count, table, points, features)
    else:
        launch(_encode, len(points), levels, count, table, points, features)
    return features


def encode_backward_table(
    layout: GridLayout,
    levels: range,
    points: Float[Tensor, "points 3"],
    grad_features: Float[Tensor, "points width"],
    grad_table: Float[Tensor, "rows features"],
) -> None:
    """As in nerf.kernels.torch.encoding. Points are added in their order on the CPU, in any order on a GPU."""
    sizes, tensors = (_levels(layout, points.device), len(layout.resolutions)), (points, grad_features, grad_table)
    if points.is_cuda:
        launch(_encode_backward_table_gpu, len(levels) * len(points), *sizes, levels.start, len(points), *tensors)
        return
    for level in levels:
        launch(_encode_backward_table, len(points), *sizes, level, *tensors)


def encode_backward_points(
    layout: GridLayout,
    table: Float[Tensor, "rows features"],
    points: Float[Tensor, "points 3"],
    grad_features: Float[Tensor, "points width"],
) -> Float[Tensor, "points 3"]:
    """As in nerf.kernels.torch.encoding."""
    grad_points = torch.empty_like(points)
    levels = _levels(layout, points.device)
    arguments = levels, len(layout.resolutions), table, points, grad_features, grad_points
    launch(_encode_backward_points, len(points), *arguments)
    return grad_points


@functools.cache
def _levels(layout: GridLayout, device: torch.device) -> Tensor:
    """A row per level: its resolution, first row, the mask of its hash, and whether vertices are hashed."""
    if layout.features != FEATURES:
        raise ValueError(f"these kernels are for {FEATURES} features per vertex, not {layout.features}")
    rows = [
        (resolution, layout.level_offsets[level], layout.level_rows(level) - 1, int(layout.is_hashed(level)))
        for level, resolution in enumerate(layout.resolutions)
    ]
    return torch.tensor(rows, dtype=torch.int32, device=device)


@wp.func
def _cell(coordinate: float, resolution: int):
    """The cell of a coordinate that was multiplied by the resolution; the rest of it is the place within."""
    return wp.clamp(int(coordinate), 0, resolution - 1)


@wp.func
def _corner_rows(level: wp.vec4i, x: int, y: int, z: int):
    """Table rows of the corners of a cell, z changing fastest."""
    if level[3] != 0:
        mask = wp.uint32(level[2])
        x0 = wp.uint32(x)
        x1 = wp.uint32(x + 1)
        y0 = wp.uint32(y) * _PRIME_Y
        y1 = y0 + _PRIME_Y
        z0 = wp.uint32(z) * _PRIME_Z
        z1 = z0 + _PRIME_Z
        return vec8i(
            level[1] + int((x0 ^ y0 ^ z0) & mask),
            level[1] + int((x0 ^ y0 ^ z1) & mask),
            level[1] + int((x0 ^ y1 ^ z0) & mask),
            level[1] + int((x0 ^ y1 ^ z1) & mask),
            level[1] + int((x1 ^ y0 ^ z0) & mask),
            level[1] + int((x1 ^ y0 ^ z1) & mask),
            level[1] + int((x1 ^ y1 ^ z0) & mask),
            level[1] + int((x1 ^ y1 ^ z1) & mask),
        )
    side = level[0] + 1
    first = level[1] + (x * side + y) * side + z
    next_plane = first + side * side
    return vec8i(
        first,
        first + 1,
        first + side,
        first + side + 1,
        next_plane,
        next_plane + 1,
        next_plane + side,
        next_plane + side + 1,
    )


@wp.func
def _corner_weights(u: float, v: float, w: float):
    """Trilinear weights of the corners."""
    a = (1.0 - u) * (1.0 - v)
    b = (1.0 - u) * v
    c = u * (1.0 - v)
    d = u * v
    t = 1.0 - w
    return vec8(a * t, a * w, b * t, b * w, c * t, c * w, d * t, d * w)


@wp.func
def _cell_around(level: wp.vec4i, point: wp.vec3):
    """The cell of a point, table rows of its corners and their trilinear weights."""
    scaled = float(level[0]) * point
    x = _cell(scaled[0], level[0])
    y = _cell(scaled[1], level[0])
    z = _cell(scaled[2], level[0])
    weights = _corner_weights(scaled[0] - float(x), scaled[1] - float(y), scaled[2] - float(z))
    return wp.vec3i(x, y, z), _corner_rows(level, x, y, z), weights


# In C++, since sums of weight * row with wp.vec4 compile to two loads, products and sums per corner (Warp 1.19, x86).
@wp.func_native("""
    float sum[4] = {0.0f};
    assert(entry >= 0 && entry < features.shape[0]);
    for (int corner = 0; corner < 8; ++corner)
        assert(rows.c[corner] >= 0 && rows.c[corner] < table.shape[0]);
    for (int corner = 0; corner < 8; ++corner)
        for (int k = 0; k < 4; ++k)
            sum[k] += weights.c[corner] * table.data[rows.c[corner]].c[k];
    for (int k = 0; k < 4; ++k)
        features.data[entry].c[k] = sum[k];
""")
def _interpolate(table: wp.array[wp.vec4], rows: vec8i, weights: vec8, features: wp.array[wp.vec4], entry: int):
    """features[entry] = sum of weights times rows of the table."""


# A CPU's core spends most of these kernels waiting for memory, so it asks for the rows of later points beforehand. A
# GPU has other threads to go on with.
@wp.func_native("""
#ifndef __CUDA_ARCH__
    for (int corner = 0; corner < 8; ++corner)
        __builtin_prefetch(table.data + rows.c[corner]);
#endif
""")
def _prefetch(table: wp.array[wp.vec4], rows: vec8i):
    """Have rows of the table on their way to a CPU's caches."""


@wp.func
def _prefetch_cell(table: wp.array[wp.vec4], level: wp.vec4i, point: wp.vec3):
    """The rows around a point. Those of grids without a hash stand in order, mostly few: caches do without."""
    if level[3] != 0:
        scaled = float(level[0]) * point
        x = _cell(scaled[0], level[0])
        y = _cell(scaled[1], level[0])
        _prefetch(table, _corner_rows(level, x, y, _cell(scaled[2], level[0])))


@wp.func
def _point_ahead(points: wp.array[wp.vec3], i: int):
    """The point whose rows are to be fetched at the turn of number i."""
    return points[wp.min(i + _PREFETCH_DISTANCE, points.shape[0] - 1)]


@wp.kernel
def _encode(
    levels: wp.array[wp.vec4i],
    count: int,
    table: wp.array[wp.vec4],
    points: wp.array[wp.vec3],
    features: wp.array[wp.vec4],
):
    i = wp.tid()
    point = points[i]
    later = _point_ahead(points, i)
    for index in range(count):
        level = levels[index]
        _prefetch_cell(table, level, later)
        _, rows, weights = _cell_around(level, point)
        _interpolate(table, rows, weights, features, i * count + index)


@wp.kernel
def _encode_gpu(
    levels: wp.array[wp.vec4i],
    count: int,
    table: wp.array[wp.vec4],
    points: wp.array[wp.vec3],
    features: wp.array[wp.vec4],
):
    """A thread per level of a point: on a GPU neighbouring threads should touch neighbouring memory."""
    i = wp.tid()
    level = levels[i % count]
    _, rows, weights = _cell_around(level, points[i / count])
    _interpolate(table, rows, weights, features, i)


@wp.kernel
def _encode_backward_table(
    levels: wp.array[wp.vec4i],
    count: int,
    index: int,
    points: wp.array[wp.vec3],
    grad_features: wp.array[wp.vec4],
    grad_table: wp.array[wp.vec4],
):
    i = wp.tid()
    level = levels[index]
    _prefetch_cell(grad_table, level, _point_ahead(points, i))
    _, rows, weights = _cell_around(level, points[i])
    grad = grad_features[i * count + index]
    for corner in range(8):
        wp.atomic_add(grad_table, rows[corner], weights[corner] * grad)


# Neighbouring threads of a GPU have neighbouring samples, of which many share the cell of a coarse grid: thousands
# would wait for each other to add to the same few rows. So a run of threads with one cell first sums what it adds.
# That all of a row is added at once needs compute capability 9.
@wp.func_native("""
    float sums[8][4];
    for (int corner = 0; corner < 8; ++corner)
        for (int k = 0; k < 4; ++k)
            sums[corner][k] = weights.c[corner] * grad.c[k];
    bool adds = true;
#ifdef __CUDA_ARCH__
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    const bool follows = lane > 0 && ((active >> (lane - 1)) & 1u);
    const int before_level = __shfl_up_sync(active, level, 1);
    const int before_x = __shfl_up_sync(active, x, 1);
    const int before_y = __shfl_up_sync(active, y, 1);
    const int before_z = __shfl_up_sync(active, z, 1);
    adds = !follows || before_level != level || before_x != x || before_y != y || before_z != z;
    const unsigned heads = __ballot_sync(active, adds);
    if (heads != active) {
        const unsigned later = lane == 31 ? 0u : heads & (~0u << (lane + 1));
        const unsigned ended = lane == 31 ? 0u : ~active & (~0u << (lane + 1));
        const int next = later ? __ffs(later) - 1 : 32;
        const int end = min(next, ended ? __ffs(ended) - 1 : 32);
        for (int offset = 1; offset < 32; offset <<= 1) {
            const bool within = lane + offset < end;
            if (!__any_sync(active, within))
                break;
            for (int corner = 0; corner < 8; ++corner)
                for (int k = 0; k < 4; ++k) {
                    const float more = __shfl_down_sync(active, sums[corner][k], offset);
                    sums[corner][k] += within ? more : 0.0f;
                }
        }
    }
#endif
    if (adds)
        for (int corner = 0; corner < 8; ++corner) {
            auto* row = grad_table.data + rows.c[corner];
            assert(rows.c[corner] >= 0 && rows.c[corner] < grad_table.shape[0]);
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
            atomicAdd(reinterpret_cast<float4*>(row),
                make_float4(sums[corner][0], sums[corner][1], sums[corner][2], sums[corner][3]));
#else
            for (int k = 0; k < 4; ++k)
                wp::atomic_add(&row->c[k], sums[corner][k]);
#endif
        }
""")
def _add_to_rows(
    grad_table: wp.array[wp.vec4], rows: vec8i, weights: vec8, grad: wp.vec4, level: int, x: int, y: int, z: int
):
    """grad_table[rows] += weights times grad, for the corners of cell (x, y, z) of a level."""


@wp.kernel
def _encode_backward_table_gpu(
    levels: wp.array[wp.vec4i],
    count: int,
    first: int,
    number: int,
    points: wp.array[wp.vec3],
    grad_features: wp.array[wp.vec4],
    grad_table: wp.array[wp.vec4],
):
    """For a GPU: of so many levels from the first on, a thread per level of a point."""
    i = wp.tid() % number
    index = first + wp.tid() / number
    level = levels[index]
    cell, rows, weights = _cell_around(level, points[i])
    _add_to_rows(grad_table, rows, weights, grad_features[i * count + index], index, cell[0], cell[1], cell[2])


@wp.kernel
def _encode_backward_points(
    levels: wp.array[wp.vec4i],
    count: int,
    table: wp.array[wp.vec4],
    points: wp.array[wp.vec3],
    grad_features: wp.array[wp.vec4],
    grad_points: wp.array[wp.vec3],
):
    i = wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    later = _point_ahead(points, i)
    for index in range(count):
        level = levels[index]
        _prefetch_cell(table, level, later)
        scaled = float(level[0]) * points[i]
        x = _cell(scaled[0], level[0])
        y = _cell(scaled[1], level[0])
        z = _cell(scaled[2], level[0])
        u = scaled[0] - float(x)
        v = scaled[1] - float(y)
        w = scaled[2] - float(z)
        rows = _corner_rows(level, x, y, z)
        grad = grad_features[i * count + index]
        # What the loss gains per unit of each corner's weight.
        g000 = wp.dot(grad, table[rows[0]])
        g001 = wp.dot(grad, table[rows[1]])
        g010 = wp.dot(grad, table[rows[2]])
        g011 = wp.dot(grad, table[rows[3]])
        g100 = wp.dot(grad, table[rows[4]])
        g101 = wp.dot(grad, table[rows[5]])
        g110 = wp.dot(grad, table[rows[6]])
        g111 = wp.dot(grad, table[rows[7]])
        grad_x = wp.lerp(wp.lerp(g100 - g000, g101 - g001, w), wp.lerp(g110 - g010, g111 - g011, w), v)
        grad_y = wp.lerp(wp.lerp(g010 - g000, g011 - g001, w), wp.lerp(g110 - g100, g111 - g101, w), u)
        grad_z = wp.lerp(wp.lerp(g001 - g000, g011 - g010, v), wp.lerp(g101 - g100, g111 - g110, v), u)
        total += float(level[0]) * wp.vec3(grad_x, grad_y, grad_z)
    grad_points[i] = total
