"""Metres and compass directions for a reconstruction whose photos tell by GPS where they were taken.

The frame is ENU: x east, y north, z up along the ellipsoid's normal (WGS 84), metres, its origin amid the photos.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from nerf.geometry.alignment import align
from nerf.geometry.scene import Similarity
from stages.sfm.pairs.pair_selection import GPS_ERROR_M, cartesian

FEWEST_PLACES = 4  # three fix a similarity, the fourth tells whether it is right
FAR_OFF = 3.0  # times the median distance: a place so wrong is not averaged with the others
ROUNDS = 10
LARGEST_ERROR = 1 / 3  # of how far apart the places are: with more they have nothing to do with the photos
ONE_LINE = "they were taken along one line, which leaves open how the scene is turned about it"


@dataclass(frozen=True)
class Georeference:
    """``enu_from_sfm`` in metres, for the tangent plane at ``origin`` (degrees north and east, metres above the
    ellipsoid); how many places were ``used`` and how far off they are, in metres (median)."""

    enu_from_sfm: Similarity
    origin: tuple[float, float, float]
    used: int
    error_m: float

    def to_json(self) -> dict[str, Any]:
        """For registration.json."""
        latitude, longitude, altitude = self.origin
        return {
            "enu_from_sfm": self.enu_from_sfm.matrix().tolist(),
            "metres_per_unit": self.enu_from_sfm.scale,
            "origin": {"latitude": latitude, "longitude": longitude, "altitude_m": altitude},
            "photos": self.used,
            "error_m": self.error_m,
        }


def east_north_up(latitude: float, longitude: float) -> Float[np.ndarray, "3 3"]:
    """The rotation from Earth-centred axes to east, north and up at a place given in degrees."""
    phi, lam = np.radians([latitude, longitude])
    east = [-np.sin(lam), np.cos(lam), 0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    return np.array([east, north, up])


def georeference(
    centres: Float[np.ndarray, "n 3"], places: Sequence[tuple[float, float, float | None]]
) -> Georeference | str:
    """From the photos' centres in the sfm frame and their places (degrees north and east, metres), or why not.

    Places far off the rest are left out, round by round. Heights count where every photo has one.
    """
    if len(places) < FEWEST_PLACES:
        return f"{len(places)} registered photos tell where they were taken, {FEWEST_PLACES} are needed"
    latitude, longitude = np.array([place[:2] for place in places], float).T
    heights = [place[2] for place in places]
    altitude = np.zeros(len(places)) if None in heights else np.array(heights, float)
    earth = cartesian(latitude, longitude, altitude)
    middle = int(np.linalg.norm(earth - np.median(earth, axis=0), axis=1).argmin())
    origin = (float(latitude[middle]), float(longitude[middle]), float(altitude[middle]))
    enu = (earth - earth[middle]) @ east_north_up(*origin[:2]).T
    spread = float(np.linalg.norm(enu - np.median(enu, axis=0), axis=1).max())
    if spread < GPS_ERROR_M:
        return f"their places lie within {spread:.0f} m, and GPS errs by up to {GPS_ERROR_M:.0f} m"
    width = _across(centres)
    if _across(enu) < GPS_ERROR_M / 2 or not width * np.sqrt(len(centres)) > 1e-6 * np.abs(centres).max():
        return ONE_LINE
    fitted, kept = _robust(centres, enu)
    if fitted.scale * width < GPS_ERROR_M / 2:
        return ONE_LINE
    off = np.linalg.norm(fitted.points(centres) - enu, axis=1)
    error = float(np.median(off[kept]))
    if error > LARGEST_ERROR * spread:
        return f"their places, {spread:.0f} m apart, are {error:.0f} m off where the photos put them"
    return Georeference(fitted, origin, int(kept.sum()), error)


def _across(points: Float[np.ndarray, "n 3"]) -> float:
    """The standard deviation of points along the second of their principal axes: 0 on a line."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points)))


def _robust(
    centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]
) -> tuple[Similarity, Bool[np.ndarray, "n"]]:
    kept = np.ones(len(centres), bool)
    for _ in range(ROUNDS):
        fitted = align(centres[kept], enu[kept])
        off = np.linalg.norm(fitted.points(centres) - enu, axis=1)
        now = off <= max(FAR_OFF * float(np.median(off)), 1e-9)
        if (now == kept).all():
            break
        kept = now
    return align(centres[kept], enu[kept]), kept
