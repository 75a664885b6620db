"""The hash-grid field as stage train has it: what it is trained with by default, how large it is, what a step costs."""

import math
from typing import TYPE_CHECKING

from nerf.effects import ImageEffects
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.space_maps import Box, Contraction, Ndc, SpaceMap
from nerf.kernels import HIDDEN
from nerf.training.graph_trainer import GraphTrainer
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from stages.contract import Progress
from stages.effects.decisions import Space
from stages.hardware.backend import chosen_backend, load_backend
from stages.hardware.device import compute_device, cores
from stages.hardware.memory import available_on
from stages.hardware.ranks import rank_count
from stages.io.amounts import bytes_in_words, counted, short_count
from stages.train.config import Config
from stages.train.data import backdrop_tolerance, has_background_model, training_background
from stages.train.fields.hash_grid_options import MAX_MICRO_BATCHES
from stages.train.fields.space import map_without_scene, space_map_of, width_in_photos

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from nerf.training.ray_dataset import RayDataset

# At first; both fall while training. In contracted space a cell is met from farther away, and rays are longer.
LEARNING_RATES = {"bounded": 2e-2, "contracted": 1e-2, "ndc": 2e-2}
# Colours that each micro-batch computes, so each core: half of what one takes does not depend on how many they are, and
# fewer cost as long. In a box more of them go with its closer samples (docs/experiments/colour_samples.md).
MICRO_BATCH_SAMPLES = {"bounded": 3 << 13, "contracted": 1 << 14, "ndc": 1 << 14}
# The largest step, which a GPU takes as fast as a small one. Its gradients are sure enough for the larger rate
# (docs/experiments/colour_samples.md).
MAX_STEP_SAMPLES, LARGE_STEP_LEARNING_RATE = 1 << 18, 2e-2
# Weight of the distortion loss (Barron et al. 2022, who take 1e-2 where distances go from 0 to 1, as about they do in
# normalised device coordinates), against floaters, most of all close before the cameras; they also cost
# most of the time (docs/experiments/distortion_loss.md, docs/experiments/forward_facing.md). A box around an object
# needs none where alpha says which rays are opaque; before a backdrop an object has pits without it
# (docs/experiments/effects.md).
DISTORTION = {"bounded": 0.0, "contracted": 2e-3, "ndc": 1e-2}
BACKDROP_DISTORTION = 1e-2
# Weight at first of the loss at sparse points (docs/experiments/sparse_depth.md; Deng et al. 2022 take 0.1, too, of
# another loss).
DEPTH_LOSS = 0.1
# Photos that must look into a cell for something to stand before their foregrounds (docs/experiments/few_photos.md).
MIN_PHOTOS = 3
# Cells along an axis of the coarsest grid: fewer where they have to fill all of contracted space
# (docs/experiments/few_photos.md).
BASE_RES = {"bounded": 16, "contracted": 8, "ndc": 8}
# Samples along a ray (docs/experiments/ray_samples.md).
MAX_STEPS = 576  # bounded scenes: steps along the diagonal of the box, or as many as the finest cells along an axis
# Steps along the diagonal of normalised device coordinates, 1.7 times as many as from near to infinity, for one of the
# finest cells along an axis: photos that stand next to each other see a thing move by some pixel from one to the next
# (docs/experiments/forward_facing.md).
NDC_STEPS_PER_CELL = 1 / 4
# Contracted space: steps in one of the finest cells, by how many of these along an axis it counts for at most. Finer
# cells gain more by more rays than by closer samples (docs/experiments/cell_sizes.md).
STEPS_PER_CELL = {512: 3, 2048: 1.5}
# Progress up to which steps along rays are long, on a CPU (docs/experiments/ray_samples.md). A GPU has one CUDA graph
# for all of its steps; a finished training that goes on has thin surfaces already.
LONG_STEPS_UNTIL = {"bounded": 0.0, "contracted": 1 / 3, "ndc": 1 / 3}
EVEN_UNTIL = 0.25  # contracted space: scene units from the camera up to which steps are even; beyond, they grow
# Contracted space: at the shortest steps so many samples reach to a distance of 23; --train.grid.ray-samples may ask
# for more.
MAX_SAMPLES = 1024
SAMPLES_PER_RAY = {"bounded": 3, "contracted": 10, "ndc": 6}
"""Colours computed for a ray, over a run: measured on lego_400 and five photo sets."""
SIZES = {
    "bounded": ((200e6, 8, 19, 1024), (50e6, 5, 18, 512), (0, 4, 17, 256)),
    "contracted": ((75e6, 8, 19, 2048), (30e6, 6, 18, 1024), (0, 5, 17, 512)),
    "ndc": ((130e6, 8, 19, 2048), (30e6, 6, 18, 1024), (0, 5, 17, 512)),
}
"""(computed colours from which on it pays, num_levels, log2_hashmap_size, most max_res), the largest first
(docs/experiments/cell_sizes.md)."""
# The same on a GPU, which reads a large table as fast as a small one.
GPU_SIZES = {"bounded": (200e6, 8, 20, 1024), "contracted": (200e6, 8, 20, 2048), "ndc": (200e6, 8, 20, 2048)}
MIN_MAX_RES = 128
MAX_MEMORY_SHARE = 0.5  # of what is free: what training may take of it
TABLE_COPIES = 6  # of the grids' features: themselves, their gradient, Adam's two moments, and twice in a checkpoint
SAMPLE_BYTES = 4096  # that a sample of a step takes while it is computed


