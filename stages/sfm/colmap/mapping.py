"""From matches to sub-models: incremental and global mapping. Call it in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from stages.sfm.retry_strategies import FEWEST_MATCHES, Effort

if TYPE_CHECKING:
    import pycolmap

MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
SMALLEST_MODEL = 3
# COLMAP's own are 1.1 and 5, for all observations; the final adjustment comes after mapping in any case.
GROWTH_BETWEEN_ADJUSTMENTS, ADJUSTMENTS_AT_A_TIME = 1.3, 2


def map_incrementally(
    database: Path,
    images: Path,
    models: Path,
    options: "pycolmap.IncrementalPipelineOptions",
    on_image: Callable[[], None] = lambda: None,
    begin: Path | None = None,
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first: most registered photos, then most points. ``on_image`` is called per photo. It goes
    on from the model in the folder ``begin``, where one is given."""
    import pycolmap

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
    seed: int, effort: Effort, lens_is_known: bool, thinned: bool
) -> "pycolmap.IncrementalPipelineOptions":
    """What mapping asks of photos; a known lens is kept as it is. Of ``thinned`` matches, those of many photos, all
    cameras are adjusted together less often: long tracks hold them in the meantime."""
    options = pipeline_options(seed + effort.seed)
    if thinned:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH_BETWEEN_ADJUSTMENTS
        options.ba_global_max_refinements = ADJUSTMENTS_AT_A_TIME
    options.mapper.init_min_num_inliers = effort.matches
    options.mapper.init_min_tri_angle = effort.angle_deg
    options.mapper.init_max_forward_motion = effort.forward_motion
    # Thinned photos have points enough; those that lack them have false matches, on which this takes minutes.
    options.structure_less_registration_fallback = effort.without_structure and not thinned
    options.mapper.abs_pose_min_num_inliers = FEWEST_MATCHES
    if lens_is_known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return options


def map_globally(
    database: Path, images: Path, models: Path, seed: int, lens_is_known: bool
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first, of placing all photos at once (GLOMAP, Pan et al. 2024). It cannot be interrupted.

    Photos that share no points with the others may be among them, placed at will: only the largest group stays.
    """
    import pycolmap

    models.mkdir(parents=True, exist_ok=True)
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=SMALLEST_MODEL)
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = 1, seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.retriangulation.random_seed = seed
    mapper.bundle_adjustment.refine_focal_length = not lens_is_known
    mapper.bundle_adjustment.refine_extra_params = not lens_is_known
    pycolmap.set_random_seed(seed)
    found = pycolmap.global_mapping(database, images, models, options)
    for model in found.values():
        _keep_largest_group(model)
    return sorted(found.values(), key=_rank, reverse=True)


def _keep_largest_group(model: "pycolmap.Reconstruction") -> None:
    import numpy as np
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    if not model.num_points3D():
        return
    points = [[place.point3D_id for place in image.get_observation_points2D()] for image in images]
    owner = np.repeat(np.arange(len(images)), [len(seen) for seen in points])
    point = np.unique(np.array([one for seen in points for one in seen], np.int64), return_inverse=True)[1]
    sees = csr_matrix((np.ones(len(owner)), (owner, point)), shape=(len(images), int(point.max()) + 1))
    _, group = connected_components((sees @ sees.T) >= FEWEST_MATCHES, directed=False)
    largest = np.bincount(group).argmax()
    for image, of in zip(images, group, strict=True):
        if of != largest:
            model.deregister_frame(image.frame_id)


def _rank(model: "pycolmap.Reconstruction") -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def pipeline_options(seed: int) -> "pycolmap.IncrementalPipelineOptions":
    """Options under which mapping with the same matches and seed repeats."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    # With more threads RANSAC stops and Ceres sums as timing has it: rarely, but then every number is another.
    # Mapping is no slower for it.
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = SMALLEST_MODEL
    pycolmap.set_random_seed(seed)
    return options
