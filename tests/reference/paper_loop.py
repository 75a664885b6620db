"""The paper's renderer again, one sample at a time in float64: slow, plain, and sharing no code with nerf/.

It takes complex weights as well, so that Im f(w + ih)/h is the derivative to machine precision (the complex step);
where the method stops the gradient (placing the samples), it takes real parts.
"""

import itertools
import math

import numpy as np

Weights = dict[str, np.ndarray]


def encode(x: np.ndarray, frequencies: int) -> np.ndarray:
    """gamma of one point: all sines (coordinate by coordinate, frequency by frequency), then all cosines."""
    angles = [math.pi * math.fmod(2**k * c, 2) for c in x for k in range(frequencies)]
    return np.array([math.sin(a) for a in angles] + [math.cos(a) for a in angles])


def contract(x: np.ndarray) -> np.ndarray:
    r = max(abs(c) for c in x)
    return x if r <= 1 else (2 - 1 / r) * x / r


def to_ndc(x: np.ndarray, space: dict) -> np.ndarray:
    """Normalised device coordinates (appendix C) of a camera with our axes, in [-0.9, 0.9]³."""
    right, down, depth = np.array(space["axes"]) @ (x - space["apex"])
    return 0.9 * np.array([*(np.array([right, down]) / depth / space["slopes"]), 1 - 2 * space["near"] / depth])


def from_ndc(y: np.ndarray, space: dict) -> np.ndarray:
    """The scene point again."""
    depth = 2 * space["near"] / (1 - y[2] / 0.9)
    return np.array([*(y[:2] / 0.9 * space["slopes"] * depth), depth]) @ np.array(space["axes"]) + space["apex"]


def in_ndc(origin: np.ndarray, direction: np.ndarray, near: float, far: float, space: dict) -> tuple:
    """A ray between two scene points as the one between their images; of no length behind the near plane."""
    axis = np.array(space["axes"])[2]
    passes = (space["near"] - axis @ (origin - space["apex"])) / (axis @ direction)
    near, far = (max(near, passes), far) if axis @ direction > 0 else (near, min(far, passes))
    if near >= far:
        return np.zeros(3), np.zeros(3), 0.0, 0.0
    start, end = to_ndc(origin + near * direction, space), to_ndc(origin + far * direction, space)
    length = float(np.linalg.norm(end - start))
    return start, (end - start) / length, 0.0, length


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(np.real(x) > 0, x, 0)


def dense(weights: Weights, name: str, x: np.ndarray) -> np.ndarray:
    return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]


def field(weights: Weights, net: str, settings: dict, shift: float, point: np.ndarray, direction: np.ndarray) -> tuple:
    """Density and colour of one point seen along one direction."""
    x, d = (0.45 * contract(point) if settings["space"]["kind"] == "contraction" else point), 0.9 * direction
    if settings["positional_encoding"]:
        x, d = encode(x, settings["position_frequencies"]), encode(d, settings["direction_frequencies"])
    hidden = x
    for layer in range(settings["depth"]):
        if layer == settings["skip"] + 1:
            hidden = np.concatenate([hidden, x])
        hidden = relu(dense(weights, f"{net}.trunk.{layer}", hidden))
    raw = dense(weights, f"{net}.density_head", hidden)[0]
    sigma = relu(raw) if settings["density_activation"] == "relu" else np.log1p(np.exp(raw + shift))
    feature = dense(weights, f"{net}.feature", hidden)
    if settings["view_dependence"]:
        feature = np.concatenate([feature, d])
    colour = dense(weights, f"{net}.colour_head", relu(dense(weights, f"{net}.colour_hidden", feature)))
    return sigma, 1 / (1 + np.exp(-colour))


def composite(sigmas: list, colours: list, t: list[float], far: float, background: np.ndarray) -> tuple:
    """Colour, depth, opacity and weights of one ray (eq. 3), with delta_N = far - t_N and an explicit background."""
    depth, opacity, passed = 0, 0, 0
    colour, weights = np.zeros(3, complex), []
    for i, sigma in enumerate(sigmas):
        tau = sigma * ((t[i + 1] if i + 1 < len(t) else far) - t[i])
        weight = np.exp(-passed) * (1 - np.exp(-tau))
        colour, depth, opacity = colour + weight * colours[i], depth + weight * t[i], opacity + weight
        weights.append(weight)
        passed = passed + tau
    return colour + (1 - opacity) * background, depth + (1 - opacity) * far, opacity, weights


def invert_cdf(edges: list[float], weights: list[float], u: float) -> float:
    """The position below which a share u of the weight lies, by walking along the bins."""
    if sum(weights) == 0:
        weights = [1.0] * len(weights)
    left_over = u * sum(weights)
    for i, weight in enumerate(weights):
        if left_over < weight:
            return edges[i] + left_over / weight * (edges[i + 1] - edges[i])
        left_over -= weight
    return max(edges[i + 1] for i, weight in enumerate(weights) if weight > 0)


def box_interval(origin: np.ndarray, direction: np.ndarray, near: float, far: float, half: float) -> tuple:
    """The part of [near, far] inside the cube; (far, far) where there is none."""
    low, high = near, far
    for o, d in zip(origin, direction, strict=True):
        if d == 0:
            if abs(o) > half:
                return far, far
            continue
        a, b = sorted([(-half - o) / d, (half - o) / d])
        low, high = max(low, a), min(high, b)
    return (low, high) if low < high else (far, far)


def render(
    weights: Weights,
    settings: dict,
    shift: float,
    ray: tuple,
    background: np.ndarray,
    jitter: tuple[np.ndarray, np.ndarray],
) -> tuple:
    """Coarse and fine (colour, depth, opacity) of one ray (origin, direction, near, far).

    ``jitter`` are the positions within the bins, in [0, 1), of the first and of the second sampling.
    """
    scene_origin, towards, near, scene_far = ray
    origin, direction, far, space = scene_origin, towards, scene_far, settings["space"]
    if space["kind"] == "ndc":
        origin, direction, near, far = in_ndc(origin, direction, near, far, space)
    if space["kind"] != "contraction":
        near, far = box_interval(origin, direction, near, far, 0.95)

    def scene_distance(s: float) -> float:
        """How far along the ray in the scene."""
        if not direction.any():
            return scene_far
        at = origin + s * direction
        return towards @ ((from_ndc(at, space) if space["kind"] == "ndc" else at) - scene_origin)

    first, second = jitter
    t = []
    for i in range(len(first)):
        u = (i + first[i]) / len(first)
        t.append(near + u * (far - near) if settings["spacing"] == "linear" else near * (far / near) ** u)

    def along(net: str, t: list[float]) -> tuple:
        asked = [field(weights, net, settings, shift, origin + s * direction, towards) for s in t]
        distances, end = [scene_distance(s) for s in t], scene_distance(far)
        return composite([a[0] for a in asked], [a[1] for a in asked], distances, end, background)

    if not settings["hierarchical"]:
        only = along("fine", t)[:3]
        return only, only
    coarse = along("coarse", t)
    edges = [near] + [(a + b) / 2 for a, b in itertools.pairwise(t)] + [far]
    pdf = [float(np.real(w)) for w in coarse[3]]
    drawn = [invert_cdf(edges, pdf, (i + second[i]) / len(second)) for i in range(len(second))]
    return coarse[:3], along("fine", sorted(t + drawn))[:3]
