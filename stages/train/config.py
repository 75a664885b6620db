"""The options of stage train: what the command line, a file and a caller from Python may ask for."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from tyro.conf import Suppress, arg

from stages.contract import Auto, Options, StageConfig
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
    """How the field is trained. Options that are left open follow from the scene and the training time.

    An option of a field selects that field. Only the options of the selected field are recorded.
    """

    field: Auto[FieldName] = Field(
        default=None,
        description=(
            "Radiance field: grid (a hash grid; minutes without a GPU) or vanilla (the original NeRF) (default: grid)."
        ),
    )
    steps: Auto[int] = Field(
        default=None,
        ge=1,
        description=(
            "Number of training steps; on one CPU, with as many cores, the result is the same every time (default: "
            "train for --train.seconds)."
        ),
    )
    preset: Auto[Literal["draft", "standard", "high", "paper"]] = Field(
        default=None,
        description=(
            "draft, standard, high: train for 30 s, 3 min, 15 min, with sizes to match; paper: the original NeRF "
            "for an hour (default: standard)."
        ),
    )
    seconds: Auto[float] = Field(default=None, gt=0, description="Training time in seconds (default: from the preset).")
    target_psnr: Annotated[Auto[float], arg(aliases=("--target-psnr",))] = Field(
        default=None,
        gt=0,
        le=100,
        description=(
            "Stop as soon as this PSNR in dB is reached on validation photos, which are taken from the training "
            "photos (default: train to the end)."
        ),
    )
    learning_rate: Auto[float] = Field(
        default=None, gt=0, description="Initial learning rate (default: from the field)."
    )
    seed: int = Field(default=0, description="Seed of weights, batches and samples.")
    depth: bool = Field(
        default=False, description="Supervise the hash-grid field by the depth maps of stage depth, which runs first."
    )
    downscale: Auto[float] = Field(
        default=None, ge=1, description="Photo width divided by trained width (default: as the training time allows)."
    )
    background: Auto[Literal["white", "black", "random"]] = Field(
        default=None, description="Background behind transparent pixels (default: random for grid, white for vanilla)."
    )
    space: Auto[Space] = Field(
        default=None,
        description=(
            "Space map of the field: the region of interest (bounded), all of space (contracted), or normalised "
            "device coordinates for a forward-facing capture (ndc) (default: from the background and the "
            "cameras)."
        ),
    )
    matmul: Auto[Literal["highest", "medium"]] = Field(
        default=None,
        description=(
            "Precision of torch's matrix multiplications (default: highest; medium for a run in seconds if it is "
            "measured to be faster and about as exact). Warp's kernels on a CPU do without it."
        ),
    )
    # `--more` gives these.
    after: Annotated[str | None, Suppress] = Field(
        default=None, description="The finished training to continue (default: a new training)."
    )
    more_steps: Annotated[int | None, Suppress] = Field(
        default=None, ge=1, description="Steps to add to it (default: none)."
    )
    more_seconds: Annotated[float | None, Suppress] = Field(
        default=None, gt=0, description="Seconds to add to it (default: none)."
    )
    # Stage effects decides it; no flag is offered.
    view_dependence: Annotated[bool | None, Suppress] = Field(
        default=None, description="Colour depends on the viewing direction (default: as stage effects decides)."
    )

    grid: HashGridOptions = HashGridOptions()
    vanilla: VanillaOptions = VanillaOptions()

    checkpoint_seconds: Auto[float] = Field(
        default=None,
        gt=0,
        description="Seconds between checkpoints (default: a twentieth of the training time, at most 30).",
    )
    devices: int = Field(
        default=1,
        ge=1,
        description=(
            "How many GPUs of this machine train together; without a GPU, how many processes on its CPU. torchrun "
            "starts its own."
        ),
    )
    tensorboard: bool = Field(default=False, description="Also write the learning curve for TensorBoard.")

    @model_validator(mode="after")
    def _one_budget(self) -> "Config":
        if self.steps is not None and self.seconds is not None:
            given = f"--train.steps {self.steps} and --train.seconds {self.seconds:g}"
            raise ValueError(f"{given} both set the training time; give one")
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
        if self.depth:
            flags.setdefault("grid", "--train.depth")
        if self.devices > 1:
            flags.setdefault("grid", "--train.devices")
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
