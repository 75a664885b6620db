"""From matches to sub-models: incremental and global mapping. Call it in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import pycolmap

MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
SMALLEST_MODEL = 3


class Effort(NamedTuple):
    """What incremental mapping asks of its first pair and of every photo after it; as it stands, COLMAP's defaults."""

    first_pair_matches: int = 100
    first_pair_angle_deg: float = 16.0
    forward_motion: float = 0.95  # share of the first pair's motion along its view
    photo_matches: int = 30  # with points of the model
    photo_inlier_share: float = 0.25
    seed: int = 0  # added to the run's


# A quarter of the angle and half of the matches: what a first pair with little baseline still has.
WEAK_START = Effort(50, 4.0, 1.0, 15, 0.15)
OTHER_SEED = Effort(seed=1)


def map_incrementally(
    database: Path, images: Path, models: Path, seed: int, effort: Effort, on_image: Callable[[], None]
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first (:func:`rank`). ``on_image`` is called per photo."""
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
    return sorted(found.values(), key=rank, reverse=True)


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
    return sorted(found.values(), key=rank, reverse=True)


def rank(model: "pycolmap.Reconstruction") -> tuple[int, int, float]:
    """What makes a model better than another: more registered photos, then more points, then a smaller error."""
    return model.num_reg_images(), model.num_points3D(), -model.compute_mean_reprojection_error()


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
