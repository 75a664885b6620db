"""The final bundle adjustment of cameras, poses and points, with the camera model that the observations call for. Call
it in a worker process."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from stages.contract import Note
from stages.io.amounts import counted
from stages.sfm.colmap.adjustment.bundle_adjustment import adjustment_options, bundle_adjust
from stages.sfm.colmap.adjustment.camera_model_selection import CameraModels, choose
from stages.sfm.colmap.adjustment.intrinsics import CAMERA_MODELS, degenerate_cameras, set_camera_models
from stages.sfm.colmap.adjustment.observations import noise_px, observations
from stages.sfm.colmap.adjustment.uncertainty import pose_uncertainty_px
from stages.sfm.colmap.mappers import pipeline_options

# The first choice can only go by the observations that fit mapping's camera model. Where those of another one are a
# tenth more, mostly at the borders of wide photos, these tell the models apart.
MIN_GROWTH_TO_CHOOSE_AGAIN = 1.1
SIMPLEST = CAMERA_MODELS[0]
# Of the adjustment of all observations, before and after those that fit no more are dropped.
FINAL_ITERATIONS = (3, 3)


@dataclass(frozen=True)
class AdjustedModel:
    """The model after the final bundle adjustment and what there is to say about it."""

    model: pycolmap.Reconstruction
    camera_models: list[dict[str, Any]]  # the comparison, a row per candidate (registration.json)
    notes: list[Note]
    uncertainty_px: dict[str, float]  # by the image's name
    left_out: dict[str, Note]  # by the image's name, why its camera cannot be used: it is registered no more


def final_bundle_adjustment(
    mapped: pycolmap.Reconstruction,
    database: Path,
    seed: int,
    camera_model: str | None,
    camera_is_known: bool,
    thinned: bool = False,
) -> AdjustedModel:
    """Choose the camera model by held-out observations, unless it is given, and adjust everything with it.

    Of a given model it is only chosen whether its principal point is refined; known intrinsics are kept as they are.
    Where many more observations fit the chosen model than mapping's, the choice is made again with them. No camera of
    the model is degenerate in the end, unless those of most photos are. Of a model of ``thinned`` matches (thinning.py)
    the tracks that it has are adjusted first; then all matches come back.
    """
    if camera_is_known:
        choice = CameraModels(
            noise_px(mapped, observations(mapped)), notes=[Note("sfm.camera-kept", "the camera is kept as given")]
        )
        model = pycolmap.Reconstruction(mapped)
        adjust = _adjust_thinned if thinned else _adjust
        adjust(model, database, seed, set(model.cameras), adjustment_options(False, choice.noise_px))
        return _finished(model, choice, {})
    camera_models = (camera_model,) if camera_model else CAMERA_MODELS
    choice = choose(mapped, seed, camera_models)
    model = _adjusted(mapped, database, seed, choice, thinned)
    if (
        not thinned
        and model.compute_num_observations() > MIN_GROWTH_TO_CHOOSE_AGAIN * mapped.compute_num_observations()
    ):
        choice = choose(model, seed, camera_models)
        model = _adjusted(model, database, seed, choice, thinned)
    _simplify_degenerate(model, database, seed, choice)
    return _finished(model, choice, _deregister_degenerate(model, degenerate_cameras(model)))


def _simplify_degenerate(model: pycolmap.Reconstruction, database: Path, seed: int, choice: CameraModels) -> None:
    """Make pinholes of degenerate cameras, fisheyes excepted, and adjust everything but the other cameras.

    They are mostly those of few photos, that show too little to be judged by, or were judged by what others show.
    """
    degenerate = {
        i: why for i, why in degenerate_cameras(model).items() if not _camera(model, i).model_name.endswith("FISHEYE")
    }
    if not degenerate:
        return
    cameras = {_camera(model, image_id).camera_id for image_id in degenerate}
    set_camera_models(model, dict.fromkeys(cameras, SIMPLEST))
    _adjust(model, database, seed, set(model.cameras) - cameras, adjustment_options(False, choice.noise_px))
    choice.notes.append(
        Note(
            "sfm.camera-replaced",
            f"{counted(len(degenerate))}: the camera is degenerate ({next(iter(degenerate.values()))}): "
            f"{SIMPLEST} is used instead",
        )
    )


def _camera(model: pycolmap.Reconstruction, image_id: int) -> pycolmap.Camera:
    return model.camera(model.image(image_id).camera_id)


def _deregister_degenerate(model: pycolmap.Reconstruction, degenerate: dict[int, str]) -> dict[str, Note]:
    """Take these photos out of the model: by name why. None where they are most of all: what is left is no scene."""
    if not degenerate or 2 * len(degenerate) >= model.num_reg_images():
        return {}
    reasons = {
        model.image(image_id).name: Note("sfm.unregistered-degenerate-camera", f"its camera is degenerate: {why}")
        for image_id, why in degenerate.items()
    }
    for image_id in degenerate:
        model.deregister_frame(model.image(image_id).frame_id)
    model.tear_down()  # their cameras go too
    model.update_point_3d_errors()
    return reasons


def _finished(model: pycolmap.Reconstruction, choice: CameraModels, left_out: dict[str, Note]) -> AdjustedModel:
    notes, uncertainty = choice.notes, {}
    untold = "the uncertainty of the poses is unknown"
    try:
        uncertainty = pose_uncertainty_px(model, choice.noise_px)
    except np.linalg.LinAlgError:
        notes = [*notes, Note("sfm.poses-undetermined", f"{untold}: the points do not fix all poses")]
    except MemoryError as error:
        notes = [*notes, Note("sfm.uncertainty-memory", f"{untold}: {str(error) or 'memory ran out'}")]
    by_name = {model.image(i).name: px for i, px in uncertainty.items()}
    return AdjustedModel(model, choice.table, notes, by_name, left_out)


def _adjusted(
    before: pycolmap.Reconstruction, database: Path, seed: int, choice: CameraModels, thinned: bool
) -> pycolmap.Reconstruction:
    adjust = _adjust_thinned if thinned else _adjust
    model = pycolmap.Reconstruction(before)
    set_camera_models(model, {camera_id: candidate.model for camera_id, candidate in choice.chosen.items()})
    centred = {camera_id for camera_id, candidate in choice.chosen.items() if not candidate.principal_point}
    # Whether to refine principal points holds for all cameras at once: those that keep theirs are adjusted before.
    if centred:
        adjust(model, database, seed, set(), adjustment_options(False, choice.noise_px))
    if centred != choice.chosen.keys():
        adjust(model, database, seed, centred, adjustment_options(True, choice.noise_px))
    return model


def _adjust_thinned(
    model: pycolmap.Reconstruction,
    database: Path,
    seed: int,
    constant_cameras: set[int],
    adjustment: pycolmap.BundleAdjustmentOptions,
) -> None:
    """Adjust cameras, poses and the tracks there are until little changes; then bring back all matches, and adjust all
    of it in a few iterations: the long tracks have put everything in its place by then."""
    bundle_adjust(model, constant_cameras, adjustment)
    mapper, options = _mapper(model, database, seed, constant_cameras)
    for image_id in sorted(model.reg_image_ids()):
        mapper.triangulate_image(options.triangulation, image_id)
    for iterations in FINAL_ITERATIONS:
        mapper.complete_and_merge_tracks(options.triangulation)
        mapper.filter_points(options.mapper)
        bundle_adjust(model, constant_cameras, adjustment, iterations)
    mapper.filter_points(options.mapper)
    mapper.end_reconstruction(discard=False)
    model.update_point_3d_errors()


def _adjust(
    model: pycolmap.Reconstruction,
    database: Path,
    seed: int,
    constant_cameras: set[int],
    adjustment: pycolmap.BundleAdjustmentOptions,
) -> None:
    """Complete, merge and filter tracks and adjust everything together, until little changes."""
    mapper, options = _mapper(model, database, seed, constant_cameras)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.mapper,
        adjustment,
        options.triangulation,
    )
    mapper.end_reconstruction(discard=False)
    model.update_point_3d_errors()


def _mapper(
    model: pycolmap.Reconstruction, database: Path, seed: int, constant_cameras: set[int]
) -> tuple[pycolmap.IncrementalMapper, pycolmap.IncrementalPipelineOptions]:
    """A mapper that works on the model with all matches of the database, and its options."""
    options = pipeline_options(seed)
    options.mapper.constant_cameras = constant_cameras
    with pycolmap.Database.open(database) as db:
        wanted = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(db, wanted)
    for camera in model.cameras.values():  # the database still has the model that mapping began with
        cached = cache.camera(camera.camera_id)
        cached.model, cached.params = camera.model, camera.params
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    return mapper, options
