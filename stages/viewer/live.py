"""What the page shows of a running training: its scene once, then field after field, packed for speed and not for size.

The training packs both, for it has them at hand: a field becomes 16 bits a number, row by row, which is about as much
work as writing it, and lossless to the eye. The file that stage viewer writes in the end is smaller.
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerf.effects.appearance import AppearanceModel
from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import RadianceModel
from nerf.geometry.scene import Scene
from stages.contract import Inputs
from stages.effects.image_effects import new_view_effects, new_view_words, photo_effects
from stages.io.files import read_scene, read_tensors
from stages.io.photos import spread
from stages.train.live import FIELD, SCENE
from stages.viewer.contents import (
    COMPARED_VIEWS,
    Contents,
    gains_of,
    palette,
    scene_header,
    sparse_points,
    view_header,
)
from stages.viewer.page import binary
from stages.viewer.tables import FEATURES, description, quantised, sections


class LiveContents:
    """Packs fields of the scene in the finished folder of ``normalise``. ``info`` is what field.json says of them."""

    def __init__(self, normalise: Path) -> None:
        self.inputs: Inputs = {"normalise": normalise}

    @cached_property
    def scene(self) -> Scene:
        """Read when there is somebody to show it to: every training has this at hand."""
        return read_scene(self.inputs["normalise"])

    def save(self, folder: Path, model: RadianceModel, info: dict[str, Any]) -> None:
        """Write FIELD into ``folder``, and SCENE beside that folder unless it is there."""
        if not (folder.parent / SCENE).exists():
            temporary = folder / SCENE
            temporary.write_bytes(self.scene_contents(info))
            temporary.replace(folder.parent / SCENE)
        (folder / FIELD).write_bytes(self.field_contents(model, info))

    def scene_contents(self, info: dict[str, Any]) -> bytes:
        """All but the field, and metres per unit, which no training knows."""
        header = {
            "scene": scene_header(self.scene, self.inputs),
            "exposure": "exposure" in info["effects"],
            "appearance": new_view_words(info),
            "comparison": None,
            "inverse_depth": _inverse_depths(self.scene, self.inputs),
            "views": [view_header(self.scene, view, info) for view in self.scene.views],
        }
        return binary(Contents(header, {"palette": palette()} | sparse_points(self.inputs), None))

    def field_contents(self, model: RadianceModel, info: dict[str, Any]) -> bytes:
        """The field, and the exposure of each photo. A field that browsers cannot draw is None."""
        grid = model.model if isinstance(model, AppearanceModel) else model
        if not isinstance(grid, HashGridField) or grid.settings.features_per_level != FEATURES:
            return binary(Contents({"field": None}, {}, None))
        table = quantised(grid.layout, grid.table, 16)
        gains = gains_of(new_view_effects(info)) | {"background": info["background"]}
        photos = [gains_of(photo_effects(info, self.scene, view)) for view in self.scene.views]
        header = {"field": description(grid, table, by_rows=True) | gains, "gains": photos}
        return binary(Contents(header, sections(grid, table, by_rows=True), None))


def _inverse_depths(scene: Scene, inputs: Inputs) -> list[float]:
    """From which to which inverse depth colours go: the 1 % and 99 % quantiles of the sparse points before a few
    photos. Nothing is rendered while a training needs the machine."""
    points = read_tensors(inputs["normalise"] / "points.safetensors")["xyz"]
    chosen = [scene.views[index] for index in sorted(set(spread(len(scene.views), COMPARED_VIEWS)))]
    poses = [view.scene_from_camera for view in chosen]
    depths = [(points - pose[:, 3]) @ pose[:, 2] for pose in poses]
    known = np.concatenate([depth[depth > 0] for depth in depths])
    ends = np.array([distance for view in chosen for distance in (view.near, view.far)])
    low, high = np.quantile(1 / (known if len(known) else ends), [0.01, 0.99])
    return [float(low), float(high) if high > low else float(low) + 1.0]
