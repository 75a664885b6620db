"""The final adjustment of cameras and points, and of imported poses. Call it in a child process."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from nerf.geometry.alignment import align_poses
from stages.contract import Note
from stages.sfm.colmap.adjustment.camera_model_selection import CameraModels, adjustment_options, choose
from stages.sfm.colmap.adjustment.intrinsics import MODELS, degenerate_cameras, set_camera_models
from stages.sfm.colmap.adjustment.observations import noise_px, observations
from stages.sfm.colmap.adjustment.uncertainty import pose_uncertainty_px
from stages.sfm.colmap.mappers import pipeline_options, triangulated
from stages.sfm.colmap.models import load_native, read_model, write_model, write_native

# The first choice can only go by the observations that fit mapping's camera model. Where those of another one are a
# tenth more, mostly at the borders of wide photos, these tell the models apart.
MIN_GROWTH_TO_CHOOSE_AGAIN = 1.1
SIMPLEST = MODELS[0]
MAX_ERROR_MULTIPLE = 5.0  # of the median error of imported poses: observations that are farther off do not count
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # what OPENCV has more parameters than
# Of the adjustment of all observations, before and after those that fit no more are dropped.
FINAL_ITERATIONS = (3, 3)


@dataclass(frozen=True)
class AdjustedModel:
    """The model after the final adjustment and what there is to say about it."""

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
    models = (camera_model,) if camera_model else MODELS
    choice = choose(mapped, seed, models)
    model = _adjusted(mapped, database, seed, choice, thinned)
    if (
        not thinned
        and model.compute_num_observations() > MIN_GROWTH_TO_CHOOSE_AGAIN * mapped.compute_num_observations()
    ):
        choice = choose(model, seed, models)
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
    photos = f"{len(degenerate)} photo{'s' * (len(degenerate) != 1)}"
    choice.notes.append(
        Note(
            "sfm.camera-replaced",
            f"{photos}: the camera is degenerate ({next(iter(degenerate.values()))}): {SIMPLEST} is used instead",
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


def adjust_poses(sparse: Path, database: Path, images: Path, target: Path, error_px: float, limit_px: float) -> bool:
    """Write to the folder ``target`` the model in ``sparse``, with the database's image ids, its poses adjusted to the
    verified matches; ``error_px``: their median error at the given poses, ``limit_px``: that of an observation at most,
    in the end. Cameras stay, and so does the frame: a similarity lays the new poses on the given ones. Photos without
    observations keep theirs. False, and nothing is written, where the matches tell no points at these poses.
    """
    given, model = read_model(sparse), _at_unit_size(load_native(sparse))
    for limit in (max(MAX_ERROR_MULTIPLE * error_px, limit_px), limit_px):
        model = triangulated(model, database, images, limit, colours=False)
        if not model.num_points3D():
            return False
        bundle_adjust(model, set(model.cameras), adjustment_options(False, noise_px(model, observations(model))))
    adjusted = {
        model.image(i).name: model.image(i).cam_from_world().inverse().matrix()
        for i in model.reg_image_ids()
        if model.image(i).num_points3D
    }
    before = {image.file: image.sfm_from_camera for image in given.images}
    back = align_poses(np.array(list(adjusted.values())), np.array([before[name] for name in adjusted]))
    poses = before | {name: back.pose(pose) for name, pose in adjusted.items()}
    write_model(target, replace(given, images=[replace(i, sfm_from_camera=poses[i.file]) for i in given.images]))
    return True


def adjust_lenses(sparse: Path, database: Path, images: Path, target: Path, error_px: float, limit_px: float) -> bool:
    """As :func:`adjust_poses`, but poses stay and cameras are adjusted, perspective ones with OPENCV's distortion."""
    model = load_native(sparse)
    for camera in model.cameras.values():
        if camera.model_name in PERSPECTIVE:
            params = dict(zip(camera.params_info.split(", "), camera.params, strict=True))
            focal = [params.get(name, params.get("f")) for name in ("fx", "fy")]
            radial = [params.get("k1", params.get("k", 0.0)), params.get("k2", 0.0)]
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [*focal, params["cx"], params["cy"], *radial, 0.0, 0.0]
    limit = max(MAX_ERROR_MULTIPLE * error_px, limit_px)
    model = triangulated(model, database, images, limit, colours=False)
    if not model.num_points3D():
        return False
    adjustment = adjustment_options(True, noise_px(model, observations(model)))
    bundle_adjust(model, set(), adjustment, constant_poses=True)
    write_native(target, model)
    return True


def _at_unit_size(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model about its middle, so large that its cameras are a unit from there in the median: numbers of map
    projections are too large to be adjusted."""
    centres = np.array([model.image(i).projection_center() for i in model.reg_image_ids()])
    middle = np.median(centres, axis=0)
    size = float(np.median(np.linalg.norm(centres - middle, axis=1))) or 1.0
    model.transform(pycolmap.Sim3d(1 / size, pycolmap.Rotation3d(np.eye(3)), -middle / size))
    return model


def release_focal_lengths(model: pycolmap.Reconstruction, constant_cameras: Collection[int] = ()) -> None:
    """Adjust a model whose focal lengths were held while it was mapped, now with all of its images to tell them; those
    of ``constant_cameras`` stay. Observations that do not fit are dropped."""
    bundle_adjust(model, set(constant_cameras), adjustment_options(False, noise_px(model, observations(model))))
    limits = pycolmap.IncrementalMapperOptions()
    pycolmap.ObservationManager(model).filter_all_points3D(limits.filter_max_reproj_error, limits.filter_min_tri_angle)
    model.update_point_3d_errors()


def bundle_adjust(
    model: pycolmap.Reconstruction,
    constant_cameras: set[int],
    adjustment: pycolmap.BundleAdjustmentOptions,
    iterations: int = 100,
    constant_poses: bool = False,
) -> None:
    """Adjust cameras, poses and points to the observations that the model has."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
        if constant_poses:
            config.set_constant_rig_from_world_pose(model.image(image_id).frame_id)
    for camera_id in constant_cameras:
        config.set_constant_cam_intrinsics(camera_id)
    if not constant_poses:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjustment.ceres.solver_options.max_num_iterations = iterations
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()


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
