"""Metres per unit of the sfm frame, by all that has a known length; what contradicts the rest is named and not used."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nerf.geometry.scene import Scene, View
from stages.contract import Inputs, Note, Progress, StageResult, listed
from stages.io.files import read_json, read_scene, write_json
from stages.io.pixels import load_pixels, loaders
from stages.scale.detection import cells_of, find_markers, locate_corners, luminance
from stages.scale.lengths import length_in_words, parse_length, parse_point
from stages.scale.marker_names import Marker, parse_marker
from stages.scale.square_fit import Sightings, Square, fit_square
from stages.sfm.colmap.cameras import focal_and_centre

if TYPE_CHECKING:
    from stages.scale import Config

DISTANCE_ERROR = 0.01  # of two points that somebody picked
READING_ERROR = 0.01  # of lengths read from a ruler or set in a printer: two that differ by less agree
MAX_STANDARD_ERRORS = 3.0  # between two lengths that agree
MAX_ERROR = 0.05  # of a scale that is worth having
MAX_IRREGULARITY = 0.04  # of a square: one that is cut off, bent or printed out of proportion has no one side
MIN_AGREEING = 2 / 3  # of the photos that show a marker, about its place
MIN_PRINT_ERROR = 0.001  # of any marker's side


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


def measure_scale(config: "Config", inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """The stage's work: look for the markers, weigh all references, write scale.json."""
    scene = read_scene(inputs["normalise"])
    references = [*_markers(config, scene, inputs["ingest"], progress), *_distance(config)]
    references = without_contradictions(references, progress)
    used = [reference for reference in references if reference.usable]
    gps = _gps(read_json(inputs["sfm"] / "registration.json")["georeference"], scene)
    if gps and used:
        _compare_with_gps(gps, combined(used)[0], progress)
    used = used or ([gps] if gps else [])
    metres, error = combined(used) if used else (None, None)
    facts = {"metres_per_unit": metres, "relative_error": error, "source": used[0].kind if used else None}
    known = [*references, gps] if gps else references
    write_json(folder / "scale.json", facts | {"references": [asdict(reference) for reference in known]})
    return StageResult(("scale.json",), _line(used, metres, error, asked=bool(references)), facts=facts)


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
    told = "; ".join(f"{one.name}: 1 unit = {_with_error(one)}" for one in usable)
    if group:
        odd = listed([one.name for one in usable if one not in group], 5)
        progress.note("scale.contradiction", f"{odd} contradicts the others and is not used ({told})")
    else:
        progress.note(
            "scale.no-agreement",
            f"no lengths are used, for they contradict each other ({told}): measure them again, or give one of them",
        )
    return [replace(one, problem="disagrees") if one.usable and one not in group else one for one in references]


def _agree(one: Reference, other: Reference) -> bool:
    assert one.metres_per_unit and other.metres_per_unit, "references that are usable have a length"
    apart = abs(math.log(one.metres_per_unit / other.metres_per_unit))
    return apart <= max(
        READING_ERROR, MAX_STANDARD_ERRORS * math.hypot(one.relative_error or 0.0, other.relative_error or 0.0)
    )


# --- markers


def _markers(config: "Config", scene: Scene, ingest: Path, progress: Progress) -> Iterator[Reference]:
    """What each marker says; what is wrong with one is noted."""
    markers = [parse_marker(marker) for marker in config.marker]
    if not markers:
        return
    sightings = _search(markers, scene, ingest, progress)
    mirrored = _mirrored([marker for marker in markers if not sightings[marker]], scene, ingest)
    for marker in markers:
        seen = sightings[marker]
        if not seen:
            yield _refused(marker, 0, MIRRORED if marker in mirrored else NOT_FOUND, progress)
        else:
            yield _measured(marker, seen, scene, progress)


class _Sighting(NamedTuple):
    """A marker in a view; ``times`` in this photo."""

    view: int
    corners: np.ndarray
    times: int