def with_defaults(config: Config) -> Config:
    """``config`` with what this field is usually trained with where it leaves that open."""
    gpu, at_once = compute_device() == "cuda", max(cores(), rank_count(config.devices))
    micro_batches = config.grid.micro_batches or min(MAX_MICRO_BATCHES, at_once)
    most = MAX_STEP_SAMPLES if gpu else min(MAX_STEP_SAMPLES, micro_batches * MICRO_BATCH_SAMPLES[_space(config)])
    samples = config.grid.target_samples or most
    rate = LARGE_STEP_LEARNING_RATE if samples >= MAX_STEP_SAMPLES else LEARNING_RATES[_space(config)]
    grid = {"target_samples": samples, "micro_batches": micro_batches}
    return config.filled({"background": "random", "learning_rate": rate, "grid": grid})


def prepared(config: Config, progress: Progress) -> Config:
    """``config`` with kernels that run here, compiled."""
    backend = config.grid.backend or chosen_backend(compute_device(), progress)
    load_backend(backend, compute_device(), progress)
    return config.filled({"grid": {"backend": backend}})


def is_sized(config: Config) -> bool:
    """Whether ``config`` leaves no size of the field open."""
    return None not in (config.grid.num_levels, config.grid.log2_hashmap_size, config.grid.max_res)


def with_sizes(config: Config, scene: "Scene", rays: float, progress: Progress | None = None) -> Config:
    """``config`` with the sizes, where open, of a field that sees ``rays`` at its ``downscale``: more and larger tables
    where there are enough to fill them, and MAX_MEMORY_SHARE holds what their training takes; else the next smaller
    ones, and ``progress`` is told. The finest cells are about as wide as a pixel where the region of interest fills the
    photo, in normalised device coordinates at any depth."""
    assert config.downscale is not None
    samples, device = rays * SAMPLES_PER_RAY[_space(config)], compute_device()
    sizes = SIZES[_space(config)]
    if device == "cuda":
        sizes = (GPU_SIZES[_space(config)], *sizes)
    cameras = [scene.cameras[view.camera] for view in scene.of_split("train")]
    pixels = max(max(camera.width, camera.height) for camera in cameras) / config.downscale
    across = 2 ** math.ceil(math.log2(pixels * _width_in_photos(config, scene)))
    wanted, *smaller = (
        _size(levels, log2_size, max(MIN_MAX_RES, min(most, across)))
        for least, levels, log2_size, most in sizes
        if samples >= least
    )
    free = available_on(device)

    def bytes_of(size: dict[str, int]) -> float:
        return memory_bytes(config.filled({"grid": size}))

    fitting = (size for size in (wanted, *smaller) if bytes_of(size) <= MAX_MEMORY_SHARE * free)
    chosen = next(fitting, [wanted, *smaller][-1])
    if chosen is not wanted and progress:
        progress.note(
            "train.memory-limits-grids",
            f"{_grids(chosen)}: {_grids(wanted)}, which the training time allows, take "
            f"{bytes_in_words(bytes_of(wanted))} during training, and only {bytes_in_words(free)} of memory are free",
        )
    return config.filled({"grid": chosen})


