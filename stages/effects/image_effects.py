"""The effects of images: made of what was decided for training, and of field.json for what is shown afterwards.

field.json holds by the name of each modelled effect what was learnt of each training photo, a row of numbers, by its
name.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf.effects import ColourEffect, HeldOutImages, ImageEffects, Images
from nerf.geometry.pose_distance import neighbour_weights
from nerf.geometry.scene import Scene, View
from nerf.training.ray_dataset import RayDataset
from stages.effects.decisions import Decisions
from stages.effects.effect_list import EFFECTS
from stages.sfm.colmap.cameras import corner_chord_squared


def image_effects(decisions: Decisions, scene: Scene, views: Sequence[View], dataset: RayDataset) -> ImageEffects:
    """What stands between the field and the photos ``views`` of ``dataset``, in their order."""
    rays, colours = [], []
    images = images_of(scene, views, dataset.device)._replace(viewing_distance=dataset.viewing_distance)
    for effect in EFFECTS:
        if effect.name not in decisions.on:
            continue
        parts, rows = effect.load(), decisions.on[effect.name]
        measured = torch.tensor([rows[view.name] for view in views], device=dataset.device) if rows else None
        if parts.rays:
            rays.append(parts.rays.initial(images, measured))
        if parts.colours:
            colours.append(parts.colours.initial(images, measured))
    return ImageEffects(tuple(rays), tuple(colours))


def images_of(scene: Scene, views: Sequence[View], device: torch.device | str = "cpu") -> Images:
    """What effects may know of photos."""
    poses, camera = np.stack([view.scene_from_camera for view in views]), [view.camera for view in views]
    corners = {number: corner_chord_squared(scene.cameras[number]) for number in set(camera)}
    return Images(
        torch.tensor(poses, dtype=torch.float32, device=device),
        torch.tensor(camera, device=device),
        torch.tensor([corners[number] for number in camera], dtype=torch.float32, device=device),
    )


def held_out_images(
    scene: Scene, trained: Sequence[View], held_out: Sequence[View], device: torch.device | str = "cpu"
) -> HeldOutImages:
    """Photos that took no part in training, beside those that did."""
    poses, known = (np.stack([view.scene_from_camera for view in views]) for views in (held_out, trained))
    weights = torch.tensor(neighbour_weights(poses, known), dtype=torch.float32, device=device)
    return HeldOutImages(images_of(scene, held_out, device), weights)


def learnt_poses(field: dict[str, Any], scene: Scene) -> Scene:
    """The scene with the training photos where the field of this field.json learnt that they were taken."""
    views = list(scene.views)
    for effect in EFFECTS:
        if (rows := field["effects"].get(effect.name)) and (rays := effect.load().rays):
            known = [index for index, view in enumerate(views) if view.name in rows]
            poses = torch.tensor(np.stack([views[index].scene_from_camera for index in known]))
            learnt = torch.tensor([rows[views[index].name] for index in known], dtype=poses.dtype)
            for index, pose in zip(known, rays.moved_poses(poses, learnt).numpy(), strict=True):
                views[index] = replace(views[index], scene_from_camera=pose)
    return replace(scene, views=tuple(views))


def refines_poses(names: Collection[str]) -> bool:
    """Whether one of the effects of these names moves rays."""
    return any(effect.load().rays for effect in EFFECTS if effect.name in names)


def learnt_effects(effects: ImageEffects, views: Sequence[View]) -> dict[str, dict[str, list[float]]]:
    """What was learnt of the training photos ``views``, for field.json."""
    names = [view.name for view in views]
    return {effect.name: dict(zip(names, effect.rows.tolist(), strict=True)) for effect in effects.all}


class LearntColours(NamedTuple):
    """A colour effect of field.json: its model, and by the name of each training photo what was learnt of it."""

    model: type[ColourEffect]
    photos: dict[str, list[float]]

    def rows(self, device: str = "cpu") -> Tensor:
        """Of all photos."""
        return torch.tensor(list(self.photos.values()), dtype=torch.float32, device=device)

    def of_photo(self, scene: Scene, view: View, device: str) -> ColourEffect:
        """As it was learnt of a photo, or as it is expected of one that took no part in training."""
        if view.name in self.photos:
            row = torch.tensor([self.photos[view.name]], dtype=torch.float32, device=device)
            return self.model.restored(images_of(scene, [view], device), row)
        # A target sets some of the training photos aside.
        trained = [known for known in scene.of_split("train") if known.name in self.photos]
        rows = torch.tensor([self.photos[known.name] for known in trained], dtype=torch.float32, device=device)
        learnt = self.model.restored(images_of(scene, trained, device), rows)
        return learnt.of_held_out(held_out_images(scene, trained, [view], device))


def learnt_colours(field: dict[str, Any]) -> list[LearntColours]:
    """The colour effects in the content of field.json, in the order in which they are applied."""
    parts = {effect.name: effect.load() for effect in EFFECTS if effect.name in field["effects"]}
    return [LearntColours(each.colours, field["effects"][name]) for name, each in parts.items() if each.colours]


def check_learnt_colours(field: dict[str, Any]) -> None:
    """Raises ValueError (or what torch raises for what are no numbers) where no effect can be made of them."""
    for model, photos in learnt_colours(field):
        if not photos:
            raise ValueError(f"{model.name} knows no photo")
        for photo, row in photos.items():
            numbers = torch.tensor(row, dtype=torch.float32)
            if numbers.shape != (model.row_length,) or not numbers.isfinite().all():
                raise ValueError(f"{model.name} of {photo} is {row}; it must be {model.row_length} finite numbers")


def photo_effects(field: dict[str, Any], scene: Scene, view: View, device: str = "cpu") -> tuple[ColourEffect, ...]:
    """The effects through which a photo shows the field of this field.json."""
    return tuple(learnt.of_photo(scene, view, device) for learnt in learnt_colours(field))


def new_view_effects(field: dict[str, Any], device: str = "cpu") -> tuple[ColourEffect, ...]:
    """The effects through which a view that no camera took shows it."""
    shown = (learnt.model.of_new_view(learnt.rows(device)) for learnt in learnt_colours(field))
    return tuple(effect for effect in shown if effect is not None)


def new_view_like(photo: tuple[ColourEffect, ...]) -> tuple[ColourEffect, ...]:
    """The same for a view that is to be like a photo with these."""
    shown = (effect.of_new_view(effect.rows) for effect in photo)
    return tuple(effect for effect in shown if effect is not None)


def new_view_words(field: dict[str, Any]) -> str | None:
    """What new views show at the reference; None without any colour effect."""
    return "; ".join(learnt.model.new_view_words(learnt.rows()) for learnt in learnt_colours(field)) or None


def held_out_words(field: dict[str, Any]) -> list[str]:
    """How photos that took no part in training are shown."""
    return [learnt.model.held_out_words for learnt in learnt_colours(field)]
