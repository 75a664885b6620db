"""What stage effects decided, as the stages after it read it: ``decisions.json``."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal

from stages.effects.effect_list import EFFECTS
from stages.io.files import read_dataclass, write_json

if TYPE_CHECKING:
    import torch

    from nerf.effects import ImageEffects
    from nerf.geometry.scene import Scene, View
    from nerf.training.ray_dataset import RayDataset
    from nerf.training.trainer import FieldTrainer

Space = Literal["bounded", "contracted"]


@dataclass(frozen=True)
class Decisions:
    """``on``: by the name of each effect that is modelled what it begins with: numbers by the name of each training
    photo (as exposure has natural logarithms of gains in linear light), or nothing."""

    on: dict[str, dict[str, list[float]]] = field(default_factory=dict)

    @property
    def space(self) -> Space:
        """What the field lies in: the box, or all of space, contracted."""
        return "contracted" if "background" in self.on else "bounded"

    def having(self, name: str, measured: dict[str, list[float]] | None = None) -> "Decisions":
        """These, with one effect more."""
        return Decisions({**self.on, name: measured or {}})

    def without(self, name: str) -> "Decisions":
        """These, with one effect less."""
        return Decisions({other: measured for other, measured in self.on.items() if other != name})


def write_decisions(folder: Path, decisions: Decisions) -> None:
    """Write decisions.json."""
    write_json(folder / "decisions.json", asdict(decisions))


def read_decisions(folder: Path) -> Decisions:
    """Read decisions.json. Raises StageError where it is missing or damaged."""
    return read_dataclass(folder / "decisions.json", Decisions)


def image_effects(decisions: Decisions, views: "Sequence[View]", dataset: "RayDataset") -> "ImageEffects":
    """What stands between the field and the photos ``views`` of ``dataset``, in their order."""
    import numpy as np
    import torch

    from nerf.effects import NO_EFFECTS, ImageEffects, TrainingImages

    rays, colours = [], []
    modelled = [(effect.name, effect.load()) for effect in EFFECTS if effect.name in decisions.on]
    if not any(parts.rays or parts.colours for _, parts in modelled):
        return NO_EFFECTS
    poses = np.stack([view.scene_from_camera for view in views])
    images = TrainingImages(torch.tensor(poses, dtype=torch.float32, device=dataset.device), dataset.viewing_distance)
    for name, parts in modelled:
        measured = None
        if rows := decisions.on[name]:
            measured = torch.tensor([rows[view.name] for view in views], device=dataset.device)
        if parts.rays:
            rays.append(parts.rays(images, measured))
        if parts.colours:
            colours.append(parts.colours(images, measured))
    return ImageEffects(tuple(rays), tuple(colours))


def told_by_neighbours(scene: "Scene", unseen: "Sequence[View]") -> "torch.Tensor":
    """(unseen, training photos): how much each training photo tells of each photo that took no part in training."""
    import numpy as np
    import torch

    from nerf.geometry.pose_distance import neighbour_weights

    poses, known = (np.stack([v.scene_from_camera for v in views]) for views in (unseen, scene.of_split("train")))
    return torch.from_numpy(neighbour_weights(poses, known)).float()


def expected_gains(field: dict[str, Any], scene: "Scene", unseen: "Sequence[View]") -> "dict[str, torch.Tensor]":
    """By the name of a photo that took no part in training, the log gains (3,) that its neighbours let expect, from the
    content of field.json; empty where exposure is not modelled."""
    import torch

    if field.get("exposure") is None or not unseen:
        return {}
    photos = field["exposure"]["photos"]  # of all training photos but those that were set aside for a target
    scene = replace(scene, views=tuple(view for view in scene.views if view.name in photos))
    known = torch.tensor([photos[view.name] for view in scene.of_split("train")])
    gains = told_by_neighbours(scene, unseen) @ known
    return dict(zip((view.name for view in unseen), gains, strict=True))


def neutral_in_words(field: dict[str, Any]) -> str | None:
    """At which exposure a field with this field.json is shown, in stops (EV) above the photo with the least one, the
    three channels on the mean; None where exposure is not modelled."""
    if field.get("exposure") is None:
        return None
    neutral = fmean(field["exposure"]["neutral"])
    least = min((fmean(gains) for gains in field["exposure"]["photos"].values()), default=neutral)
    stops = round((neutral - least) / math.log(2), 2) + 0.0  # no -0
    return f"reference exposure, {stops:+.2f} EV over the least exposed photo"


def learnt_of_photos(trainer: "FieldTrainer", views: "Sequence[View]") -> dict[str, Any]:
    """What training learnt of each photo, for field.json: nothing where no effect is on.

    ``exposure``: ``neutral``, at which the field is shown, and the gain of each photo, as natural logarithms in linear
    light. ``poses``: each photo's rotation vector (radians) and shift (scene units), added to its calibrated pose.
    """
    learnt: dict[str, Any] = {}
    names = [view.name for view in views]
    for effect in trainer.effects.colours:
        learnt[effect.name] = {"neutral": effect.reference.tolist(), "photos": _by(names, effect.rows.tolist())}
    for effect in trainer.effects.rays:
        learnt["poses"] = _by(names, effect.rows.tolist())
    return learnt


def _by(names: list[str], rows: list[list[float]]) -> dict[str, list[float]]:
    return dict(zip(names, rows, strict=True))
