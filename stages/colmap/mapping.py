"""From matches to sub-models: incremental mapping. Call it in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap

MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
SMALLEST_MODEL = 3


def map_incrementally(
    database: Path, images: Path, models: Path, seed: int, on_image: Callable[[], None]
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first: most registered photos, then most points. ``on_image`` is called per photo."""
    import pycolmap

    models.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        database,
        images,
        models,
        pipeline_options(seed),
        initial_image_pair_callback=on_image,
        next_image_callback=on_image,
    )
    return sorted(found.values(), key=rank, reverse=True)


def rank(model: "pycolmap.Reconstruction") -> tuple[int, int]:
    """What makes a model better than another: more registered photos, then more points."""
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
