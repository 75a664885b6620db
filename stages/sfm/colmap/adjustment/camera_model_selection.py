"""Which camera model the photos call for, by the error of observations that were held out. Call it in a worker process.

Every candidate adjusts cameras, poses and points to most observations and predicts the others. The simplest one is
chosen whose error exceeds the best one's by no more than the noise of the comparison, or by next to nothing. A camera
model that is too simple bends the poses; one that is too rich fits noise, and bends them too.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from stages.contract import Note
from stages.io.amounts import counted
from stages.sfm.colmap.adjustment.bundle_adjustment import adjustment_options, bundle_adjust
from stages.sfm.colmap.adjustment.intrinsics import (
    CAMERA_MODELS,
    CameraModelCandidate,
    degenerate_cameras,
    set_camera_models,
)
from stages.sfm.colmap.adjustment.observations import Observations, noise_px, observations, residuals, shared_points
from stages.sfm.pairs.match_graph import most_linked

# Points for the comparison are drawn until they have so many observations: 14 candidates then take seconds.
MAX_OBSERVATIONS = 20_000
MAX_PHOTOS = 150  # for each camera, those that share most points: more make the comparison longer and no surer
MAX_OBSERVATIONS_PER_IMAGE = 100  # where there are hundreds of photos it takes more: a pose alone has 6 unknowns
MIN_HELD_OUT = 50  # the spread of so many is known to a tenth, 1/√(2 · 50); fewer are no evidence
CAP_PX = 4.0  # what is farther off is a mismatch, as for COLMAP's own filter, and counts as this
CELLS_ACROSS = 4  # neighbours in a photo err alike, so the noise is that of the means of 4 × 4 parts of each photo
MAX_ITERATIONS = 50
# Of the photos, that may have degenerate cameras: these are put right in the end, and decide for no others.
MAX_DEGENERATE_FRACTION = 0.2
# A bend of a twentieth of the observations' noise adds a thousandth to their error. Many observations tell less than
# that from chance, and it means nothing.
MIN_WORSE = 0.001
NOISE_MULTIPLES = 3.0  # with a dozen candidates two standard errors are often exceeded by chance, three hardly ever


class CandidateResult(NamedTuple):
    """How a candidate did."""

    candidate: CameraModelCandidate
    error_px: Float[np.ndarray, "n"]  # of each held-out observation
    noise_px: float  # of the observations it was adjusted to
    why_degenerate: str | None  # of one of its cameras, where more than a few photos have such


class Selection(NamedTuple):
    """The comparison for some cameras: the result of the candidate that they take, None if there is none."""

    cameras: list[int]
    photos: int
    chosen: CandidateResult | None
    rows: list[dict[str, Any]]
    why: str


@dataclass
class CameraModels:
    """The model of every camera that has photos, by its id, and why: a table's rows and sentences."""

    noise_px: float
    chosen: dict[int, CameraModelCandidate] = field(default_factory=dict)
    table: list[dict[str, Any]] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)


def choose(mapped: pycolmap.Reconstruction, seed: int, camera_models: Sequence[str] = CAMERA_MODELS) -> CameraModels:
    """The model of every camera, one of these.

    A camera is judged by its own photos alone where they share enough points, and the others all together, each
    candidate being adjusted to all of them. Cameras that come out alike so are judged once more, together, since more
    observations tell finer differences. Where evidence is too little, cameras stay as mapping had them.
    """
    cameras = sorted({mapped.image(i).camera_id for i in mapped.reg_image_ids()})
    noise = noise_px(mapped, observations(mapped))
    selections = [_select(mapped, group, seed, camera_models, noise) for group in _groups(mapped, cameras)]
    judged = [selection for selection in selections if selection.chosen]
    if len(judged) > 1 and len({selection.chosen.candidate for selection in judged if selection.chosen}) == 1:
        alike = sorted(camera for selection in judged for camera in selection.cameras)
        rest = [selection for selection in selections if not selection.chosen]
        selections = [_select(mapped, alike, seed, camera_models, noise), *rest]
    largest = max((one for one in selections if one.chosen), key=lambda one: one.photos, default=None)
    choice = CameraModels(largest.chosen.noise_px if largest and largest.chosen else noise)
    for index, (group, photos, chosen, rows, why) in enumerate(selections):
        candidate = chosen.candidate if chosen else CameraModelCandidate(mapped.camera(group[0]).model_name, False)
        choice.chosen |= dict.fromkeys(group, candidate)
        choice.table += [row | {"group": index, "photos": photos} for row in rows]
        whose = f"{counted(photos)}: " if len(selections) > 1 else ""
        given = " as given" if len(camera_models) == 1 else ""
        which = f"camera model {candidate.model}{given}, principal point {candidate.principal_point_state}"
        choice.notes.append(Note("sfm.camera-model", f"{whose}{which}: {why}"))
    return choice


