"""What has a known length: what each reference says of metres per unit, and which of them contradict the others."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from nerf.geometry.scene import Scene
from stages.contract import Note, Progress, listed
from stages.scale.lengths import length_in_words, parse_length, parse_point

if TYPE_CHECKING:
    from stages.scale import Config

DISTANCE_ERROR = 0.01  # of two points that somebody picked
MAX_REACH = 2.0  # of such a point from the origin of the scene, in that of the farthest camera or sparse point
MIN_DISTANCE = 0.002  # of two such points, in scene units: a thousandth of the region's side; nobody picks to 1 % of it
READING_ERROR = 0.01  # of lengths read from a ruler or set in a printer: two that differ by less agree
MAX_STANDARD_ERRORS = 3.0  # between two lengths that agree
MIN_PRINT_ERROR = 0.001  # of any marker's side
MAX_GPS_ERROR = 0.25  # two standard errors: with more a volume may be twice what it is said to be, or less than half


@dataclass(frozen=True)
class Reference:
    """What one marker, the distance, or GPS says: metres a unit of the sfm frame with its relative standard error, from
    so many photos. ``problem`` is the code of why it is not used, None where it is. ``corners`` are a marker's, in the
    sfm frame."""

    kind: str
    name: str
    metres_per_unit: float | None = None
    relative_error: float | None = None
    photos: int | None = None
    problem: str | None = None
    corners: list[list[float]] | None = None

    @property
    def usable(self) -> bool:
        """Whether nothing is against it."""
        return self.problem is None


def combined(references: Sequence[Reference]) -> tuple[float, float]:
    """Metres per unit and its relative standard error: the mean weighted by variances, its error widened where the
    references scatter by more than their own errors allow (Birge 1932)."""
    logs = np.log([reference.metres_per_unit or math.nan for reference in references])
    errors = np.maximum([reference.relative_error or 0.0 for reference in references], MIN_PRINT_ERROR)
    weights = errors**-2.0
    mean = float((weights * logs).sum() / weights.sum())
    scatter = float((weights * (logs - mean) ** 2).sum()) / max(1, len(logs) - 1)
    return math.exp(mean), float(weights.sum() ** -0.5) * math.sqrt(max(1.0, scatter))


def without_contradictions(references: Sequence[Reference], progress: Progress) -> list[Reference]:
    """The references, those marked and named that contradict most others; all where no majority agrees."""
    usable = [reference for reference in references if reference.usable]
    if len(usable) < 2:
        return list(references)
    agreeing = [[other for other in usable if _agree(one, other)] for one in usable]
    largest = max(agreeing, key=len)
    group = largest if len(largest) > len(usable) / 2 else []
    if len(group) == len(usable):
        return list(references)
    told = "; ".join(f"{one.name}: 1 unit = {with_error(one)}" for one in usable)
    if group:
        odd = listed([one.name for one in usable if one not in group], 5)
        progress.note("scale.contradiction", f"{odd} contradicts the others and is not used ({told})")
    else:
        progress.note(
            "scale.no-agreement",
            f"no lengths are used, because they contradict each other ({told}): measure them again, or give only one",
        )
    return [replace(one, problem="disagrees") if one.usable and one not in group else one for one in references]


def _agree(one: Reference, other: Reference) -> bool:
    assert one.metres_per_unit and other.metres_per_unit, "references that are usable have a length"
    apart = abs(math.log(one.metres_per_unit / other.metres_per_unit))
    return apart <= max(
        READING_ERROR, MAX_STANDARD_ERRORS * math.hypot(one.relative_error or 0.0, other.relative_error or 0.0)
    )


def distance_references(
    config: "Config", scene: Scene, sparse: Float[np.ndarray, "n 3"], progress: Progress
) -> Iterator[Reference]:
    """What the distance between two given points says, where one is given; ``sparse`` points are in the scene frame."""
    if config.distance is None:
        return
    start, end, length = config.distance
    problem = _why_nobody_picked(start, end, scene, sparse)
    if problem is None:
        units = math.dist(parse_point(start), parse_point(end))
        yield Reference("distance", "the distance", parse_length(length) / units, DISTANCE_ERROR)
    else:
        progress.note(*problem._replace(text=f"the distance is not used: {problem.text}"))
        yield Reference("distance", "the distance", problem=problem.code.removeprefix("scale."))


def _why_nobody_picked(start: str, end: str, scene: Scene, sparse: Float[np.ndarray, "n 3"]) -> Note | None:
    """Why nobody can have picked two points in a mesh or point cloud of the scene."""
    centres = [view.scene_from_camera[:, 3] for view in scene.views]
    reach = MAX_REACH * max(1.0, float(np.linalg.norm([*centres, *sparse], axis=1).max()))
    points = {text: scene.scene_from_sfm.points(np.array(parse_point(text))) for text in (start, end)}
    outside = " and ".join(text for text, point in points.items() if not math.hypot(*point) <= reach)
    if outside:
        where = f"{outside} lies far from all that the photos show"
        return Note("scale.point-outside", f"{where}: give points in the frame of output/transforms.json")
    if math.dist(*points.values()) < MIN_DISTANCE:
        return Note("scale.points-too-near", "its points lie too near each other: give points that lie farther apart")
    return None


def gps_reference(georeference: dict[str, Any] | None, scene: Scene) -> Reference | None:
    """What GPS says: its positions' error over how far the photos spread, by the square root of their number. Not to be
    used where that is above MAX_GPS_ERROR."""
    if georeference is None:
        return None
    metres, photos = georeference["metres_per_unit"], georeference["photos"]
    centres = np.stack([view.scene_from_camera[:, 3] for view in scene.views]) / scene.scene_from_sfm.scale
    spread = metres * math.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean())
    error = georeference["error_m"] / (spread * math.sqrt(photos))
    problem = None if 2 * error <= MAX_GPS_ERROR else "gps-inexact"
    return Reference("gps", "GPS", metres, error, photos, problem)


def with_error(reference: Reference) -> str:
    """Its unit's length with two standard errors."""
    assert reference.metres_per_unit
    return in_words(reference.metres_per_unit, reference.relative_error or 0)


def in_words(metres: float, relative_error: float) -> str:
    """A unit's length with two standard errors."""
    return f"{length_in_words(metres)} ± {100 * 2 * relative_error:.2g}%"
