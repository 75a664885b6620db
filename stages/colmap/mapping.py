"""From matches to sub-models: incremental and global mapping. Call it in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from stages.sfm_attempts import Effort

if TYPE_CHECKING:
    import pycolmap

MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
SMALLEST_MODEL = 3


def map_incrementally(
    database: Path, images: Path, models: Path, seed: int, effort: Effort, on_image: Callable[[], None]
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first: most registered photos, then most points. ``on_image`` is called per photo."""
    import pycolmap

    models.mkdir(parents=True, exist_ok=True)
    options = pipeline_options(seed + effort.seed)
    options.mapper.init_min_num_inliers = effort.first_pair_matches
    options.mapper.init_min_tri_angle = effort.first_pair_angle_deg
    options.mapper.init_max_forward_motion = effort.forward_motion
    options.mapper.abs_pose_min_num_inliers = effort.photo_matches
    options.mapper.abs_pose_min_inlier_ratio = effort.photo_inlier_share
    found = pycolmap.incremental_mapping(
        database, images, models, options, initial_image_pair_callback=on_image, next_image_callback=on_image
    )
    return sorted(found.values(), key=_rank, reverse=True)


def map_globally(database: Path, images: Path, models: Path, seed: int) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first, of placing all photos at once (GLOMAP, Pan et al. 2024). It cannot be interrupted."""
    import pycolmap

    models.mkdir(parents=True, exist_ok=True)
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=SMALLEST_MODEL)
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = 1, seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.retriangulation.random_seed = seed
    pycolmap.set_random_seed(seed)
    found = pycolmap.global_mapping(database, images, models, options)
    return sorted(found.values(), key=_rank, reverse=True)


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
