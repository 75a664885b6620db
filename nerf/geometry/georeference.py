"""Metres and compass directions for a reconstruction whose photos tell by GPS where they were taken.

The frame is ENU: x east, y north, z up along the ellipsoid's normal (WGS 84), metres, its origin amid the photos.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from nerf.geometry.alignment import align
from nerf.geometry.scene import Similarity

GPS_ERROR_M = 10.0  # twice the 4.9 m that phones reach under open sky (gps.gov, GPS accuracy)
EARTH_AXES_M = (6_378_137.0, 6_356_752.314)  # WGS 84
MIN_POSITIONS = 4  # three fix a similarity, the fourth tells whether it is right
OUTLIER_FACTOR = 3.0  # times the median distance: positions so wrong are not averaged with the others
MAX_TRIMMING_ROUNDS = 10
TRIPLES = 300  # of positions; where 40 % are wrong every fifth is right
MIN_WIDTH = 1e-6  # of the centres' coordinates: less across their line is what rounding leaves of them
EXACT_M = 1e-9  # off by less no position is an outlier: where all are exact, rounding is
MAX_ERROR = 1 / 3  # of how far apart the positions are: with more they have nothing to do with the photos
ONE_LINE = "the photos were taken along one line, so the rotation about that line is unknown"


@dataclass(frozen=True)
class Georeference:
    """``enu_from_sfm`` in metres, for the tangent plane at ``origin`` (degrees north and east, metres above the
    ellipsoid); how many positions were ``used`` and how far off they are, in metres (median)."""

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


def cartesian(
    latitude: Float[np.ndarray, "n"], longitude: Float[np.ndarray, "n"], altitude: Float[np.ndarray, "n"] | None
) -> Float[np.ndarray, "n 3"]:
    """Metres from the centre of the Earth (WGS 84), from degrees and metres: no seam at the date line or a pole."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    height = np.zeros_like(phi) if altitude is None else altitude
    long_axis, short_axis = EARTH_AXES_M
    flat = (short_axis / long_axis) ** 2
    normal = long_axis / np.sqrt(np.cos(phi) ** 2 + flat * np.sin(phi) ** 2)
    around = (normal + height) * np.cos(phi)
    return np.stack([around * np.cos(lam), around * np.sin(lam), (flat * normal + height) * np.sin(phi)], axis=1)


def east_north_up(latitude: float, longitude: float) -> Float[np.ndarray, "3 3"]:
    """The rotation from Earth-centred axes to east, north and up at a position given in degrees."""
    phi, lam = np.radians([latitude, longitude])
    east = [-np.sin(lam), np.cos(lam), 0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    return np.array([east, north, up])


def georeference(
    centres: Float[np.ndarray, "n 3"], positions: Sequence[tuple[float, float, float | None]]
) -> Georeference | str:
    """From the photos' centres in the sfm frame and their GPS positions (degrees north and east, metres), or why not.

    Positions far off the rest are left out, round by round. Where at least half of them have heights, the others are
    left out, too; else no height counts.
    """
    high = [position[2] is not None for position in positions]
    if sum(high) >= max(MIN_POSITIONS, len(high) / 2):
        centres, positions = centres[high], [position for position in positions if position[2] is not None]
    if len(positions) < MIN_POSITIONS:
        return f"{len(positions)} registered photos have a GPS position, and it takes {MIN_POSITIONS}"
    latitude, longitude = np.array([position[:2] for position in positions], float).T
    heights = [position[2] for position in positions]
    altitude = np.zeros(len(positions)) if None in heights else np.array(heights, float)
    earth = cartesian(latitude, longitude, altitude)
    middle = int(np.linalg.norm(earth - np.median(earth, axis=0), axis=1).argmin())
    origin = (float(latitude[middle]), float(longitude[middle]), float(altitude[middle]))
    enu = (earth - earth[middle]) @ east_north_up(*origin[:2]).T
    if (spread := _spread(enu)) < GPS_ERROR_M:
        return _too_close(spread)
    width = _across(centres)
    if _across(enu) < GPS_ERROR_M / 2 or not width * np.sqrt(len(centres)) > MIN_WIDTH * np.abs(centres).max():
        return ONE_LINE
    try:
        fitted, kept = _robust(centres, enu)
    except ValueError:  # the outliers alone lay beside the line
        return ONE_LINE
    if min(fitted.scale * width, _across(enu[kept])) < GPS_ERROR_M / 2:
        return ONE_LINE
    if (spread := _spread(enu[kept])) < GPS_ERROR_M:
        return _too_close(spread)
    error = float(np.median(_distances(fitted, centres, enu)[kept]))
    if error > MAX_ERROR * spread:
        return f"the GPS positions span {spread:.0f} m and are {error:.0f} m off the reconstruction"
    return Georeference(fitted, origin, int(kept.sum()), error)


def _spread(points: Float[np.ndarray, "n 3"]) -> float:
    """How far from their middle the farthest is."""
    return float(np.linalg.norm(points - np.median(points, axis=0), axis=1).max())


def _too_close(spread: float) -> str:
    return f"the positions lie within {spread:.0f} m, and GPS errs by up to {GPS_ERROR_M:.0f} m"


def _across(points: Float[np.ndarray, "n 3"]) -> float:
    """The standard deviation of points along the second of their principal axes: 0 on a line."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points)))


def _robust(
    centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]
) -> tuple[Similarity, Bool[np.ndarray, "n"]]:
    """The similarity without outliers, and who is none. Raises ValueError where these lie on one line.

    Trimming begins with all positions, and with what three of them say that most others agree with: a few that a phone
    kept from elsewhere are so far off that a fit to all follows them.
    """
    starts = [np.ones(len(centres), bool), _most_agreed(centres, enu)]
    found = [_trimmed(centres, enu, kept) for kept in starts]
    return min(found, key=lambda fit: np.median(_distances(fit[0], centres, enu)))


def _trimmed(
    centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"], kept: Bool[np.ndarray, "n"]
) -> tuple[Similarity, Bool[np.ndarray, "n"]]:
    for _ in range(MAX_TRIMMING_ROUNDS):
        now = _near(align(centres[kept], enu[kept]), centres, enu)
        if (now == kept).all():
            break
        kept = now
    return align(centres[kept], enu[kept]), kept


def _most_agreed(centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Those near the similarity by three positions whose median distance to all is least (least median of squares:
    Rousseeuw 1984); all, where any three lie on one line."""
    random, fits = np.random.default_rng(0), list[Similarity]()
    for _ in range(TRIPLES):
        three = random.choice(len(centres), 3, replace=False)
        with suppress(ValueError):
            fits.append(align(centres[three], enu[three]))
    if not fits:
        return np.ones(len(centres), bool)
    return _near(min(fits, key=lambda fit: np.median(_distances(fit, centres, enu))), centres, enu)


def _distances(
    fitted: Similarity, centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """How far the positions are off, in metres."""
    return np.linalg.norm(fitted.points(centres) - enu, axis=1)


def _near(
    fitted: Similarity, centres: Float[np.ndarray, "n 3"], enu: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Which positions are no outliers."""
    off = _distances(fitted, centres, enu)
    return off <= max(OUTLIER_FACTOR * float(np.median(off)), EXACT_M)
