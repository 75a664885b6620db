"""The options of stage train: what the command line, a file and a caller from Python may ask for."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from tyro.conf import Suppress, arg

from stages.contract import StageConfig
from stages.effects.decisions import Space

# Of training, where neither seconds nor steps are given.
SECONDS = {"draft": 30.0, "standard": 180.0, "high": 900.0, "paper": 3600.0}
MAX_MICRO_BATCHES = 64  # of a step
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)

GRID_ONLY = ("backend", "chunks", "levels", "log2_rows", "finest", "batch_samples", "ray_samples")
PAPER_ONLY = (
    *("batch_rays", "depth", "width", "skip", "position_frequencies", "direction_frequencies"),
    *("samples_coarse", "samples_fine", "positional_encoding", "hierarchical"),
    *("density_activation", "spacing"),
)


class Config(StageConfig):
    """How to train. None is chosen for you, by the scene and the budget.

    The options of the paper field ask for that field: without one of them, none is the grid field.
    """

    field: Literal["grid", "paper"] | None = Field(
        default=None, description="grid: minutes without a GPU; paper: the published networks; none: grid"
    )
    steps: int | None = Field(
        default=None, ge=1, description="train so many steps; on a CPU with the same result every time"
    )
    preset: Literal["draft", "standard", "high", "paper"] | None = Field(
        default=None,
        description="draft, standard, high: train for half a minute, three, fifteen, in sizes to match; "
        "paper: the networks as published, for an hour; none: standard",
    )
    seconds: float | None = Field(default=None, gt=0, description="train so long; none, without steps: by the preset")
    target_psnr: Annotated[float | None, arg(aliases=("--target-psnr",))] = Field(
        default=None,
        gt=0,
        le=100,
        description="stop once so many dB are reached on validation photos, set aside from the training photos; at "
        "the latest when the time or the steps are used up",
    )
    learning_rate: float | None = Field(default=None, gt=0, description="at the start; none: by the field")
    seed: int = Field(default=0, description="of weights, batches and samples")
    downscale: float | None = Field(
        default=None, ge=1, description="photo width / trained width; none: as the budget allows"
    )
    background: Literal["white", "black", "random"] | None = Field(
        default=None, description="behind photos with transparency; none: random for grid, white for paper"
    )
    matmul: Literal["highest", "medium"] | None = Field(
        default=None,
        description="torch's precision of matrix products; none: highest, of a run in seconds medium where that is "
        "measured to be faster and about as exact",
    )
    # `--more` gives these.
    after: Annotated[str | None, Suppress] = Field(default=None, description="go on from this finished training,")
    more_steps: Annotated[int | None, Suppress] = Field(default=None, ge=1, description="for so many steps,")
    more_seconds: Annotated[float | None, Suppress] = Field(default=None, gt=0, description="or for so long")
    # Stage effects decides these; no flag is offered for them.
    contracted: Annotated[bool | None, Suppress] = Field(default=None, description="fold in unbounded space")
    view_dependence: Annotated[bool | None, Suppress] = Field(default=None, description="colour knows the direction")

    backend: Literal["warp", "torch"] | None = Field(
        default=None, description="grid: its kernels; none: warp where they run, torch runs anywhere"
    )
    chunks: int | None = Field(
        default=None,
        ge=1,
        le=MAX_MICRO_BATCHES,
        description="grid: parts of a step, each on a core; none: as many as cores",
    )
    levels: int | None = Field(default=None, ge=1, le=16, description="grid: grids of features")
    log2_rows: int | None = Field(default=None, ge=8, le=24, description="grid: rows of a grid's table, as power of 2")
    finest: int | None = Field(default=None, ge=16, le=4096, description="grid: cells along an axis of the finest grid")
    batch_samples: int | None = Field(default=None, ge=256, description="grid: colours computed in a step")
    ray_samples: float = Field(
        default=1.0, gt=0, le=16, description="grid: samples along a ray, times what suits its finest cells"
    )

    batch_rays: int | None = Field(default=None, ge=1, description="paper: rays in a step; none: by the preset")
    depth: int | None = Field(default=None, ge=1, description="paper: layers before the density")
    width: int | None = Field(default=None, ge=2, description="paper: of each layer")
    skip: int | None = Field(
        default=None, ge=0, description="paper: index of the layer after which the position enters again"
    )
    position_frequencies: int = Field(
        default=10, ge=1, description="paper: L of the positional encoding of the position"
    )
    direction_frequencies: int = Field(
        default=4, ge=1, description="paper: L of the positional encoding of the direction"
    )
    samples_coarse: int | None = Field(default=None, ge=2, description="paper: on each ray, for the coarse network")
    samples_fine: int | None = Field(
        default=None, ge=1, description="paper: on each ray, placed by the coarse network's weights"
    )
    positional_encoding: bool = Field(default=True, description="paper: lift coordinates to sines and cosines")
    hierarchical: bool = Field(default=True, description="paper: place fine samples by a coarse network")
    density_activation: Literal["softplus", "relu"] = Field(
        default="softplus", description="paper: relu is as published"
    )
    spacing: Literal["linear", "log"] | None = Field(
        default=None, description="paper: of coarse samples; none: log if contracted"
    )

    checkpoint_seconds: float | None = Field(
        default=None, gt=0, description="between checkpoints; none: a twentieth of the seconds, 30 at most"
    )
    tensorboard: bool = Field(default=False, description="write the curve for TensorBoard, too")

    @model_validator(mode="after")
    def _one_budget(self) -> "Config":
        if self.steps is not None and self.seconds is not None:
            raise ValueError(f"steps ({self.steps}) and seconds ({self.seconds:g}) are two budgets; give one")
        return self

    @model_validator(mode="after")
    def _one_field(self) -> "Config":
        of_grid, of_paper = self._given(GRID_ONLY), self._given(PAPER_ONLY)
        if self.preset == "paper":
            of_paper.insert(0, "preset (paper)")
        if of_grid and of_paper:
            raise ValueError(f"{of_grid[0]} belongs to the grid field and {of_paper[0]} to the paper field; choose one")
        if wrong := {"grid": of_paper, "paper": of_grid, None: []}[self.field]:
            raise ValueError(f"{wrong[0]} does not belong to the {self.field} field; leave out one of the two")
        return self

    @property
    def kind(self) -> Literal["grid", "paper"]:
        """The field that these options ask for."""
        return self.field or ("paper" if self.preset == "paper" or self._given(PAPER_ONLY) else "grid")

    @property
    def space(self) -> Space:
        """Which of the measured constants count."""
        return "contracted" if self.contracted else "bounded"

    def _given(self, names: tuple[str, ...]) -> list[str]:
        """Which of these options differ from their defaults, with their values."""
        values = {name: getattr(self, name) for name in names}
        return [f"{n} ({value})" for n, value in values.items() if value != type(self).model_fields[n].default]

    def filled(self, values: dict[str, Any]) -> "Config":
        """These options with ``values`` where they are None."""
        return self.model_copy(update={name: v for name, v in values.items() if getattr(self, name) is None})

    @property
    def time_is_open(self) -> bool:
        """Whether neither seconds nor steps are given, nor those of ``--more``."""
        return self.seconds is None and self.steps is None and self.after is None

    @property
    def exempt_from_budget(self) -> bool:
        """A training that goes on (``--more``) has a time of its own."""
        return self.after is not None

    @property
    def planned_seconds(self) -> float | None:
        """Of a training from the beginning: those asked for, or the preset's; None where it counts steps."""
        return None if self.steps is not None else self.seconds or SECONDS[self.preset or "standard"]
