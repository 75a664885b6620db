"""Bundle adjustment of a model to the observations that it has, under a loss that mismatches do not bend."""

from collections.abc import Collection

import pycolmap

from stages.sfm.colmap.adjustment.observations import noise_px, observations


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


def adjustment_options(principal_point: bool, noise: float) -> pycolmap.BundleAdjustmentOptions:
    """Of the comparison of camera models and of all that is adjusted afterwards.

    Residuals r count by soft-L1, 2s²(√(1 + (r/s)²) − 1), with s the ``noise`` of the observations: beyond it their
    gradient grows no more, so that the mismatches that remain do not bend the cameras. Were the noise
    Gaussian, this would cost 7 % of its efficiency (Huber 1981, section 7.6: E[ψ']² / E[ψ²] in two dimensions).
    """
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=principal_point, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = noise
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1
    return options


def release_focal_lengths(model: pycolmap.Reconstruction, constant_cameras: Collection[int] = ()) -> None:
    """Adjust a model whose focal lengths were held while it was mapped, now with all of its images to tell them; those
    of ``constant_cameras`` stay. Observations that do not fit are dropped."""
    bundle_adjust(model, set(constant_cameras), adjustment_options(False, noise_px(model, observations(model))))
    limits = pycolmap.IncrementalMapperOptions()
    pycolmap.ObservationManager(model).filter_all_points3D(limits.filter_max_reproj_error, limits.filter_min_tri_angle)
    model.update_point_3d_errors()
