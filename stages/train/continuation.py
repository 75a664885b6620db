"""Continuing a finished training: with its settings, photos and cameras, for longer.

A training is named ``<key>/<digest>``: the first KEY_LENGTH digits of its key, which name its folder in the
workspace, and of the digest of its outputs. So the name says what was trained and not where it lies.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

from stages.contract import KEY_LENGTH, Inputs, Options, StageError
from stages.io.files import read_json
from stages.train.config import Config
from stages.train.state import TrainingBudget

MORE_OPTIONS = ("after", "more_steps", "more_seconds")
OWN_OPTIONS = ("checkpoint_seconds", "devices", "tensorboard")  # of each part of a training
# Replaced by the additional budget, or without influence on the field.
IGNORED_OPTIONS = (*MORE_OPTIONS, "steps", "seconds", "preset", *OWN_OPTIONS)
RESTART_HINT = "Train from the start with --train.seconds or --train.steps."


def training_name(key: str, outputs_digest: str) -> str:
    """The name of a finished training."""
    return f"{key[:KEY_LENGTH]}/{outputs_digest[:KEY_LENGTH]}"


def cannot_continue(code: str, why: str) -> StageError:
    """The error for a finished training whose last checkpoint is of no use here."""
    return StageError(code, "cannot continue training", why, "Train from the start, for longer, without --more.")


def finished_training_folder(name: str, inputs: Inputs) -> Path:
    """The folder of a finished training in the workspace of ``inputs``.

    Raises StageError if it is gone, or was trained again with another result.
    """
    key, digest = name.split("/")
    folder = inputs["effects"].parents[1] / "train" / key
    what = "cannot continue training"
    if not (folder / "manifest.json").is_file():
        raise StageError("train.training-gone", what, f"the finished training {folder} is gone", RESTART_HINT)
    if not read_json(folder / "manifest.json")["outputs_digest"].startswith(digest):
        raise StageError(
            "train.training-changed",
            what,
            f"{folder} has been trained again since and holds another field",
            "Give --more again.",
        )
    return folder


def continued(config: Config, inputs: Inputs) -> Config:
    """The settings of the training that ``config`` continues, with the additional budget.

    Raises StageError if photos, cameras or settings have changed.
    """
    assert config.after is not None
    manifest = read_json(finished_training_folder(config.after, inputs) / "manifest.json")
    _same_inputs(manifest["inputs"], inputs)
    before = Config.model_validate(manifest["config"])
    free = {*IGNORED_OPTIONS, "target_psnr"} if before.target_psnr is not None else {*IGNORED_OPTIONS}
    if (change := next(_changes(config, before, free), None)) is not None:
        name, value, was = change
        hint = f"Give {_flag(name, was)}. {RESTART_HINT}"  # the other value is remembered
        why = f"{name} is {value} now and was {was}"
        raise StageError("train.other-settings", "cannot continue training with other settings", why, hint)
    own = {name: getattr(config, name) for name in (*MORE_OPTIONS, *OWN_OPTIONS)}
    target = {"target_psnr": config.target_psnr or before.target_psnr}
    return Config.model_validate(manifest["config"] | own | target)


def _changes(
    now: Options, before: Options, free: Collection[str] = (), prefix: str = ""
) -> Iterator[tuple[str, object, object]]:
    """Every option, except the ``free`` ones, that is given ``now`` and was another ``before``: its name, both
    values."""
    for name in type(now).model_fields.keys() - {*free}:
        value, was = getattr(now, name), getattr(before, name)
        if isinstance(value, Options):
            yield from _changes(value, was, prefix=f"{name}.")
        elif value is not None and value != was:
            yield f"{prefix}{name}", value, was


def _flag(name: str, value: object) -> str:
    """``--train.grid.num-levels 5``: what gives an option of training this value on the command line."""
    *groups, option = f"train.{name}".replace("_", "-").split(".")
    if isinstance(value, bool):
        return f"--{'.'.join([*groups, option if value else f'no-{option}'])}"
    return f"--{'.'.join([*groups, option])} {value}"


def _same_inputs(digests: dict[str, str], inputs: Inputs) -> None:
    now = {stage: read_json(inputs[stage] / "manifest.json")["outputs_digest"] for stage in digests}
    if changed := [stage for stage in digests if digests[stage] != now[stage]]:
        why = f"its inputs have changed since: {', '.join(changed)}"
        raise StageError("train.other-photos", "cannot continue training", why, RESTART_HINT)


def earlier_seconds(config: Config, inputs: Inputs) -> float:
    """The wall time of the trainings that ``config`` continues, as stages: reading, steps, saving; 0 for a new
    training."""
    if config.after is None:
        return 0.0
    manifest = read_json(finished_training_folder(config.after, inputs) / "manifest.json")
    return manifest["seconds"] + manifest["facts"].get("earlier_seconds", 0.0)


def budget_of(config: Config, inputs: Inputs) -> TrainingBudget:
    """How long to train, and which finished run to continue."""
    if config.after is None:
        return TrainingBudget(config.steps, config.seconds)
    return TrainingBudget(config.more_steps, config.more_seconds, finished_training_folder(config.after, inputs))
