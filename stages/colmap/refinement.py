"""The final adjustment of cameras and points. Call it in a child process."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.colmap.mapping import pipeline_options

if TYPE_CHECKING:
    import pycolmap

# What finish() asks of a principal point, in shares of the image: lenses are centred to about a percent.
VAGUE_PRINCIPAL_POINT = 0.005  # a standard deviation above this, and the centre is the better guess
FARTHEST_PRINCIPAL_POINT = 0.1


def finish(
    mapped: "pycolmap.Reconstruction", database: Path, seed: int, keep_camera_model: bool
) -> "tuple[pycolmap.Reconstruction, set[int]]":
    """The model after the final adjustment, and the cameras whose principal points took no part in it.

    Principal points are refined and, unless ``keep_camera_model``, every camera gets a second distortion term: on
    photos with measured cameras that halves the error of their positions (benchmarks/sfm_accuracy.py). Cameras that
    the photos say too little about are left as mapping had them.
    """
    model = _adjusted(mapped, database, seed, set(), keep_camera_model)
    vague = _vague_cameras(model)
    if vague:
        model = _adjusted(mapped, database, seed, vague, keep_camera_model)
    return model, vague


def _adjusted(
    mapped: "pycolmap.Reconstruction", database: Path, seed: int, vague: set[int], keep_camera_model: bool
) -> "pycolmap.Reconstruction":
    import pycolmap

    model = pycolmap.Reconstruction(mapped)
    known = set(model.cameras) - vague
    if not keep_camera_model:
        for camera in map(model.camera, known):
            params = [*camera.params, 0.0]
            camera.model, camera.params = pycolmap.CameraModelId.RADIAL, params
    # Whether to refine principal points holds for all cameras, so vague ones among others stay as they are.
    _adjust(model, database, seed, vague if known else set(), principal_point=bool(known))
    return model


def _vague_cameras(model: "pycolmap.Reconstruction") -> set[int]:
    """Cameras whose principal point the photos tell less well than one would guess it, or that came out absurd.

    The standard deviation is that of a bundle adjustment at its minimum; its unit is the error of an observation.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    error_px = model.compute_mean_reprojection_error()
    vague = set()
    for camera_id, camera in model.cameras.items():
        size, place = np.array([camera.width, camera.height]), list(camera.principal_point_idxs())
        off_centre = np.abs(camera.params[place] / size - 0.5).max()
        spread = None if covariance is None else covariance.get_other_params_cov(camera.params)
        sigma_px = np.inf if spread is None else error_px * np.sqrt(spread[place, place].max())
        if not sigma_px < VAGUE_PRINCIPAL_POINT * size.max() or off_centre > FARTHEST_PRINCIPAL_POINT:
            vague.add(camera_id)
    return vague


def _adjust(
    model: "pycolmap.Reconstruction", database: Path, seed: int, constant_cameras: set[int], principal_point: bool
) -> None:
    """Complete, merge and filter tracks and adjust everything together, until little changes.

    Residuals r count by soft-L1, 2(√(1 + r²) − 1), so that the mismatches that remain do not bend the cameras.
    """
    import pycolmap

    options = pipeline_options(seed)
    options.mapper.constant_cameras = constant_cameras
    adjustment = pycolmap.BundleAdjustmentOptions(refine_principal_point=principal_point, print_summary=False)
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    adjustment.ceres.solver_options.function_tolerance = 1e-6
    adjustment.ceres.solver_options.num_threads = 1
    with pycolmap.Database.open(database) as db:
        wanted = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(db, wanted)
    for camera in model.cameras.values():  # the database still has the model that mapping began with
        cached = cache.camera(camera.camera_id)
        cached.model, cached.params = camera.model, camera.params
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.mapper,
        adjustment,
        options.triangulation,
    )
    mapper.end_reconstruction(discard=False)
    model.update_point_3d_errors()
