"""From matches to sub-models: incremental and global mapping. Call it in a worker process."""

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse.csgraph import connected_components

from stages.sfm.colmap.adjustment.observations import shared_points
from stages.sfm.retry_strategies import MIN_POSE_INLIERS, MappingOptions

MIN_MODEL_IMAGES = 3
# COLMAP's own are 1.1 and 5, for all observations; the final bundle adjustment comes after mapping in any case.
BA_GLOBAL_RATIO, BA_GLOBAL_MAX_REFINEMENTS = 1.3, 2


def map_incrementally(
    database: Path,
    images: Path,
    models: Path,
    options: pycolmap.IncrementalPipelineOptions,
    on_image: Callable[[], None] = lambda: None,
    begin: Path | None = None,
) -> list[pycolmap.Reconstruction]:
    """All sub-models, best first: most registered images, then most points. ``on_image`` is called per image. It goes
    on from the model in the folder ``begin``, where one is given."""
    models.mkdir(parents=True, exist_ok=True)
    found = pycolmap.incremental_mapping(
        database,
        images,
        models,
        options,
        input_path=begin or "",
        initial_image_pair_callback=on_image,
        next_image_callback=on_image,
    )
    return sorted(found.values(), key=_rank, reverse=True)


def incremental_options(
    seed: int,
    mapping: MappingOptions,
    camera_is_known: bool,
    thinned: bool,
    hold_focal: bool = False,
    held_cameras: Collection[int] = (),
) -> pycolmap.IncrementalPipelineOptions:
    """What mapping asks of images; a known camera is kept as it is. With ``thinned`` matches, those of many images,
    global bundle adjustment runs less often: long tracks hold the images together in the meantime.

    With ``hold_focal``, focal lengths that all pairs together tell are held: the first few images alone do not tell
    them from distortion and depth; where adjustment runs away with them, every image after these is placed wrongly.
    ``release_focal_lengths`` (stages/sfm/colmap/adjustment) is for afterwards. ``held_cameras`` (ids) are kept as they
    are in the database, whatever becomes of the others.
    """
    options = pipeline_options(seed + mapping.seed_offset)
    # Otherwise each photo is decoded as it is registered, in every mapping, and points that come later have no colour.
    # All are coloured in the end (stages/sfm/worker.py).
    options.extract_colors = False
    options.constant_cameras = options.mapper.constant_cameras = set(held_cameras)
    if thinned:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = BA_GLOBAL_RATIO
        options.ba_global_max_refinements = BA_GLOBAL_MAX_REFINEMENTS
    options.mapper.init_min_num_inliers = mapping.init_min_num_inliers
    options.mapper.init_min_tri_angle = mapping.init_min_tri_angle_deg
    options.mapper.init_max_forward_motion = mapping.init_max_forward_motion
    # With thinned matches images have points enough; those that lack them have outliers, on which this takes minutes.
    options.structure_less_registration_fallback = mapping.structure_less_fallback and not thinned
    options.mapper.abs_pose_min_num_inliers = MIN_POSE_INLIERS
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not (camera_is_known or hold_focal)
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = not camera_is_known
    return options


def map_globally(
    database: Path, images: Path, models: Path, seed: int, camera_is_known: bool
) -> list[pycolmap.Reconstruction]:
    """All sub-models of global mapping (GLOMAP, Pan et al. 2024), best first. It cannot be interrupted.

    Images that share no points with the others may be among them, with arbitrary poses: only the largest group stays.
    """
    models.mkdir(parents=True, exist_ok=True)
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=MIN_MODEL_IMAGES)
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = 1, seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.retriangulation.random_seed = seed
    mapper.bundle_adjustment.refine_focal_length = not camera_is_known
    mapper.bundle_adjustment.refine_extra_params = not camera_is_known
    pycolmap.set_random_seed(seed)
    found = pycolmap.global_mapping(database, images, models, options)
    for model in found.values():
        _keep_largest_group(model)
    return sorted(found.values(), key=_rank, reverse=True)


def _keep_largest_group(model: pycolmap.Reconstruction) -> None:
    """Deregister images that share no points with the largest group of those that do."""
    if not model.num_points3D():
        return
    _, group = connected_components(shared_points(model) >= MIN_POSE_INLIERS, directed=False)
    largest = np.bincount(group).argmax()
    for image_id, of in zip(sorted(model.reg_image_ids()), group, strict=True):
        if of != largest:
            model.deregister_frame(model.image(image_id).frame_id)


def _rank(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def pipeline_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    """Options under which mapping with the same matches and seed repeats."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    # With more threads RANSAC stops and Ceres sums as timing has it: rarely, but then every number is another.
    # Mapping is no slower for it.
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = MIN_MODEL_IMAGES
    pycolmap.set_random_seed(seed)
    return options
