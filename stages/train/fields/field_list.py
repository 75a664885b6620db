"""The fields that stage train knows, and what each of them answers."""

from typing import TYPE_CHECKING, Protocol

from nerf.effects import NO_EFFECTS, ImageEffects
from nerf.training.trainer import FieldTrainer
from stages.contract import Progress
from stages.train.config import Config, FieldName
from stages.train.fields import hash_grid, vanilla

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from nerf.training.ray_dataset import RayDataset


class Field(Protocol):
    """What the module of a field answers. The settings that it is asked about are, but for
    ``with_defaults``, those that this has filled in."""

    def with_defaults(self, config: Config) -> Config:
        """``config`` with what the field is usually trained with where it leaves that open."""
        ...

    def prepared(self, config: Config, progress: Progress) -> Config:
        """``config`` with what computes the field here, ready to run."""
        ...

    def is_sized(self, config: Config) -> bool:
        """Whether ``config`` leaves no size of the field open."""
        ...

    def with_sizes(self, config: Config, scene: "Scene", rays: float, progress: Progress | None = None) -> Config:
        """``config`` with the sizes, where open, of a field that sees so many rays of the scene."""
        ...

    def timed(self, config: Config) -> Config:
        """``config`` under which speed is measured before sizes are known."""
        ...

    def rays_per_step(self, config: Config) -> float:
        """Rays of one step."""
        ...

    def work(self, config: Config, rays: float) -> str:
        """What so many rays take, beside drawing them; "" where each takes the same."""
        ...

    def memory_bytes(self, config: Config) -> float:
        """Memory on the CPU that training takes beside the photos."""
        ...

    def memory_advice(self, config: Config) -> tuple[str, str]:
        """What takes that memory, and how it would take less."""
        ...

    def matmul_width(self, config: Config) -> int:
        """Of the matrix multiplications."""
        ...

    def multiplies_by_torch(self, config: Config) -> bool:
        """Whether torch's precision is that of the matrix multiplications."""
        ...

    def table_rows(self, config: Config) -> int:
        """Rows of features that are read at random, 1 without a table."""
        ...

    def sizes_in_words(self, config: Config) -> str:
        """The sizes of the field."""
        ...

    def step_in_words(self, config: Config) -> str | None:
        """How a step is computed, where that is worth a line."""
        ...

    def make_trainer(
        self,
        config: Config,
        scene: "Scene",
        dataset: "RayDataset",
        seed: int,
        effects: ImageEffects,
    ) -> FieldTrainer:
        """A fresh field with its trainer, where ``dataset`` is."""
        ...


FIELDS: dict[FieldName, Field] = {"grid": hash_grid, "vanilla": vanilla}


def field_of(config: Config) -> Field:
    """The field that ``config`` asks for."""
    return FIELDS[config.kind]


def with_defaults(config: Config) -> Config:
    """``config`` with what its field is usually trained with where it leaves that open."""
    return field_of(config).with_defaults(config)


def make_trainer(
    config: Config,
    scene: "Scene",
    dataset: "RayDataset",
    seed: int,
    effects: ImageEffects = NO_EFFECTS,
) -> FieldTrainer:
    """A fresh field of the kind that ``config`` asks for, with its trainer, where ``dataset`` is. ``effects`` stand
    between it and the photos."""
    return field_of(config).make_trainer(config, scene, dataset, seed, effects)