def _width_in_photos(config: Config, scene: "Scene") -> float:
    """How many times as wide as a photo, whose width the region of interest fills, all of mapped space is."""
    space = space_map_of(config, scene)
    return width_in_photos(space, scene) if isinstance(space, Ndc) else space.half / Box.half


def _space(config: Config) -> Space:
    """Whose measured constants count."""
    assert config.space is not None, "plan() chooses it"
    return config.space


def _size(num_levels: int, log2_hashmap_size: int, max_res: int) -> dict[str, int]:
    return {"num_levels": num_levels, "log2_hashmap_size": log2_hashmap_size, "max_res": max_res}


def _grids(size: dict[str, int]) -> str:
    return f"{size['num_levels']} grids of up to 2^{size['log2_hashmap_size']} rows"


def timed(config: Config) -> Config:
    """``config`` under which speed is measured before sizes are known: those of a few minutes."""
    _, *size = SIZES[_space(config)][-2]
    return config.filled({"grid": _size(*size)})


def rays_per_step(config: Config) -> float:
    """Rays of one step, expected from the colours that it computes."""
    assert config.grid.target_samples is not None, "plan() chooses it"
    return config.grid.target_samples / SAMPLES_PER_RAY[_space(config)]


def work(config: Config, rays: float) -> str:
    """What so many rays take, beside drawing them."""
    return f" and evaluate {short_count(rays * SAMPLES_PER_RAY[_space(config)])} colours"


def memory_bytes(config: Config) -> float:
    """Memory on the CPU that training takes beside the photos."""
    settings = field_settings(config, background_model=False)  # which is small beside the rest
    assert config.grid.target_samples, "plan() chooses it"
    table = TABLE_COPIES * 4 * settings.features_per_level * settings.layout.rows
    return table + SAMPLE_BYTES * config.grid.target_samples


def memory_advice(config: Config) -> tuple[str, str]:
    """What takes that memory, and how it would take less."""
    why = f"{config.grid.num_levels} grids of up to 2^{config.grid.log2_hashmap_size} rows take"
    return why, "Give a smaller --train.grid.log2-hashmap-size."


def matmul_width(config: Config) -> int:
    """Of the matrix multiplications."""
    return HIDDEN


def multiplies_by_torch(config: Config) -> bool:
    """Not with Warp on a CPU, where only what a ray's direction takes is left to torch."""
    return config.grid.backend != "warp" or compute_device() != "cpu"


def table_rows(config: Config) -> int:
    """Rows of features that are read at random."""
    return field_settings(config, background_model=False).layout.rows


def sizes_in_words(config: Config) -> str:
    """``5 grids of up to 2^18 rows, to 512³``."""
    grid = config.grid
    return f"{grid.num_levels} grids of up to 2^{grid.log2_hashmap_size} rows, to {grid.max_res}³"


