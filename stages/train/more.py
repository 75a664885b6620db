"""Going on from the end of a finished training: with its settings, photos and cameras, for longer.

A training is named ``<key>/<digest>``: the first KEY_LENGTH digits of its key, which name its folder in the
workspace, and of the digest of its outputs. So the name says what was trained and not where it lies.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.amounts import duration
from stages.contract import KEY_LENGTH, Inputs, StageError
from stages.io.files import read_json

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from stages.train import Config
    from stages.train.state import TrainingBudget

OWN = ("after", "more_steps", "more_seconds")
# Replaced by the budget for more; or without influence on what is trained.
FREE = (*OWN, "steps", "seconds", "preset", "checkpoint_seconds", "tensorboard")
ANEW = "Give --train.seconds or --train.steps to train anew."
NAMED_GAIN = 0.2  # of the photos' width: what larger photos have to have before they are worth a word


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


def continued(config: "Config", inputs: Inputs) -> "Config":
    """The settings of the training that ``config`` goes on from, with the budget for more.

    Raises StageError where the two do not go together: photos, cameras or settings have changed.
    """
    assert config.after is not None
    manifest = read_json(earlier_training(config.after, inputs) / "manifest.json")
    _same_inputs(manifest["inputs"], inputs)
    settings: dict[str, Any] = manifest["config"]
    given = {name: value for name, value in config.model_dump(mode="json").items() if value is not None}
    free = {*FREE, "target_psnr"} if settings["target_psnr"] is not None else FREE
    for name, value in given.items():
        if name not in free and value != settings.get(name):
            why = f"{name} is {value} now and was {settings.get(name)}"
            raise StageError("train.other-settings", "training cannot go on with other settings", why, ANEW)
    own = {name: getattr(config, name) for name in (*OWN, "checkpoint_seconds", "tensorboard")}
    target = {"target_psnr": config.target_psnr or settings["target_psnr"]}
    return type(config).model_validate(settings | own | target)


def larger_photos_words(config: "Config", inputs: Inputs, scene: "Scene", used: Mapping[str, float]) -> str | None:
    """That as long a training from the start would take photos larger by more than NAMED_GAIN than those of ``config``,
    which goes on with what it has; None where it would not. ``used``: as for :func:`chosen_downscale`."""
    from stages.train.size import chosen_downscale, rays_per_step

    assert config.after is not None and config.downscale is not None, "continued() has them"
    folder = earlier_training(config.after, inputs)
    before = read_json(folder / "field.json")
    if config.more_steps is not None:
        steps = before["steps"] + config.more_steps
        longer, much, anew = steps / before["steps"], f"{steps:,} steps", f"--train.steps {steps}"
    else:
        assert config.more_seconds is not None, "one of the two is given"
        trained = read_json(folder / "manifest.json")["facts"]["train_seconds"]
        seconds = trained + config.more_seconds
        longer, much = seconds / trained, duration(seconds)
        anew = f"--train.seconds {seconds:.0f}, or a larger --budget,"
    would = chosen_downscale(scene, before["steps"] * rays_per_step(config) * longer, used)
    if config.downscale <= (1 + NAMED_GAIN) * would:
        return None
    stay = f"photos stay at 1/{config.downscale:g} of their size and the field as large as it is"
    return f"{stay}; {much} from the start would have them at 1/{would:g}: {anew} trains anew"


def _same_inputs(digests: dict[str, str], inputs: Inputs) -> None:
    now = {stage: read_json(inputs[stage] / "manifest.json")["outputs_digest"] for stage in digests}
    if changed := [stage for stage in digests if digests[stage] != now[stage]]:
        why = f"what it was trained on has changed since: {', '.join(changed)}"
        raise StageError("train.other-photos", "training cannot go on", why, ANEW)


def earlier_seconds(config: "Config", inputs: Inputs) -> float:
    """What the trainings that ``config`` goes on from took as stages, each with all that comes before and after its
    steps; 0 where it begins anew."""
    if config.after is None:
        return 0.0
    manifest = read_json(earlier_training(config.after, inputs) / "manifest.json")
    return manifest["seconds"] + manifest["facts"].get("earlier_seconds", 0.0)


def budget_of(config: "Config", inputs: Inputs) -> "TrainingBudget":
    """How long to train, and from where on."""
    from stages.train.state import TrainingBudget

    if config.after is None:
        return TrainingBudget(config.steps, config.seconds)
    return TrainingBudget(config.more_steps, config.more_seconds, earlier_training(config.after, inputs))
