"""Stage train: photos and cameras become a radiance field."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from stages.contract import Inputs, Progress, StageConfig, StageResult
from stages.files import read_scene, write_json
from stages.live_line import short_count

if TYPE_CHECKING:
    from stages.training_loop import TrainingRun

NEEDS = ("ingest", "normalise")
VERSION = 1
RESUMES = True
LINKS = ("curve.json",)

DEFAULT_SECONDS = 180.0
# The small field has few steps and takes large ones: after 300 of 512 rays on lego_400 at a quarter of its size a
# start at 5e-4 gave 14.7 dB held out, 2e-3 17.4, 5e-3 19.1. The paper's are those of its released lego config.
PRESETS = {
    "small": {
        "depth": 4,
        "width": 64,
        "skip": 4,
        "samples_coarse": 32,
        "samples_fine": 32,
        "batch_rays": 512,
        "learning_rate": 5e-3,
    },
    "paper": {
        "depth": 8,
        "width": 256,
        "skip": 4,
        "samples_coarse": 64,
        "samples_fine": 128,
        "batch_rays": 1024,
        "learning_rate": 5e-4,
    },
}


class Config(StageConfig):
    """How to train. None is chosen for you: sizes by the preset, the rest by the scene and the budget."""

    preset: Literal["small", "paper"] | None = Field(
        default=None, description="sizes: paper is as published, none is small"
    )
    steps: int | None = Field(default=None, ge=1, description="train so many steps, with the same result every time")
    seconds: float | None = Field(
        default=None, gt=0, description="train so long; none, without steps, is three minutes"
    )
    batch_rays: int | None = Field(default=None, ge=1, description="rays in a step; none: by the preset")
    learning_rate: float | None = Field(
        default=None, gt=0, description="at the start, falling to a tenth; none: by the preset"
    )
    seed: int = Field(default=0, description="of weights, batches and samples")
    downscale: float | None = Field(
        default=None, ge=1, description="photo width / trained width; none: as the budget allows"
    )
    background: Literal["white", "black", "random"] = Field(
        default="white", description="behind photos with transparency"
    )

    depth: int | None = Field(default=None, ge=1, description="layers before the density")
    width: int | None = Field(default=None, ge=2, description="of each layer")
    skip: int | None = Field(default=None, ge=0, description="index of the layer after which the position enters again")
    position_frequencies: int = Field(default=10, ge=1, description="L of the positional encoding of the position")
    direction_frequencies: int = Field(default=4, ge=1, description="L of the positional encoding of the direction")
    samples_coarse: int | None = Field(default=None, ge=2, description="on each ray, for the coarse network")
    samples_fine: int | None = Field(
        default=None, ge=1, description="on each ray, placed by the coarse network's weights"
    )
    view_dependence: bool = Field(default=True, description="let colour depend on the direction")
    positional_encoding: bool = Field(default=True, description="lift coordinates to sines and cosines")
    hierarchical: bool = Field(default=True, description="place fine samples by a coarse network")
    density_activation: Literal["softplus", "relu"] = Field(default="softplus", description="relu is as published")
    contracted: bool | None = Field(default=None, description="fold in unbounded space; none: if the photos show any")
    spacing: Literal["linear", "log"] | None = Field(
        default=None, description="of coarse samples; none: log if contracted"
    )

    checkpoint_seconds: float = Field(default=30.0, gt=0, description="between checkpoints")
    tensorboard: bool = Field(default=False, description="write the curve for TensorBoard, too")

    @model_validator(mode="after")
    def _one_budget(self) -> "Config":
        if self.steps is not None and self.seconds is not None:
            raise ValueError(f"steps ({self.steps}) and seconds ({self.seconds:g}) are two budgets; give one")
        return self


def plan(config: Config, inputs: Inputs) -> Config:
    """Everything that was left open: preset and sizes, budget, contraction from the scene, then the photos' size."""
    scene = read_scene(inputs["normalise"])
    preset = config.preset or "small"
    contracted = not scene.bounded if config.contracted is None else config.contracted
    chosen: dict[str, Any] = {
        "preset": preset,
        "seconds": DEFAULT_SECONDS if config.steps is None and config.seconds is None else config.seconds,
        "contracted": contracted,
        "spacing": config.spacing or ("log" if contracted else "linear"),
    }
    chosen |= {name: value for name, value in PRESETS[preset].items() if getattr(config, name) is None}
    config = config.model_copy(update=chosen)
    if config.downscale is None:
        from stages.training_setup import rays_in_budget
        from stages.training_size import chosen_downscale

        config = config.model_copy(update={"downscale": chosen_downscale(scene, rays_in_budget(config, scene))})
    return config


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Train, and write the field with the record of how it came about.

    Raises:
        StageError: if training diverges or the field does not learn, every remedy of ours having failed.
    """
    from stages.field_files import save_field
    from stages.training_setup import field_background, prepare

    config, scene = plan(config, inputs), read_scene(inputs["normalise"])
    training = prepare(config, scene, inputs, folder, progress)
    training.train()
    info = {"downscale": config.downscale, "steps": training.state.step, "rays": training.state.rays}
    info["background"] = list(field_background(config, scene))
    save_field(folder, training.trainer.model, info)
    write_json(folder / "curve.json", training.state.curve)
    return _result(config, training, folder)


def _result(config: Config, training: "TrainingRun", folder: Path) -> StageResult:
    state, last = training.state, training.state.curve[-1]
    speed = state.rays / state.seconds
    heldout = last["heldout_psnr"]
    quality = "no photos held out" if heldout is None else f"held out {heldout:.1f} dB"
    line = f"{state.seconds:.0f} s · {short_count(state.step)} steps · {short_count(speed)} rays/s · {quality}"
    left_behind = sorted(path.name for path in folder.glob("nonfinite_*.safetensors"))
    board = ["tensorboard"] if config.tensorboard else []
    facts = {
        "field": config.preset,
        "steps": state.step,
        "train_seconds": round(state.seconds, 3),
        "rays_per_second": round(speed, 1),
        "train_psnr": last["train_psnr"],
        "heldout_psnr": heldout,
        "curve": state.curve[-5:],
        "downscale": config.downscale,
        "restarts": state.restarts,
        "rollbacks": state.rollbacks,
    }
    records = ("curve.json", "log.jsonl", "plan.json", *left_behind, *board)
    return StageResult(("field.safetensors", "field.json"), line, records, facts)
