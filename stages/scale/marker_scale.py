"""Metres per unit by printed markers: each is looked for in the photos, and its square fitted to all that show it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nerf.geometry.scene import Scene, View
from stages.contract import Note, Progress, listed
from stages.io.pixels import load_pixels, loaders
from stages.scale.marker_detection import cells_of, find_markers, locate_corners, luminance, printed_markers
from stages.scale.marker_names import Marker, parse_marker
from stages.scale.references import MAX_STANDARD_ERRORS, Reference
from stages.scale.square_fit import CornerObservations, Square, fit_square
from stages.sfm.colmap.cameras import mean_focal_and_centre

if TYPE_CHECKING:
    from stages.scale import Config

MAX_ERROR = 0.05  # of a scale that is worth having
MAX_IRREGULARITY = 0.04  # of a square: one that is cut off, bent or printed out of proportion has no one side
# Of a square's irregularity, the standard error that it means: the length given is that of one side, and the fitted one
# lies half-way between the shortest and the longest.
IRREGULARITY_ERROR = 1 / 3
MIN_AGREEING = 2 / 3  # of the photos that show a marker, about its place
MAX_REPEATED = 1 / 3  # of the photos that show a marker, more than once each: these are left out
MAX_PHOTOS_FOR_OTHERS = 40  # looked through for markers that nobody asked for
MIN_PHOTOS_OF_OTHERS = 3  # that show a marker that nobody asked for: one or two may show what only looks like one


def marker_references(config: "Config", scene: Scene, ingest: Path, progress: Progress) -> Iterator[Reference]:
    """What each marker says; what is wrong with one is noted."""
    markers = [parse_marker(marker) for marker in config.marker]
    if not markers:
        return
    detections = _search(markers, scene, ingest, progress)
    missing = [marker for marker in markers if not detections[marker]]
    why = _why_missing(missing, markers, scene, ingest, progress)
    for marker in markers:
        if marker in why:
            yield _unusable(marker, 0, why[marker], progress)
        else:
            yield _measured(marker, detections[marker], scene, progress)


class _Detection(NamedTuple):
    """A marker in a view; ``times`` in this photo."""

    view: int
    corners: np.ndarray
    times: int


def _search(
    markers: Sequence[Marker], scene: Scene, ingest: Path, progress: Progress
) -> dict[Marker, list[_Detection]]:
    """Where each marker is seen, by views."""
    wanted = {(marker.dictionary, marker.number): marker for marker in markers}
    cells = {marker.dictionary: cells_of(marker.dictionary) for marker in markers}

    def search(index: int) -> list[tuple[Marker, _Detection]]:
        view = scene.views[index]
        photo, camera = _photo(view, scene, ingest), scene.cameras[view.camera]
        found = [(d, each) for d in cells for each in find_markers(photo, d) if (d, each.number) in wanted]
        if not found:
            return []
        light, detections = luminance(photo), []
        for dictionary, each in found:
            corners = locate_corners(light, each, cells[dictionary], camera)
            if corners is not None:
                times = sum((d, other.number) == (dictionary, each.number) for d, other in found)
                detections.append((wanted[dictionary, each.number], _Detection(index, corners, times)))
        return detections

    seen: dict[Marker, list[_Detection]] = {marker: [] for marker in markers}
    with ThreadPoolExecutor(loaders(ingest / view.file for view in scene.views)) as pool:
        for done, detections in enumerate(pool.map(search, range(len(scene.views)))):
            for marker, detection in detections:
                seen[marker].append(detection)
            progress.update("markers in the photos", done / len(scene.views))
    return seen


def _photo(view: View, scene: Scene, ingest: Path) -> np.ndarray:
    camera = scene.cameras[view.camera]
    return load_pixels(ingest / view.file, camera.width, camera.height)


def _why_missing(
    missing: Sequence[Marker], markers: Sequence[Marker], scene: Scene, ingest: Path, progress: Progress
) -> dict[Marker, Note]:
    """Why no photo shows some of the ``markers``: their mirror images are in the photos, or others. The photos are
    decoded once more for it: a marker that no photo shows is rare, and looking for mirror images takes as long in every
    photo as looking for markers. Looking for markers of all dictionaries takes eight times as long, and some photos
    tell."""
    if not missing:
        return {}
    some = {view.file for view in scene.views[:: -(-len(scene.views) // MAX_PHOTOS_FOR_OTHERS)]}

    def search(view: View) -> tuple[set[Marker], set[str]]:
        photo, mirrored = _photo(view, scene, ingest), set[Marker]()
        for dictionary in {marker.dictionary for marker in missing}:
            here = {(dictionary, each.number) for each in find_markers(photo, dictionary, mirrored=True)}
            mirrored |= {marker for marker in missing if (marker.dictionary, marker.number) in here}
        return mirrored, printed_markers(photo) if view.file in some else set()

    mirrored, others = set[Marker](), Counter[str]()
    with ThreadPoolExecutor(loaders(ingest / view.file for view in scene.views)) as pool:
        for done, (mirrored_here, others_here) in enumerate(pool.map(search, scene.views)):
            mirrored |= mirrored_here
            others.update(others_here - {marker.printed for marker in markers})
            progress.update("other markers in the photos", done / len(scene.views))
    shown = [name for name, photos in others.most_common() if photos >= MIN_PHOTOS_OF_OTHERS]
    otherwise = _others_shown(shown) if shown else NOT_FOUND
    return {marker: MIRRORED if marker in mirrored else otherwise for marker in missing}


def _measured(marker: Marker, seen: Sequence[_Detection], scene: Scene, progress: Progress) -> Reference:
    """What a marker says that is seen somewhere."""
    photos = len({detection.view for detection in seen})
    if photos < 2:
        return _unusable(marker, photos, ONE_PHOTO, progress)
    once = [detection for detection in seen if detection.times == 1]
    if photos - len(once) > MAX_REPEATED * photos:
        return _unusable(marker, photos, REPEATED, progress)
    square = fit_square(_corner_observations(once, scene))
    if square is None or square.agreeing.mean() < MIN_AGREEING:
        return _unusable(marker, photos, SEVERAL_PLACES, progress)
    error = square.standard_error / square.side
    if not error < MAX_ERROR:
        return _unusable(marker, photos, UNCERTAIN, progress)
    if square.irregularity > max(MAX_IRREGULARITY, MAX_STANDARD_ERRORS * error):
        return _unusable(marker, photos, NOT_SQUARE, progress)
    return _reference(marker, square, max(error, IRREGULARITY_ERROR * square.irregularity), scene)


def _corner_observations(seen: Sequence[_Detection], scene: Scene) -> CornerObservations:
    views = [scene.views[detection.view] for detection in seen]
    rotations = np.stack([view.scene_from_camera[:, :3].T for view in views])
    centres = np.stack([view.scene_from_camera[:, 3] for view in views])
    translations = -(rotations @ centres[..., None])
    focal = np.array([mean_focal_and_centre(scene.cameras[view.camera])[0] for view in views])
    return CornerObservations(
        np.concatenate([rotations, translations], axis=2), np.stack([s.corners for s in seen]), focal
    )


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
REPEATED = Note("scale.repeated", "photos show it twice: print each marker once")
SEVERAL_PLACES = Note(
    "scale.several-places", "the photos disagree about where it is: it was moved, or printed more than once"
)
UNCERTAIN = Note(
    "scale.uncertain", f"its side is known to no better than {MAX_ERROR:.0%}: show it larger, and from more places"
)
NOT_SQUARE = Note("scale.not-square", "its four sides differ: it is cut off, bent, or printed out of proportion")


def _others_shown(names: Sequence[str]) -> Note:
    text = f"no photo shows it, but photos show {listed(names, 5)}: give the dictionary and the number that you printed"
    return Note("scale.other-markers", text)


def _unusable(marker: Marker, photos: int, problem: Note, progress: Progress) -> Reference:
    told = problem._replace(text=f"marker {marker.name} is not used: {problem.text}")
    progress.note(*told)
    return Reference("marker", marker.name, photos=photos, problem=problem.code.removeprefix("scale."))