def _search(markers: Sequence[Marker], scene: Scene, ingest: Path, progress: Progress) -> dict[Marker, list[_Sighting]]:
    """Where each marker is seen, by views."""
    wanted = {(marker.dictionary, marker.number): marker for marker in markers}
    cells = {marker.dictionary: cells_of(marker.dictionary) for marker in markers}

    def search(index: int) -> list[tuple[Marker, _Sighting]]:
        view = scene.views[index]
        photo, camera = _photo(view, scene, ingest), scene.cameras[view.camera]
        found = [(d, each) for d in cells for each in find_markers(photo, d) if (d, each.number) in wanted]
        if not found:
            return []
        light, sightings = luminance(photo), []
        for dictionary, each in found:
            corners = locate_corners(light, each, cells[dictionary], camera)
            if corners is not None:
                times = sum((d, other.number) == (dictionary, each.number) for d, other in found)
                sightings.append((wanted[dictionary, each.number], _Sighting(index, corners, times)))
        return sightings

    seen: dict[Marker, list[_Sighting]] = {marker: [] for marker in markers}
    with ThreadPoolExecutor(loaders(ingest / view.file for view in scene.views)) as pool:
        for done, sightings in enumerate(pool.map(search, range(len(scene.views)))):
            for marker, sighting in sightings:
                seen[marker].append(sighting)
            progress.update("markers in the photos", done / len(scene.views))
    return seen


def _photo(view: View, scene: Scene, ingest: Path) -> np.ndarray:
    camera = scene.cameras[view.camera]
    return load_pixels(ingest / view.file, camera.width, camera.height)


def _mirrored(missing: Sequence[Marker], scene: Scene, ingest: Path) -> set[Marker]:
    """Those of some markers whose mirror images are in the photos. These are decoded once more for it: a marker that no
    photo shows is rare, and looking for mirror images takes as long in every photo as looking for markers."""
    found = set[Marker]()
    for view in scene.views:
        if len(found) == len(missing):
            break
        photo = _photo(view, scene, ingest)
        for dictionary in {marker.dictionary for marker in missing}:
            here = {(dictionary, each.number) for each in find_markers(photo, dictionary, mirrored=True)}
            found |= {marker for marker in missing if (marker.dictionary, marker.number) in here}
    return found


def _measured(marker: Marker, seen: Sequence[_Sighting], scene: Scene, progress: Progress) -> Reference:
    """What a marker says that is seen somewhere."""
    photos = len({sighting.view for sighting in seen})
    if photos < 2:
        return _refused(marker, photos, ONE_PHOTO, progress)
    if any(sighting.times > 1 for sighting in seen):
        return _refused(marker, photos, REPEATED, progress)
    square = fit_square(_sightings(seen, scene))
    if square is None or square.agreeing.mean() < MIN_AGREEING:
        return _refused(marker, photos, SEVERAL_PLACES, progress)
    error = square.standard_error / square.side
    if not error < MAX_ERROR:
        return _refused(marker, photos, UNCERTAIN, progress)
    if square.irregularity > max(MAX_IRREGULARITY, MAX_STANDARD_ERRORS * error):
        return _refused(marker, photos, NOT_SQUARE, progress)
    return _reference(marker, square, error, scene)


def _sightings(seen: Sequence[_Sighting], scene: Scene) -> Sightings:
    views = [scene.views[sighting.view] for sighting in seen]
    rotations = np.stack([view.scene_from_camera[:, :3].T for view in views])
    centres = np.stack([view.scene_from_camera[:, 3] for view in views])
    translations = -(rotations @ centres[..., None])
    focal = np.array([focal_and_centre(scene.cameras[view.camera])[0] for view in views])
    return Sightings(np.concatenate([rotations, translations], axis=2), np.stack([s.corners for s in seen]), focal)


