"""A hash-grid field as the page's shaders read it: its tables in few bits, its networks as 4 × 4 matrices.

8 bits: each feature of each level is a signed byte times a scale, which is chosen by the least squared error. Scales
cost the shader nothing: features enter the density network linearly, so they are multiplied into its first layer.
16 bits: half-precision floats as they are.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int8
from torch import Tensor

from nerf.fields.background import BACKGROUND_LAYOUT
from nerf.fields.hash_grid import HashGridField
from nerf.fields.mlp import GEOMETRY_FEATURES
from nerf.kernels import HIDDEN, GridLayout

Bits = Literal[8, 16]
FEATURES = 4  # of a row: one texel
MAX_CODE = 127
# Scales that are tried, as shares of the largest value: smaller ones cut a few outliers and are finer for all others.
SCALES = tuple(0.9**k for k in range(24))


@dataclass(frozen=True)
class Table:
    """The feature table in few bits: ``codes`` (rows, 4), int8 or float16, and a scale per level and feature."""

    layout: GridLayout
    codes: np.ndarray
    scales: Float[np.ndarray, "levels 4"]

    @property
    def bits(self) -> Bits:
        """Of a number."""
        return 8 if self.codes.dtype == np.int8 else 16

    def values(self) -> Float[np.ndarray, "rows 4"]:
        """What the shader reads: codes times scales."""
        values = self.codes.astype(np.float32)
        for level, scale in enumerate(self.scales):
            values[_rows(self.layout, level)] *= scale
        return values

    def planes(self) -> bytes:
        """The codes as they are packed: level after level, feature after feature, which gzip shrinks best; of 16 bits
        the low bytes of each feature before the high ones."""
        parts = []
        for level in range(len(self.scales)):
            columns = np.ascontiguousarray(self.codes[_rows(self.layout, level)].T)
            parts += [split for column in columns for split in column.view(np.uint8).reshape(-1, self.bits // 8).T]
        return b"".join(part.tobytes() for part in parts)


def quantised(layout: GridLayout, table: Float[Tensor, "rows 4"], bits: Bits) -> Table:
    """The table in so many bits a number."""
    levels = len(layout.resolutions)
    if bits == 16:
        return Table(layout, table.detach().half().cpu().numpy(), np.ones((levels, FEATURES), np.float32))
    values = table.detach().cpu().numpy()
    codes, scales = np.empty(values.shape, np.int8), np.empty((levels, FEATURES), np.float32)
    for level in range(levels):
        rows = _rows(layout, level)
        for feature in range(FEATURES):
            codes[rows, feature], scales[level, feature] = _in_bytes(values[rows, feature])
    return Table(layout, codes, scales)


def _in_bytes(values: Float[np.ndarray, "n"]) -> tuple[Int8[np.ndarray, "n"], float]:
    """Signed bytes and their scale, of the SCALES the one with the least squared error."""
    largest = float(np.abs(values).max())
    if largest == 0:
        return np.zeros(len(values), np.int8), 1.0

    def codes(scale: float) -> np.ndarray:
        return np.clip(np.rint(values / scale), -MAX_CODE, MAX_CODE)

    def error(scale: float) -> float:
        return float(np.square(codes(scale) * scale - values).sum(dtype=np.float64))

    best = float(np.float32(min((largest / MAX_CODE * share for share in SCALES), key=error)))
    return codes(best).astype(np.int8), best


def _rows(layout: GridLayout, level: int) -> slice:
    return slice(layout.level_offsets[level], layout.level_offsets[level + 1])


def with_table(field: HashGridField, table: Table) -> HashGridField:
    """The field as the page has it: with the values of ``table``, its background table in half precision."""
    like = HashGridField(field.settings, 0, field.backend).to(field.table.device)
    like.load_state_dict(field.state_dict())
    like.table.copy_(torch.from_numpy(table.values()))
    if field.settings.background_model:
        like.background_table.copy_(field.background_table.half().float())
    return like


def sections(field: HashGridField, table: Table, by_rows: bool = False) -> dict[str, bytes]:
    """The binary parts of the page that make the field up. Matrices are by columns, as std140 has them.

    ``by_rows``: the table as a texture takes it, which costs no time, instead of in planes, which gzip shrinks best.
    """
    weights = {name: value.detach().cpu().numpy() for name, value in field.weights._asdict().items()}
    full_scale = MAX_CODE if table.bits == 8 else 1  # a normalised texture reads the largest byte as 1
    scaled = weights["density_hidden"] * (full_scale * table.scales.reshape(-1, 1))
    geometry, direction = np.split(weights["colour_hidden"], [GEOMETRY_FEATURES])
    if not len(direction):
        direction = np.zeros((GEOMETRY_FEATURES, HIDDEN), np.float32)
    density = [_layer(scaled), _layer(weights["density_out"], output=True)]
    colour_out = np.concatenate([weights["colour_out"], np.zeros((1, HIDDEN), np.float32)])
    colour = [_layer(geometry), _layer(direction), _layer(colour_out, output=True)]
    words = field.occupancy_bits.cpu().numpy().view(np.uint32).reshape(-1, 2)
    parts = {
        "table": table.codes.tobytes() if by_rows else table.planes(),
        "density_network": np.concatenate(density, axis=None).tobytes(),
        "colour_network": np.concatenate(colour, axis=None).tobytes(),
        "occupancy": words.tobytes(),
        "empty_distance": field.empty_distance.cpu().numpy().tobytes(),
    }
    if field.settings.background_model:
        parts["background"] = field.background_table.half().cpu().numpy().tobytes()
    return parts


def _layer(weights: Float[np.ndarray, "others hidden"], output: bool = False) -> Float[np.ndarray, "matrices 4 4"]:
    """Weights between the 64 hidden units and others as matrices of four inputs and four outputs each, for the same
    hidden units one after the other. Hidden units are the outputs, or the inputs of an ``output`` layer."""
    blocks = weights.reshape(-1, 4, HIDDEN // 4, 4).transpose(2, 0, 1, 3)  # [hidden / 4][others / 4][other][hidden]
    columns = blocks.transpose(0, 1, 3, 2) if output else blocks  # a column per input
    return np.ascontiguousarray(columns, np.float32).reshape(-1, 4, 4)


def description(field: HashGridField, table: Table, by_rows: bool = False) -> dict[str, Any]:
    """What the page must know of the field beside its numbers; ``by_rows`` as for :func:`sections`."""
    settings, stepping = field.settings, field.render_stepping
    return {
        "space": vars(settings.space) | {"half": settings.space.half},
        "levels": _levels(field.layout),
        "bits": table.bits,
        "by_rows": by_rows,
        "step_size": stepping.step_size,
        "cone_angle": stepping.cone_angle,
        "max_samples": stepping.max_samples,
        "occupancy_resolution": settings.occupancy_resolution,
        "view_dependence": settings.view_dependence,
        "background_levels": _levels(BACKGROUND_LAYOUT) if settings.background_model else [],
    }


def _levels(layout: GridLayout) -> list[dict[str, int]]:
    return [
        {
            "resolution": resolution,
            "first_row": layout.level_offsets[level],
            "rows": layout.level_rows(level),
            "mask": layout.level_rows(level) - 1 if layout.is_hashed(level) else 0,
        }
        for level, resolution in enumerate(layout.resolutions)
    ]
