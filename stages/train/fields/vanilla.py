"""The vanilla NeRF as stage train has it: what it is trained with by default, how large it is, what a step costs."""

from typing import TYPE_CHECKING, Any

from nerf.effects import ImageEffects
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.space_maps import SpaceMap
from nerf.training.vanilla_trainer import CHUNK_RAYS, VanillaTrainer, VanillaTrainerSettings
from stages.contract import Progress
from stages.hardware.device import compute_device, cores
from stages.train.config import Config
from stages.train.data import backdrop_tolerance, training_background
from stages.train.fields.space import map_without_scene, space_map_of

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from nerf.training.ray_dataset import RayDataset

# The reduced networks have few steps and take large ones: after 300 of 512 rays on lego_400 at a quarter of its size a
# start at 5e-4 gave 14.7 dB held out, 2e-3 17.4, 5e-3 19.1. The published ones are those of the released lego config.
REDUCED: dict[str, Any] = {
    "learning_rate": 5e-3,
    "vanilla": {"depth": 4, "width": 64, "skip": 4, "samples_coarse": 32, "samples_fine": 32, "batch_rays": 512},
}
PUBLISHED: dict[str, Any] = {
    "learning_rate": 5e-4,
    "vanilla": {"depth": 8, "width": 256, "skip": 4, "samples_coarse": 64, "samples_fine": 128, "batch_rays": 1024},
}
FINAL_LEARNING_RATE = 0.1  # of that at the start
MAX_TIMED_RAYS = {"cpu": 256, "cuda": 1 << 20}
"""For each core: one chunk of a batch. More keep a CPU no busier and make the published model's steps long; a GPU needs
many."""
ACTIVATIONS_PER_LAYER = 2  # numbers kept of each unit for its gradient


def with_defaults(config: Config) -> Config:
    """``config`` with what this field is usually trained with where it leaves that open."""
    spacing = {"vanilla": {"spacing": "log" if config.space == "contracted" else "linear"}}
    sizes = PUBLISHED if config.preset == "paper" else REDUCED
    return config.filled({"background": "white"}).filled(spacing).filled(sizes)


def prepared(config: Config, progress: Progress) -> Config:
    """``config``: torch runs anywhere."""
    return config


def is_sized(config: Config) -> bool:
    """Whether ``config`` leaves no size of the field open: defaults tell them all."""
    return True


def with_sizes(config: Config, scene: "Scene", rays: float, progress: Progress | None = None) -> Config:
    """``config``: no size depends on the budget."""
    return config


def timed(config: Config) -> Config:
    """``config`` under which speed is measured: with no more rays in a step than it takes to be as fast."""
    rays = {"batch_rays": min(rays_per_step(config), MAX_TIMED_RAYS[compute_device()] * cores())}
    return config.model_copy(update={"vanilla": config.vanilla.model_copy(update=rays)})


def rays_per_step(config: Config) -> int:
    """Rays of one step."""
    assert config.vanilla.batch_rays is not None, "plan() chooses it"
    return config.vanilla.batch_rays


def work(config: Config, rays: float) -> str:
    """What so many rays take, beside drawing them: each of them the same."""
    return ""


def memory_bytes(config: Config) -> float:
    """Memory on the CPU that training takes beside the photos: each core computes a chunk of rays."""
    sizes = field_settings(config, map_without_scene(config))
    rays = min(CHUNK_RAYS["cpu"], rays_per_step(config))
    samples = rays * (2 * sizes.samples_coarse + sizes.samples_fine)
    return cores() * ACTIVATIONS_PER_LAYER * 4 * samples * sizes.width * sizes.depth


def memory_advice(config: Config) -> tuple[str, str]:
    """What takes that memory, and how it would take less."""
    why = f"{sizes_in_words(config)} networks on {cores()} cores at a time take"
    options = "--train.vanilla.width, --train.vanilla.batch-rays or --train.vanilla.samples-fine"
    return why, f"Give a smaller {options}, or fewer cores (taskset)."


def multiplies_by_torch(config: Config) -> bool:
    """All of it."""
    return True


def matmul_width(config: Config) -> int:
    """Of the matrix multiplications."""
    assert config.vanilla.width, "plan() chooses it"
    return config.vanilla.width


def table_rows(config: Config) -> int:
    """Rows of features that are read at random: there is no table."""
    return 1


def sizes_in_words(config: Config) -> str:
    """``8 × 256``."""
    return f"{config.vanilla.depth} × {config.vanilla.width}"


def step_in_words(config: Config) -> str | None:
    """Nothing: a step is as published."""
    return None


def make_trainer(
    config: Config, scene: "Scene", dataset: "RayDataset", seed: int, effects: ImageEffects
) -> VanillaTrainer:
    """A fresh field with its trainer, where ``dataset`` is."""
    assert config.learning_rate is not None, "plan() chooses it"
    model = VanillaNerf(field_settings(config, space_map_of(config, scene)), seed).to(dataset.device)
    settings = VanillaTrainerSettings(
        batch_rays=rays_per_step(config),
        seed=seed,
        background=training_background(config, scene),
        initial_learning_rate=config.learning_rate,
        final_learning_rate=config.learning_rate * FINAL_LEARNING_RATE,
        backdrop_tolerance=backdrop_tolerance(config, scene),
    )
    return VanillaTrainer(model, dataset, settings, effects)


def field_settings(config: Config, space: SpaceMap) -> VanillaSettings:
    """Sizes and ablations of the field."""
    assert config.view_dependence is not None, "plan() takes it from stage effects"
    sizes = config.vanilla.model_dump(exclude={"batch_rays"})
    return VanillaSettings(space=space, view_dependence=config.view_dependence, **sizes)
