"""By what factor the focal lengths of given cameras have to be longer. Nothing in a file tells a focal length of photos
of another size or of another camera, but its photos do: their verified matches fit the poses under the right one alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stages.sfm.pose_check import PairMatches, median_error_px

FACTORS = np.geomspace(0.4, 2.5, 37)  # 5 % apart
FINER = np.geomspace(0.95, 1.05, 21)  # 0.5 % apart
MIN_GAIN = 3.0  # times smaller has the error to become: a factor also makes up for a little of other mistakes
MIN_CHANGE = 0.02  # of a focal length


class FocalFit(NamedTuple):
    """The factor, and the median error of the matches with it in pixels."""

    factor: float
    error_px: float


def fitting_focal_factor(matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"]) -> FocalFit | None:
    """The factor for all focal lengths alike with which the poses fit the matches best; None where that is not clearly
    better than with focal lengths as they are."""

    def best_of(factors: Float[np.ndarray, "n"]) -> FocalFit:
        fits = [FocalFit(factor, median_error_px(_scaled(matches, factor), world_from_camera)) for factor in factors]
        return min(fits, key=lambda fit: fit.error_px)

    best = best_of(best_of(FACTORS).factor * FINER)
    is_clear = MIN_GAIN * best.error_px <= median_error_px(matches, world_from_camera)
    return best if is_clear and abs(best.factor - 1) >= MIN_CHANGE else None


def _scaled(matches: PairMatches, factor: float) -> PairMatches:
    """The same pixels seen through lenses so many times as long: their rays lie nearer to the axis. Distortion stays as
    it is in the picture."""
    rays = matches.ray_direction * [1.0, 1.0, factor]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return matches._replace(ray_direction=rays, focal_px=matches.focal_px * factor)