def step_in_words(config: Config) -> str:
    """How a step is divided and what computes it, and where samples stand along a ray."""
    grid = config.grid
    stepping = field_settings(config, background_model=False).stepping
    cone = f", from {stepping.linear_until:g} on every {stepping.cone_angle:.1%} of the distance"
    growing = cone if stepping.cone_angle else ""
    if config.space == "ndc":
        places = f"samples every {stepping.step_size / (2 * Ndc.half):.2%} of 1 / depth from near to infinity"
    else:
        places = f"samples every {stepping.step_size:.2g} scene units{growing}"
    assert grid.micro_batches, "plan() chooses it"
    parts = counted(grid.micro_batches, "micro-batch", "micro-batches")
    step = f"{grid.target_samples:,} colours a step in {parts}, by {grid.backend}"
    return f"{step} · {places}"


def make_trainer(
    config: Config, scene: "Scene", dataset: "RayDataset", seed: int, effects: ImageEffects
) -> HashGridTrainer | GraphTrainer:
    """A fresh field with its trainer, where ``dataset`` is."""
    assert config.grid.backend, "plan() chooses it"
    backend = load_backend(config.grid.backend, dataset.device.type)
    settings = field_settings(config, has_background_model(config, scene), space_map_of(config, scene))
    model = HashGridField(settings, seed, backend).to(dataset.device)
    trainer = HashGridTrainer(model, dataset, _trainer_settings(config, scene, seed), effects)
    return GraphTrainer(trainer) if backend.CAPTURABLE and dataset.device.type == "cuda" else trainer


def field_settings(config: Config, background_model: bool, space: SpaceMap | None = None) -> HashGridSettings:
    """Sizes of the field. Samples stand as close as the finest cells can tell them apart: in contracted space a third
    to two thirds of a cell near the camera, growing with the distance, as pixels do; in a box a cell, or more where
    MAX_STEPS says so. Sizes and steps alone need no ``space`` of a scene."""
    grid = config.grid
    assert grid.num_levels and grid.log2_hashmap_size and grid.max_res, "plan() chooses them"
    assert config.space is not None and config.view_dependence is not None, "plan() chooses them"
    across = math.sqrt(3) * grid.max_res
    in_box = min(across, max(MAX_STEPS, grid.max_res))
    steps = NDC_STEPS_PER_CELL * grid.max_res if config.space == "ndc" else in_box
    shortest = 2 * Contraction.half / (_steps_across(grid.max_res) * grid.ray_samples)
    return HashGridSettings(
        num_levels=grid.num_levels,
        log2_hashmap_size=grid.log2_hashmap_size,
        base_res=min(BASE_RES[_space(config)], grid.max_res),
        max_res=grid.max_res,
        space=space or map_without_scene(config),
        diagonal_steps=max(1, round(grid.ray_samples * steps)),
        min_step_size=shortest,
        cone_angle=shortest / EVEN_UNTIL,
        max_samples_per_ray=math.ceil(MAX_SAMPLES * max(1.0, grid.ray_samples)),
        view_dependence=config.view_dependence,
        background_model=background_model,
    )


def _steps_across(max_res: int) -> float:
    """The shortest steps that fit along an axis of contracted space whose finest cells are so many."""
    return max(per_cell * min(max_res, most) for most, per_cell in STEPS_PER_CELL.items())


def _trainer_settings(config: Config, scene: "Scene", seed: int) -> HashGridTrainerSettings:
    grid = config.grid
    assert grid.target_samples and grid.micro_batches and config.learning_rate, "plan() chooses them"
    tolerance = backdrop_tolerance(config, scene)
    return HashGridTrainerSettings(
        seed=seed,
        background=training_background(config, scene),
        target_samples=grid.target_samples,
        micro_batches=grid.micro_batches,
        learning_rate=config.learning_rate,
        distortion_weight=BACKDROP_DISTORTION if tolerance else DISTORTION[_space(config)],
        depth_weight=DEPTH_LOSS,
        backdrop_tolerance=tolerance,
        min_photos=MIN_PHOTOS,
        long_steps_until=LONG_STEPS_UNTIL[_space(config)] if compute_device() == "cpu" and not config.after else 0.0,
    )