def _select(
    mapped: pycolmap.Reconstruction, cameras: list[int], seed: int, camera_models: Sequence[str], noise: float
) -> Selection:
    """Let every candidate predict what these cameras saw."""
    sample = _part(mapped, cameras)
    photos = sum(mapped.image(image_id).camera_id in cameras for image_id in mapped.reg_image_ids())
    per_image = MAX_OBSERVATIONS_PER_IMAGE * sample.num_reg_images()
    most = max(MAX_OBSERVATIONS * photos // mapped.num_reg_images(), per_image)
    held_out = hold_out(sample, seed, most)
    if len(held_out.xy) < MIN_HELD_OUT:
        why = f"only {len(held_out.xy)} points appear in three photos, too few to compare camera models"
        if photos < 3:  # however many points there are
            why = "comparing camera models takes points that three photos of one camera see"
        return Selection(cameras, photos, None, [], why)
    results = list(_results(sample, held_out, camera_models, noise))
    cells = _cells(held_out, mapped)
    chosen, rows = _choose(results, cells)
    return Selection(cameras, photos, chosen, rows, _reason(chosen, results, cells))


def _groups(mapped: pycolmap.Reconstruction, cameras: list[int]) -> list[list[int]]:
    """Cameras that are judged together: each one whose photos share enough points alone, then all others."""
    if len(cameras) == 1:
        return [cameras]
    camera_of = {i: mapped.image(i).camera_id for i in mapped.reg_image_ids()}
    shared: Counter[int] = Counter()
    for point_id in mapped.point3D_ids():
        views = Counter(camera_of[element.image_id] for element in mapped.point3D(point_id).track.elements)
        shared.update(camera for camera, count in views.items() if count >= 3)
    alone = [camera for camera in cameras if shared[camera] >= MIN_HELD_OUT]
    others = [camera for camera in cameras if camera not in alone]
    return [[camera] for camera in alone] + ([others] if others else [])


def _part(mapped: pycolmap.Reconstruction, cameras: list[int]) -> pycolmap.Reconstruction:
    """The photos of these cameras and the points that two of them see."""
    part = pycolmap.Reconstruction(mapped)
    for image_id in sorted(part.reg_image_ids()):
        if part.image(image_id).camera_id not in cameras:
            part.deregister_frame(part.image(image_id).frame_id)
    if part.num_reg_images() > (most := MAX_PHOTOS * len(cameras)):
        for image_id in set(part.reg_image_ids()) - best_covered(part, most):
            part.deregister_frame(part.image(image_id).frame_id)
    return part


def best_covered(model: pycolmap.Reconstruction, count: int) -> set[int]:
    """So many images (ids) that hang together by the most shared points: the one that shares most, then again and again
    the one that shares most with those taken."""
    ids = sorted(model.reg_image_ids())
    shared: Float[np.ndarray, "images images"] = shared_points(model).toarray()
    np.fill_diagonal(shared, 0)
    return {ids[photo] for photo, _ in islice(most_linked(shared), count)}


def hold_out(model: pycolmap.Reconstruction, seed: int, most: int) -> Observations:
    """Reduce a model to points drawn until they have so many observations; take one of each with three or more away.

    Which one is drawn too, so they come from all photos. Two are left, and so every point keeps its place.
    """
    random = np.random.default_rng(seed)
    drawn, count = [], 0
    for point_id in random.permutation(np.array(sorted(model.point3D_ids()), np.int64)).tolist():
        if count < most:
            drawn.append(point_id)
            count += model.point3D(point_id).track.length()
        else:
            model.delete_point3D(point_id)
    taken = []
    for point_id in sorted(drawn):
        track = sorted((e.image_id, e.point2D_idx) for e in model.point3D(point_id).track.elements)
        if len(track) >= 3:
            image_id, keypoint = track[random.integers(len(track))]
            taken.append((image_id, point_id, model.image(image_id).point2D(keypoint).xy))
            model.delete_observation(image_id, keypoint)
    taken.sort(key=lambda one: one[:2])
    return Observations(
        np.array([one[0] for one in taken], np.int64),
        np.array([one[1] for one in taken], np.int64),
        np.array([one[2] for one in taken], float).reshape(-1, 2),
    )


def _cells(seen: Observations, model: pycolmap.Reconstruction) -> Int[np.ndarray, "n"]:
    """In which part of which photo an observation lies."""
    size = {i: (c.width, c.height) for i in model.reg_image_ids() for c in [model.camera(model.image(i).camera_id)]}
    part = seen.xy / np.array([size[i] for i in seen.image.tolist()], float).reshape(-1, 2)
    column, row = np.clip((CELLS_ACROSS * part).astype(np.int64), 0, CELLS_ACROSS - 1).T
    return (seen.image * CELLS_ACROSS + row) * CELLS_ACROSS + column


def _results(
    sample: pycolmap.Reconstruction, held_out: Observations, camera_models: Sequence[str], noise: float
) -> Iterator[CandidateResult]:
    """Every candidate adjusted to the sample; with a refined principal point it goes on from where it was centred."""
    trained = observations(sample)
    cameras = sorted({sample.image(i).camera_id for i in sample.reg_image_ids()})
    # Most of the way is the same for all candidates.
    bundle_adjust(sample, set(), adjustment_options(False, noise), MAX_ITERATIONS)
    for name in camera_models:
        model = pycolmap.Reconstruction(sample)
        set_camera_models(model, dict.fromkeys(cameras, name))
        for principal_point in (False, True):
            bundle_adjust(model, set(), adjustment_options(principal_point, noise), MAX_ITERATIONS)
            length = np.linalg.norm(residuals(model, held_out), axis=1)
            error = np.where(length < CAP_PX, length, CAP_PX)  # a point behind the camera (NaN) counts as far off
            degenerate = list(degenerate_cameras(model).values())
            why = degenerate[0] if len(degenerate) > MAX_DEGENERATE_FRACTION * model.num_reg_images() else None
            yield CandidateResult(CameraModelCandidate(name, principal_point), error, noise_px(model, trained), why)


def _choose(
    results: list[CandidateResult], cells: Int[np.ndarray, "n"]
) -> tuple[CandidateResult | None, list[dict[str, Any]]]:
    """The result of the candidate to take, None if all are degenerate, and the table."""
    chosen, excess = None, {}
    if sound := [result for result in results if not result.why_degenerate]:
        best = min(sound, key=lambda result: result.error_px.mean())
        excess = {result.candidate: paired(result.error_px - best.error_px, cells) for result in sound}
        least = MIN_WORSE * float(best.error_px.mean())
        able = [
            result
            for result in sound
            if excess[result.candidate][0] <= max(least, NOISE_MULTIPLES * excess[result.candidate][1])
        ]
        chosen = min(able, key=lambda result: (result.candidate.complexity, result.error_px.mean()))
    rows = []
    for result in results:
        worse, noise = excess.get(result.candidate, (None, None))
        rows.append(
            {
                "model": result.candidate.model,
                "principal_point": result.candidate.principal_point_state,
                "free_parameters": result.candidate.free_parameters,
                "held_out_px": None if result.why_degenerate else float(result.error_px.mean()),
                "worse_px": worse,
                "noise_px": noise,
                "chosen": result is chosen,
                "reason": result.why_degenerate,
            }
        )
    return chosen, rows


def paired(difference: Float[np.ndarray, "n"], cells: Int[np.ndarray, "n"]) -> tuple[float, float]:
    """The mean of differences, and its standard error where those of one cell may err alike."""
    mean = float(difference.mean())
    _, cell = np.unique(cells, return_inverse=True)
    sums = np.bincount(cell, difference - mean)
    return mean, float(np.sqrt((sums**2).sum() * len(sums) / max(len(sums) - 1, 1)) / len(difference))


def _reason(chosen: CandidateResult | None, results: list[CandidateResult], cells: Int[np.ndarray, "n"]) -> str:
    if chosen is None:
        return "every candidate is degenerate, so the camera model of mapping is kept"
    error = f"held-out error {chosen.error_px.mean():.2f} px"
    sound = [result for result in results if not result.why_degenerate]
    simpler = [result for result in sound if result.candidate.complexity < chosen.candidate.complexity]
    if not simpler:
        return f"{error}, and no model with more parameters is better by more than the noise or a thousandth"
    best = min(simpler, key=lambda result: result.error_px.mean())
    worse, noise = paired(best.error_px - chosen.error_px, cells)
    name = f"{best.candidate.model} ({best.candidate.principal_point_state})"
    return f"{error}; the best simpler model, {name}, is {worse:.3f} ± {noise:.3f} px worse"