def _reference(marker: Marker, square: Square, error: float, scene: Scene) -> Reference:
    sfm_from_scene = scene.scene_from_sfm.inverse()
    metres_per_unit = marker.side_m / (square.side * sfm_from_scene.scale)
    corners = sfm_from_scene.points(square.corners).tolist()
    return Reference("marker", marker.name, metres_per_unit, error, int(square.agreeing.sum()), None, corners)


NOT_FOUND = Note(
    "scale.not-found",
    "no photo shows it well enough to read it: it should lie flat, in a white margin one cell wide, and be 30 pixels "
    "wide or wider in several photos",
)
MIRRORED = Note(
    "scale.mirrored", "the photos show its mirror image: print it as it is, or give photos that are not mirrored"
)
ONE_PHOTO = Note("scale.one-photo", "only one photo shows it, and it takes two from different places")
REPEATED = Note("scale.repeated", "a photo shows it twice: print each marker once")
SEVERAL_PLACES = Note(
    "scale.several-places", "the photos disagree about where it is: it was moved, or printed more than once"
)
UNCERTAIN = Note(
    "scale.uncertain", f"its side is known to no better than {MAX_ERROR:.0%}: show it larger, and from more places"
)
NOT_SQUARE = Note("scale.not-square", "its four sides differ: it is cut off, bent, or printed out of proportion")


def _refused(marker: Marker, photos: int, problem: Note, progress: Progress) -> Reference:
    told = problem._replace(text=f"marker {marker.name} is not used: {problem.text}")
    progress.note(*told)
    return Reference("marker", marker.name, photos=photos, problem=problem.code.removeprefix("scale."))


# --- a distance, GPS


def _distance(config: "Config") -> Iterator[Reference]:
    if config.distance is not None:
        start, end, length = config.distance
        units = math.dist(parse_point(start), parse_point(end))
        yield Reference("distance", "the distance", parse_length(length) / units, DISTANCE_ERROR)


def _gps(georeference: dict[str, Any] | None, scene: Scene) -> Reference | None:
    """What GPS says: its positions' error over how far the photos spread, by the square root of their number."""
    if georeference is None:
        return None
    metres, photos = georeference["metres_per_unit"], georeference["photos"]
    centres = np.stack([view.scene_from_camera[:, 3] for view in scene.views]) / scene.scene_from_sfm.scale
    spread = metres * math.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean())
    return Reference("gps", "GPS", metres, georeference["error_m"] / (spread * math.sqrt(photos)), photos)


def _compare_with_gps(gps: Reference, metres: float, progress: Progress) -> None:
    assert gps.metres_per_unit and gps.relative_error
    apart = abs(math.log(gps.metres_per_unit / metres))
    if apart > max(MAX_ERROR, MAX_STANDARD_ERRORS * gps.relative_error):
        progress.note(
            "scale.gps-disagrees",
            f"GPS says 1 unit = {_with_error(gps)}, {apart:.0%} off what the given lengths say: the lengths are used",
        )


def _with_error(reference: Reference) -> str:
    assert reference.metres_per_unit
    return _in_words(reference.metres_per_unit, reference.relative_error or 0)


def _in_words(metres: float, relative_error: float) -> str:
    """A unit's length with two standard errors."""
    return f"{length_in_words(metres)} ± {100 * 2 * relative_error:.2g} %"


def _line(used: Sequence[Reference], metres: float | None, error: float | None, asked: bool) -> str:
    if metres is None or error is None:
        return "unknown: none of the lengths given can be used" if asked else "unknown: lengths are in scene units"
    markers = sum(reference.kind == "marker" for reference in used)
    kinds = {"marker": f"{markers} marker{'s' * (markers > 1)}", "distance": "the distance given", "gps": "GPS"}
    sources = " and ".join(dict.fromkeys(kinds[reference.kind] for reference in used))
    return f"1 unit = {_in_words(metres, error)} by {sources}"
