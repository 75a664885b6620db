"""The networks (``nerf.kernels.torch.mlp``). On a CPU a tile of samples goes through all layers at once, so that
nothing but inputs and outputs leaves a core's cache; a GPU multiplies matrices by torch."""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int32
from torch import Tensor

from nerf.kernels import HIDDEN, Layers, MlpGradients, Samples
from nerf.kernels.torch.mlp import BLOCK, backward_in_blocks, forward_in_blocks, hidden_layer
from nerf.kernels.warp.launch import launch

wp.set_module_options({"enable_backward": False})

TILE = 48  # samples, a multiple of both groups below: their hidden layer and its gradient take 24 KB
MAX_LANES = 16  # numbers in a vector of AVX-512, the widest used here
# Of four numbers in a hidden layer. On a GPU each has a thread: neighbouring threads should touch neighbouring memory.
_VEC4_PER_ROW = HIDDEN // 4
# Samples whose gradients a GPU sums by themselves before they join their ray's, as a tile's are on a CPU: of n numbers
# one after the other, in float32, up to n half ulps are lost, here 64 + 64 for a ray of 4096. Sums in float64 take
# twice the vectors.
_PARTIAL_SUM = wp.constant(64)


def mlp_forward(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    ray: Int32[Tensor, "samples"] | None = None,
    ray_hidden: Float[Tensor, "rays hidden"] | None = None,
) -> Float[Tensor, "samples outputs"]:
    """As in nerf.kernels.torch.mlp."""
    assert (ray is None) == (ray_hidden is None), "rays are given or not"
    if inputs.is_cuda:
        return forward_in_blocks(_hidden_layer_gpu, layers, inputs, ray, ray_hidden, BLOCK["cuda"])
    count, width = inputs.shape
    assert width == len(layers.hidden), "every input has its weights"
    outputs, rays = inputs.new_empty(count, len(layers.out)), _rays_or_empty(inputs, ray, ray_hidden)
    arguments = width, layers.hidden, *rays, _padded_columns(layers.out), len(layers.out)
    launch(_mlp_forward, -(-count // TILE), inputs, *arguments, outputs)
    return outputs


def mlp_backward(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    grad: Float[Tensor, "samples outputs"],
    samples: Samples | None = None,
    ray_hidden: Float[Tensor, "rays hidden"] | None = None,
) -> MlpGradients:
    """As in nerf.kernels.torch.mlp."""
    if inputs.is_cuda:
        given = layers, inputs, grad, samples, ray_hidden, BLOCK["cuda"]
        return backward_in_blocks(_hidden_layer_gpu, _hidden_layer_backward_gpu, *given)
    assert (samples is None) == (ray_hidden is None), "rays are given or not"
    count, width = inputs.shape
    assert width == len(layers.hidden) and grad.shape == (count, len(layers.out)), "every number has its weights"
    rays = _rays_or_empty(inputs, None if samples is None else samples.ray, ray_hidden)
    of_layers, of_inputs = (torch.zeros_like(layers.hidden), torch.zeros_like(layers.out)), torch.empty_like(inputs)
    of_rays = torch.zeros_like(rays[1])
    arguments = width, layers.hidden, _padded_columns(layers.hidden), *rays, len(layers.out), layers.out
    launch(_mlp_backward, -(-count // TILE), inputs, *arguments, grad, of_inputs, *of_layers, of_rays)
    return MlpGradients(*of_layers, of_inputs, None if ray_hidden is None else of_rays)


def _rays_or_empty(inputs: Tensor, ray: Tensor | None, ray_hidden: Tensor | None) -> tuple[Tensor, Tensor]:
    """Each sample's ray and what rays add, empty where they add nothing."""
    if ray is None or ray_hidden is None:
        return inputs.new_empty(0, dtype=torch.int32), inputs.new_empty(0, HIDDEN)
    return ray, ray_hidden


def _padded_columns(weights: Float[Tensor, "rows hidden"]) -> Float[Tensor, "hidden padded_rows"]:
    """Transposed, with columns of zeros up to a whole number of vectors."""
    rows = len(weights)
    padded = weights.new_zeros(HIDDEN, -(-rows // MAX_LANES) * MAX_LANES)
    padded[:, :rows] = weights.T
    return padded


# In C++, for sums that stay in registers: a dozen of them take turns, so that none waits for its own last addition, and
# each weight that is read serves a group of samples. Products and sums are fused. ``loose`` is a vector anywhere in
# memory.
_CPU_COMMON = (
    f"""
#ifndef __CUDA_ARCH__
#pragma clang fp contract(fast)
    constexpr int HIDDEN = {HIDDEN}, TILE = {TILE}, MAX_LANES = {MAX_LANES}, GROUP = 6, LONG_GROUP = 12;
"""
    + """
#ifdef __AVX512F__
    constexpr int LANES = 16;
#else
    constexpr int LANES = 8;
#endif
    typedef float vec __attribute__((vector_size(4 * LANES)));
    typedef float loose __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
    static_assert(HIDDEN % (4 * LANES) == 0 && TILE % GROUP == 0 && TILE % LONG_GROUP == 0, "whole vectors and groups");
    const int total = inputs.shape[0] / width, first = tile * TILE, count = wp::min(TILE, total - first);
    const int filled = (count + LONG_GROUP - 1) / LONG_GROUP * LONG_GROUP;  // rows behind the last repeat it
    const float* const x = inputs.data + (long long)first * width;
    const bool with_rays = rays.shape[0] > 0;
    assert(tile >= 0 && count > 0 && inputs.shape[0] == total * width && hidden_weights.shape[0] == width * HIDDEN);
    assert(!with_rays || rays.shape[0] == total);
    for (int s = 0; with_rays && s < count; ++s)
        assert(rays.data[first + s] >= 0 && rays.data[first + s] < ray_hidden.shape[0] / HIDDEN);

    const auto aligned = [](int columns) { return (columns + MAX_LANES - 1) / MAX_LANES * MAX_LANES; };
    // What a group's rays add to columns j ... of their hidden layer; nothing without rays.
    const auto start_sums = [&](int s, int j, vec sum[GROUP][2]) {
        for (int i = 0; i < GROUP; ++i)
            for (int v = 0; v < 2; ++v)
                sum[i][v] = with_rays ? (vec)*(const loose*)(ray_hidden.data + j + v * LANES +
                    (long long)rays.data[first + wp::min(s + i, count - 1)] * HIDDEN) : vec{};
    };
    // sum += rows times weights (row_size, HIDDEN), for a group of rows and columns j ...
    const auto multiply = [&](const float* rows, int row_size, const float* weights, int s, int j, vec sum[GROUP][2]) {
        const float* row[GROUP];
        for (int i = 0; i < GROUP; ++i)
            row[i] = rows + wp::min(s + i, count - 1) * row_size;
        for (int k = 0; k < row_size; ++k) {
            const vec a = *(const loose*)(weights + k * HIDDEN + j);
            const vec b = *(const loose*)(weights + k * HIDDEN + j + LANES);
            for (int i = 0; i < GROUP; ++i) {
                sum[i][0] += row[i][k] * a;
                sum[i][1] += row[i][k] * b;
            }
        }
    };
    // Rows of a tile (TILE, HIDDEN) times ``wanted`` columns of (HIDDEN, padded).
    const auto multiply_columns = [&](const float* rows, const float* columns, int wanted, float* target) {
        const int padded = aligned(wanted);
        for (int s = 0; s < count; s += LONG_GROUP)
            for (int j = 0; j < wanted; j += LANES) {
                vec sum[LONG_GROUP];
                for (int i = 0; i < LONG_GROUP; ++i)
                    sum[i] = vec{};
                for (int k = 0; k < HIDDEN; ++k) {
                    const vec column = *(const loose*)(columns + k * padded + j);
                    for (int i = 0; i < LONG_GROUP; ++i)
                        sum[i] += rows[(s + i) * HIDDEN + k] * column;
                }
                const int kept = wp::min(LANES, wanted - j);
                for (int i = 0; i < LONG_GROUP && s + i < count; ++i) {
                    float* const to = target + (s + i) * wanted + j;
                    if (kept == LANES)
                        *(loose*)to = sum[i];
                    else
                        for (int lane = 0; lane < kept; ++lane)
                            to[lane] = sum[i][lane];
                }
            }
    };
    // max(y, 0), and NaN for NaN, which is not below 0.
    const auto rectified = [](vec y) { return y < 0.0f ? vec{} : y; };
"""
)


@wp.func_native(
    _CPU_COMMON
    + """
    assert(outputs.shape[0] == total * size && columns.shape[0] == HIDDEN * aligned(size));
    alignas(64) float hidden[TILE * HIDDEN];
    for (int s = 0; s < filled; s += GROUP)
        for (int j = 0; j < HIDDEN; j += 2 * LANES) {
            vec sum[GROUP][2];
            start_sums(s, j, sum);
            multiply(x, width, hidden_weights.data, s, j, sum);
            for (int i = 0; i < GROUP; ++i)
                for (int v = 0; v < 2; ++v)
                    *(loose*)(hidden + (s + i) * HIDDEN + j + v * LANES) = rectified(sum[i][v]);
        }
    multiply_columns(hidden, columns.data, size, outputs.data + (long long)first * size);
#endif
"""
)
def _forward_tile(
    tile: int,
    inputs: wp.array[float],
    width: int,
    hidden_weights: wp.array[float],
    rays: wp.array[int],
    ray_hidden: wp.array[float],
    columns: wp.array[float],
    size: int,
    outputs: wp.array[float],
):
    """The outputs of a tile of samples, ``size`` of each; ``columns``: the outputs' weights, transposed and padded."""


@wp.func_native(
    _CPU_COMMON
    + """
    assert(grad_inputs.shape[0] == total * width && grad.shape[0] == total * size);
    assert(out_weights.shape[0] == size * HIDDEN && columns.shape[0] == HIDDEN * aligned(width));
    assert(grad_hidden_weights.shape[0] == width * HIDDEN && grad_out_weights.shape[0] == size * HIDDEN);
    assert(!with_rays || grad_ray_hidden.shape[0] == ray_hidden.shape[0]);
    const float* const dy = grad.data + (long long)first * size;
    alignas(64) float hidden[TILE * HIDDEN], grad_hidden[TILE * HIDDEN];
    for (int s = 0; s < filled; s += GROUP)
        for (int j = 0; j < HIDDEN; j += 2 * LANES) {
            vec sum[GROUP][2], back[GROUP][2];
            start_sums(s, j, sum);
            multiply(x, width, hidden_weights.data, s, j, sum);
            for (int i = 0; i < GROUP; ++i)
                back[i][0] = back[i][1] = vec{};
            multiply(dy, size, out_weights.data, s, j, back);
            for (int i = 0; i < GROUP; ++i)
                for (int v = 0; v < 2; ++v) {
                    const int place = (s + i) * HIDDEN + j + v * LANES;
                    const vec y = rectified(sum[i][v]);
                    *(loose*)(hidden + place) = y;
                    *(loose*)(grad_hidden + place) = y > 0.0f ? back[i][v] : y * back[i][v];
                }
        }
    multiply_columns(grad_hidden, columns.data, width, grad_inputs.data + (long long)first * width);
    // target (row_size, HIDDEN) += rows transposed times a tile, two of its rows and four vectors at a time. A tile has
    // a sum of its own first: adding sample after sample to that of all would lose more digits.
    const auto add_product = [&](const float* rows, int row_size, const float* of_tile, float* target) {
        for (int k = 0; k < row_size; k += 2)
            for (int j = 0; j < HIDDEN; j += 4 * LANES) {
                const int next = wp::min(k + 1, row_size - 1);
                vec sum[2][4];
                for (int v = 0; v < 4; ++v)
                    sum[0][v] = sum[1][v] = vec{};
                for (int s = 0; s < count; ++s) {
                    const float a = rows[s * row_size + k], b = rows[s * row_size + next];
                    for (int v = 0; v < 4; ++v) {
                        const vec y = *(const loose*)(of_tile + s * HIDDEN + j + v * LANES);
                        sum[0][v] += a * y;
                        sum[1][v] += b * y;
                    }
                }
                for (int v = 0; v < 4; ++v) {
                    *(loose*)(target + k * HIDDEN + j + v * LANES) += sum[0][v];
                    if (next > k)
                        *(loose*)(target + next * HIDDEN + j + v * LANES) += sum[1][v];
                }
            }
    };
    add_product(x, width, grad_hidden, grad_hidden_weights.data);
    add_product(dy, size, hidden, grad_out_weights.data);
    for (int s = 0; with_rays && s < count;) {
        const int ray = rays.data[first + s];
        vec sum[HIDDEN / LANES];
        for (int v = 0; v < HIDDEN / LANES; ++v)
            sum[v] = vec{};
        for (; s < count && rays.data[first + s] == ray; ++s)
            for (int v = 0; v < HIDDEN / LANES; ++v)
                sum[v] += *(const loose*)(grad_hidden + s * HIDDEN + v * LANES);
        for (int v = 0; v < HIDDEN / LANES; ++v)
            *(loose*)(grad_ray_hidden.data + (long long)ray * HIDDEN + v * LANES) += sum[v];
    }
#endif
"""
)
def _backward_tile(
    tile: int,
    inputs: wp.array[float],
    width: int,
    hidden_weights: wp.array[float],
    columns: wp.array[float],
    rays: wp.array[int],
    ray_hidden: wp.array[float],
    size: int,
    out_weights: wp.array[float],
    grad: wp.array[float],
    grad_inputs: wp.array[float],
    grad_hidden_weights: wp.array[float],
    grad_out_weights: wp.array[float],
    grad_ray_hidden: wp.array[float],
):
    """What a tile of samples, with ``size`` outputs each, adds to the gradients; ``columns``: the hidden layer's
    weights, transposed and padded."""


@wp.kernel
def _mlp_forward(
    inputs: wp.array[float],
    width: int,
    hidden_weights: wp.array[float],
    rays: wp.array[int],
    ray_hidden: wp.array[float],
    columns: wp.array[float],
    size: int,
    outputs: wp.array[float],
):
    _forward_tile(wp.tid(), inputs, width, hidden_weights, rays, ray_hidden, columns, size, outputs)


@wp.kernel
def _mlp_backward(
    inputs: wp.array[float],
    width: int,
    hidden_weights: wp.array[float],
    columns: wp.array[float],
    rays: wp.array[int],
    ray_hidden: wp.array[float],
    size: int,
    out_weights: wp.array[float],
    grad: wp.array[float],
    grad_inputs: wp.array[float],
    grad_hidden_weights: wp.array[float],
    grad_out_weights: wp.array[float],
    grad_ray_hidden: wp.array[float],
):
    _backward_tile(
        wp.tid(),
        inputs,
        width,
        hidden_weights,
        columns,
        rays,
        ray_hidden,
        size,
        out_weights,
        grad,
        grad_inputs,
        grad_hidden_weights,
        grad_out_weights,
        grad_ray_hidden,
    )


def _hidden_layer_gpu(
    layers: Layers,
    inputs: Float[Tensor, "samples inputs"],
    ray: Int32[Tensor, "samples"] | None,
    ray_hidden: Float[Tensor, "rays hidden"] | None,
) -> Float[Tensor, "samples hidden"]:
    if ray is None or ray_hidden is None:
        return hidden_layer(layers, inputs, None, None)
    hidden = inputs @ layers.hidden
    launch(_add_ray_relu_gpu, _VEC4_PER_ROW * len(hidden), ray, ray_hidden, hidden)
    return hidden


def _hidden_layer_backward_gpu(
    hidden: Float[Tensor, "samples hidden"],
    grad: Float[Tensor, "samples hidden"],
    samples: Samples | None,
    rows: slice,
    grad_of_rays: Float[Tensor, "rays hidden"] | None,
) -> None:
    if samples is None or grad_of_rays is None:
        launch(_relu_backward_gpu, _VEC4_PER_ROW * len(hidden), hidden, grad)
    else:
        arguments = samples.starts, rows.start, rows.stop, hidden, grad, grad_of_rays
        launch(_ray_relu_backward_gpu, _VEC4_PER_ROW * len(grad_of_rays), *arguments)


@wp.func
def _relu(x: Any):
    """max(x, 0), and NaN for NaN, which wp.max alone takes for missing. 0 x changes no finite number."""
    return wp.max(x, type(x)(0.0)) + 0.0 * x


@wp.func
def _relu_gradient(hidden: Any, grad: Any):
    """The gradient where the output is positive, else 0: twice multiplied, what is positive is 1 or more."""
    one = type(hidden)(1.0)
    return wp.cw_mul(grad, wp.min(wp.min(3.0e38 * hidden, one) * 3.0e38, one))


@wp.kernel
def _add_ray_relu_gpu(rays: wp.array[int], ray_hidden: wp.array[wp.vec4], hidden: wp.array[wp.vec4]):
    i = wp.tid()
    hidden[i] = _relu(hidden[i] + ray_hidden[16 * rays[i >> 4] + (i & 15)])


@wp.kernel
def _relu_backward_gpu(hidden: wp.array[wp.vec4], grad: wp.array[wp.vec4]):
    i = wp.tid()
    grad[i] = _relu_gradient(hidden[i], grad[i])


@wp.kernel
def _ray_relu_backward_gpu(
    starts: wp.array[int],
    first: int,
    end: int,
    hidden: wp.array[wp.vec4],
    grad: wp.array[wp.vec4],
    grad_of_rays: wp.array[wp.vec4],
):
    """Of samples ``first`` to ``end`` alone, whose hidden layers and gradients these are."""
    i = wp.tid()
    ray = i >> 4
    vector = i & 15
    last = wp.min(starts[ray + 1], end)
    total = wp.vec4(0.0)
    for begin in range(wp.max(starts[ray], first), last, _PARTIAL_SUM):
        partial = wp.vec4(0.0)
        for sample in range(begin, wp.min(begin + _PARTIAL_SUM, last)):
            entry = 16 * (sample - first) + vector
            passed = _relu_gradient(hidden[entry], grad[entry])
            grad[entry] = passed
            partial += passed
        total += partial
    grad_of_rays[i] = grad_of_rays[i] + total
