"""The options of stage train: what the command line, a file and a caller from Python may ask for."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from tyro.conf import Suppress, arg

from stages.contract import Options, StageConfig
from stages.effects.decisions import Space
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions

# Of training, where neither seconds nor steps are given.
SECONDS = {"draft": 30.0, "standard": 180.0, "high": 900.0, "paper": 3600.0}
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)

FieldName = Literal["grid", "vanilla"]
"""Each has its own options in :class:`Config` under its name."""
FIELD_NAMES: tuple[FieldName, ...] = get_args(FieldName)
OPTIONS_OF_FIELD: dict[FieldName, type[HashGridOptions | VanillaOptions]] = {
    "grid": HashGridOptions,
    "vanilla": VanillaOptions,
}
DEFAULT_FIELD: FieldName = "grid"
PRESET_FIELDS: dict[str, FieldName] = {"paper": "vanilla"}  # the field that a preset asks for, where it does


class Config(StageConfig):
    """How to train. None is chosen for you, by the scene and the budget.

    The options of a field ask for that field. What is written down holds those of no other one.
    """

    field: FieldName | None = Field(
        default=None, description="grid: minutes without a GPU; vanilla: the published networks (default: grid)"
    )
    steps: int | None = Field(
        default=None, ge=1, description="train so many steps; on a CPU with the same result every time"
    )
    preset: Literal["draft", "standard", "high", "paper"] | None = Field(
        default=None,
        description="draft, standard, high: train for half a minute, three, fifteen, in sizes to match; "
        "paper: the vanilla NeRF as published, for an hour (default: standard)",
    )
    seconds: float | None = Field(default=None, gt=0, description="train so long (default: from the preset)")
    target_psnr: Annotated[float | None, arg(aliases=("--target-psnr",))] = Field(
        default=None,
        gt=0,
        le=100,
        description="stop once so many dB are reached on validation photos, set aside from the training photos; at "
        "the latest when the time or the steps are used up",
    )
    learning_rate: float | None = Field(default=None, gt=0, description="at the start (default: from the field)")
    seed: int = Field(default=0, description="of weights, batches and samples")
    downscale: float | None = Field(
        default=None, ge=1, description="photo width / trained width (default: as the budget allows)"
    )
    background: Literal["white", "black", "random"] | None = Field(
        default=None, description="behind photos with transparency (default: random for grid, white for vanilla)"
    )
    space: Space | None = Field(
        default=None,
        description="bounded: the region of interest alone; contracted: all of space; ndc: all that cameras which face "
        "one way can see (default: by the background and how the cameras stand)",
    )
    matmul: Literal["highest", "medium"] | None = Field(
        default=None,
        description="torch's precision of matrix products (default: highest; of a run in seconds medium where that is "
        "measured to be faster and about as exact)",
    )
    # `--more` gives these.
    after: Annotated[str | None, Suppress] = Field(default=None, description="go on from this finished training,")
    more_steps: Annotated[int | None, Suppress] = Field(default=None, ge=1, description="for so many steps,")
    more_seconds: Annotated[float | None, Suppress] = Field(default=None, gt=0, description="or for so long")
    # Stage effects decides it; no flag is offered.
    view_dependence: Annotated[bool | None, Suppress] = Field(default=None, description="colour knows the direction")

    grid: HashGridOptions = HashGridOptions()
    vanilla: VanillaOptions = VanillaOptions()

    checkpoint_seconds: float | None = Field(
        default=None, gt=0, description="between checkpoints (default: a twentieth of the seconds, 30 at most)"
    )
    tensorboard: bool = Field(default=False, description="write the curve for TensorBoard, too")

    @model_validator(mode="after")
    def _one_budget(self) -> "Config":
        if self.steps is not None and self.seconds is not None:
            given = f"--train.steps {self.steps} and --train.seconds {self.seconds:g}"
            raise ValueError(f"{given} are two budgets; give one")
        return self

    @model_validator(mode="after")
    def _one_field(self) -> "Config":
        first, *others = self._flags_by_field().values() or [""]
        if others:
            raise ValueError(f"{others[0]} has no effect with {first}; leave out one of the two")
        return self

    @model_serializer(mode="wrap")
    def _without_other_fields(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        others = {name for name in FIELD_NAMES if name != self.kind}
        return {name: value for name, value in serialise(self).items() if name not in others}

    def _flags_by_field(self) -> dict[FieldName, str]:
        """By each field that these options ask for the first flag that does."""
        flags: dict[FieldName, str] = {}
        if self.field is not None:
            flags[self.field] = f"--train.field {self.field}"
        if (field := PRESET_FIELDS.get(self.preset or "")) is not None:
            flags.setdefault(field, f"--train.preset {self.preset}")
        for field in FIELD_NAMES:
            options: Options = getattr(self, field)
            for name, option in type(options).model_fields.items():
                if getattr(options, name) != option.default:
                    flags.setdefault(field, f"--train.{field}.{name.replace('_', '-')}")
        return flags

    @property
    def kind(self) -> FieldName:
        """The field that these options ask for."""
        asked: tuple[FieldName, ...] = (*self._flags_by_field(), DEFAULT_FIELD)
        return asked[0]

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
