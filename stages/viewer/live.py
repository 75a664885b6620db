"""What the page shows of a running training: its scene once, then field after field, packed for speed and not for size.

A field as :func:`stages.io.field_files.save_field` wrote it becomes 16 bits a number, row by row: about as much work as
reading it, and lossless to the eye. The file that stage viewer writes in the end is smaller.
"""

from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import load

from nerf.effects.appearance import AppearanceModel
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.scene import Scene
from stages.contract import Inputs
from stages.effects.image_effects import new_view_effects, new_view_words, photo_effects
from stages.io.field_files import load_field
from stages.io.files import read_json, read_scene, read_tensors
from stages.io.photos import spread
from stages.viewer.contents import (
    COMPARED_VIEWS,
    Contents,
    gains_of,
    palette,
    scene_header,
    sparse_points,
    view_header,
)
from stages.viewer.tables import FEATURES, description, quantised, sections


class LiveContents:
    """Packs what the ``inputs`` of stage viewer hold, stage train aside; its fields come folder by folder."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs, self.scene = inputs, read_scene(inputs["normalise"])
        self.settings: Any = None
        self.grid: HashGridField | None = None  # into which the next field is loaded, too

    def scene_contents(self, folder: Path) -> Contents:
        """All but the field, which the ``folder`` of one tells the effects of."""
        field = read_json(folder / "field.json")
        header = {
            "scene": scene_header(self.scene, self.inputs),
            "exposure": "exposure" in field["effects"],
            "appearance": new_view_words(field),
            "comparison": None,
            "inverse_depth": _inverse_depths(self.scene, self.inputs),
            "views": [view_header(self.scene, view, field) for view in self.scene.views],
        }
        return Contents(header, {"palette": palette()} | sparse_points(self.inputs), None)

    def field_contents(self, folder: Path) -> Contents:
        """The field in ``folder``, and the exposure of each photo. A field that browsers cannot draw is None.

        Raises FileNotFoundError where the training has removed it meanwhile.
        """
        field = read_json(folder / "field.json")
        grid = self._loaded(field, folder)
        if grid is None:
            return Contents({"field": None}, {}, None)
        table = quantised(grid.layout, grid.table, 16)
        gains = gains_of(new_view_effects(field)) | {"background": field["background"]}
        photos = [gains_of(photo_effects(field, self.scene, view)) for view in self.scene.views]
        header = {"field": description(grid, table, by_rows=True) | gains, "gains": photos}
        return Contents(header, sections(grid, table, by_rows=True), None)

    def _loaded(self, field: dict[str, Any], folder: Path) -> HashGridField | None:
        """The field in ``folder``, loaded into the one before where both have the same sizes."""
        if field["kind"] != "grid" or field["settings"]["features_per_level"] != FEATURES:
            return None
        if self.grid is not None and self.settings == field["settings"]:
            self.grid.load_state_dict(load((folder / "field.safetensors").read_bytes()), assign=True)
            return self.grid
        model, _ = load_field(folder, renders=False)
        grid = model.model if isinstance(model, AppearanceModel) else model
        assert isinstance(grid, HashGridField)
        self.settings, self.grid = field["settings"], grid
        return grid


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
