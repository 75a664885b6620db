"""Points with known colours in photos with known gains, noise and highlights: what a TrackColours would be."""

import numpy as np

from nerf.effects.statistics.tracks import TrackColours


def encoded(light: np.ndarray) -> np.ndarray:
    """Linear light as sRGB values, cut to [0, 1]."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def photographed_points(
    seed: int,
    views: int = 12,
    points: int = 400,
    per_point: int = 5,
    log_gain: np.ndarray | None = None,
    vignetting: float = 0.0,
    noise: float = 0.01,
    outliers: float = 0.0,
    gamma: np.ndarray | None = None,
) -> TrackColours:
    """Every point seen by ``per_point`` photos in a row, anywhere in them; ``log_gain`` (views,) or (views, 3).

    ``noise`` is of sRGB values; a share of ``outliers`` is as bright as a highlight.
    """
    draw = np.random.default_rng(seed)
    start = draw.integers(0, views, points)
    view = ((start[:, None] + np.arange(per_point)) % views).ravel()
    point = np.repeat(np.arange(points), per_point)
    gain = np.zeros((views, 3)) if log_gain is None else np.broadcast_to(log_gain.reshape(views, -1), (views, 3))
    power = np.ones(views) if gamma is None else gamma
    radius = np.sqrt(draw.random(len(view)))
    log_colour = np.log(draw.uniform(0.02, 0.6, (points, 3)))[point] * power[view, None]
    light = np.exp(log_colour + gain[view] + vignetting * radius[:, None] ** 2)
    light = np.where(draw.random(len(view))[:, None] < outliers, 0.85, light)
    colour = np.clip(encoded(light) + noise * draw.normal(size=light.shape), 0, 1)
    angle = 2 * np.pi * view / views + 0.05 * draw.normal(size=len(view))
    towards = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    saturated = np.asarray(((colour < 0.02) | (colour > 0.98)).any(axis=1))
    distance = 3 + draw.random(len(view))
    return TrackColours(
        views, view, point, colour, saturated, radius, towards, distance, distance / 500, np.full(len(view), 0.05)
    )
