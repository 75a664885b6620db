"""Going on from the end of a finished training: with its settings, photos and cameras, for longer.

A training is named ``<key>/<digest>``: the first KEY_LENGTH digits of its key, which name its folder in the
workspace, and of the digest of its outputs. So the name says what was trained and not where it lies.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

from stages.contract import KEY_LENGTH, Inputs, Options, StageError
from stages.io.files import read_json
from stages.train.config import Config
from stages.train.state import TrainingBudget

OWN = ("after", "more_steps", "more_seconds")
# Replaced by the budget for more; or without influence on what is trained.
FREE = (*OWN, "steps", "seconds", "preset", "checkpoint_seconds", "tensorboard")
ANEW = "Give --train.seconds or --train.steps to train anew."


def training_name(key: str, outputs_digest: str) -> str:
    """The name of a finished training."""
    return f"{key[:KEY_LENGTH]}/{outputs_digest[:KEY_LENGTH]}"


def cannot_go_on(code: str, why: str) -> StageError:
    """The error for a finished training whose last state is of no use here."""
    return StageError(code, "training cannot go on", why, "Train anew, for longer, without --more.")


def earlier_training(name: str, inputs: Inputs) -> Path:
    """The folder of a finished training in the workspace of ``inputs``.

    Raises StageError where it is gone, or has been made again and become another.
    """
    key, digest = name.split("/")
    folder = inputs["effects"].parents[1] / "train" / key
    what = "training cannot go on"
    if not (folder / "manifest.json").is_file():
        raise StageError("train.training-gone", what, f"the training that it goes on from, {folder}, is gone", ANEW)
    if not read_json(folder / "manifest.json")["outputs_digest"].startswith(digest):
        raise StageError(
            "train.training-changed",
            what,
            f"{folder} was trained again since and is another field now",
            "Give --more again.",
        )
    return folder


def continued(config: Config, inputs: Inputs) -> Config:
    """The settings of the training that ``config`` goes on from, with the budget for more.

    Raises StageError where the two do not go together: photos, cameras or settings have changed.
    """
    assert config.after is not None
    manifest = read_json(earlier_training(config.after, inputs) / "manifest.json")
    _same_inputs(manifest["inputs"], inputs)
    before = Config.model_validate(manifest["config"])
    free = {*FREE, "target_psnr"} if before.target_psnr is not None else {*FREE}
    if (why := next(_changes(config, before, free), None)) is not None:
        raise StageError("train.other-settings", "training cannot go on with other settings", why, ANEW)
    own = {name: getattr(config, name) for name in (*OWN, "checkpoint_seconds", "tensorboard")}
    target = {"target_psnr": config.target_psnr or before.target_psnr}
    return Config.model_validate(manifest["config"] | own | target)


def _changes(now: Options, before: Options, free: Collection[str] = (), prefix: str = "") -> Iterator[str]:
    """In words, every option but the ``free`` ones that is given ``now`` and was another ``before``."""
    for name in type(now).model_fields.keys() - {*free}:
        value, was = getattr(now, name), getattr(before, name)
        if isinstance(value, Options):
            yield from _changes(value, was, prefix=f"{name}.")
        elif value is not None and value != was:
            yield f"{prefix}{name} is {value} now and was {was}"


def _same_inputs(digests: dict[str, str], inputs: Inputs) -> None:
    now = {stage: read_json(inputs[stage] / "manifest.json")["outputs_digest"] for stage in digests}
    if changed := [stage for stage in digests if digests[stage] != now[stage]]:
        why = f"what it was trained on has changed since: {', '.join(changed)}"
        raise StageError("train.other-photos", "training cannot go on", why, ANEW)


def earlier_seconds(config: Config, inputs: Inputs) -> float:
    """What the trainings that ``config`` goes on from took as stages, each with all that comes before and after its
    steps; 0 where it begins anew."""
    if config.after is None:
        return 0.0
    manifest = read_json(earlier_training(config.after, inputs) / "manifest.json")
    return manifest["seconds"] + manifest["facts"].get("earlier_seconds", 0.0)


def budget_of(config: Config, inputs: Inputs) -> TrainingBudget:
    """How long to train, and from where on."""
    if config.after is None:
        return TrainingBudget(config.steps, config.seconds)
    return TrainingBudget(config.more_steps, config.more_seconds, earlier_training(config.after, inputs))
