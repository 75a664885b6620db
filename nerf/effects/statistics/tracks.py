"""What photos show at the sparse points, and this in logarithms of linear light with its noise."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf.rendering.srgb_arrays import LINEAR_THRESHOLD, OFFSET, POWER, linear_light

MAX_IN_TRACK = 64  # observations of one point that enter a fit: their number of pairs is what a fit costs


@dataclass(frozen=True)
class TrackColours:
    """What the training photos show at the sparse points. Observation k: photo ``view[k]`` (index among the TRAINING
    views) sees ``point[k]``."""

    views: int
    view: Int[np.ndarray, "k"]
    point: Int[np.ndarray, "k"]
    colour: Float[np.ndarray, "k 3"]  # sRGB in [0, 1], mean over a small window
    saturated: Bool[np.ndarray, "k"]  # any channel near 1 in the window, or all near 0: not used in fits
    radius: Float[np.ndarray, "k"]  # from the principal point, half diagonals
    towards: Float[np.ndarray, "k 3"]  # unit vector from the point to the camera, scene frame
    distance: Float[np.ndarray, "k"]  # from the camera to the point, scene units
    footprint: Float[np.ndarray, "k"]  # width of a photo pixel at the point, scene units
    texture: Float[np.ndarray, "k"] | None = None  # deviation of grey values within the window; None: not measured

    def __len__(self) -> int:
        """How many observations there are."""
        return len(self.view)

    @classmethod
    def empty(cls, views: int) -> "TrackColours":
        """No point is known."""
        none, numbers = np.zeros(0, int), np.zeros(0)
        triples = np.zeros((0, 3))
        return cls(views, none, none, triples, np.zeros(0, bool), numbers, triples, numbers, numbers, numbers)

    def only(self, kept: Bool[np.ndarray, "k"] | Int[np.ndarray, "m"]) -> "TrackColours":
        """Some of the observations."""
        parts = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "views"}
        return replace(self, **{name: None if part is None else part[kept] for name, part in parts.items()})


def usable(tracks: TrackColours) -> Int[np.ndarray, "m"]:
    """The observations that fits use, in order of point, then view: unsaturated, of points that at least two photos
    show unsaturated, of each point at most MAX_IN_TRACK, evenly drawn."""
    kept = np.flatnonzero(~tracks.saturated)
    kept = kept[np.lexsort((tracks.view[kept], tracks.point[kept]))]
    rank, length = within_groups(tracks.point[kept])
    # the first observation of each of MAX_IN_TRACK equal parts of a long track
    part, before = rank * MAX_IN_TRACK // length, (rank - 1) * MAX_IN_TRACK // length
    drawn = (length <= MAX_IN_TRACK) | (part != before)
    other_view = np.zeros(len(kept), bool)
    if len(kept):
        view, start = tracks.view[kept], np.flatnonzero(rank == 0)
        spread = np.maximum.reduceat(view, start) - np.minimum.reduceat(view, start)
        other_view = (spread > 0)[np.cumsum(rank == 0) - 1]
    return kept[drawn & other_view]


def within_groups(labels: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Of each entry of sorted labels its place among those of its label, and how many these are."""
    _, start, count = np.unique(labels, return_index=True, return_counts=True)
    length = np.repeat(count, count)
    return np.arange(len(labels)) - np.repeat(start, count), length


def log_light(colour: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The natural logarithm of linear light; of black, that of half a step of 8 bits."""
    return np.log(linear_light(np.maximum(colour, 0.5 / 255)))


def log_noise(colour: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """What noise of 1 in an sRGB value is in the logarithm of its light: d ln(light) / ds, large where it is dark.

    Photos are nearly equally noisy at every sRGB value, for that is what their tone curve is made for; so are the
    differences that a window a little beside the point makes.
    """
    value = np.maximum(colour, 0.5 / 255)
    return np.where(value <= LINEAR_THRESHOLD, 1 / value, POWER / (value + OFFSET))
