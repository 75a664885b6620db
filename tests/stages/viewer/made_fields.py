"""Finished stages with a tiny hash-grid field of random numbers, for each space map: fog of many colours."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.scene import Scene
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels import HIDDEN
from nerf.kernels.torch.occupancy import cell_corners
from nerf.runtime.randomness import generator
from stages.hardware.backend import load_backend
from stages.io.field_files import save_field
from stages.io.files import SMALL_COPY, write_json, write_tensors
from tests.stages.photo_scene import photographed, pose_towards_origin

CELLS = 16
CUBE = 0.45  # half the side of the solid cube: whole cells of a box
LOG_DENSITY = 8.0  # of the solid cube: half of the light stops within 0.0003
AHEAD = pose_towards_origin(0.0)[:, :3].T
SPACES: dict[str, SpaceMap] = {
    "box": Box(),
    "contraction": Contraction(),
    "ndc": Ndc(
        (3.2, 0.0, 0.1),
        tuple(tuple(map(float, axis)) for axis in AHEAD),  # pyright: ignore[reportArgumentType]
        (0.8, 0.6),
        1.0,
    ),
}
NAMES = ('<img src=x onerror="alert(1)">.png', "</script><b>.png", "it's “é” 📷.png")


class Made(NamedTuple):
    """A field with the finished stages around it."""

    inputs: dict[str, Path]
    scene: Scene
    field: HashGridField


def made(folder: Path, space: str, view_dependence: bool = True, **info: Any) -> Made:
    """Photos of a ball from all sides, and a field that has nothing to do with them; ``info`` goes into field.json."""
    alpha = space == "box"
    inputs, scene = photographed(folder, channels=4 if alpha else 3, bounded=alpha)
    field = random_field(SPACES[space], not alpha, view_dependence)
    for name in ("train", "scale", "mesh"):
        (folder / name).mkdir()
        inputs[name] = folder / name
    write_json(inputs["scale"] / "scale.json", {"metres_per_unit": None})
    write_tensors(inputs["mesh"] / SMALL_COPY, octahedron())
    background = [1.0, 1.0, 1.0] if alpha else [0.0, 0.0, 0.0]
    save_field(inputs["train"], field, {"background": background, "downscale": 1.0, "effects": {}} | info)
    return Made(inputs, scene, field)


def octahedron() -> dict[str, np.ndarray]:
    """As stage mesh leaves its copy for pages: a red one around the middle, 0.4 to its corners."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * 32767
    faces = [[a, b, c] for a in (0, 3) for b in (1, 4) for c in (2, 5)]
    return {
        "positions": corners.astype(np.int16),
        "faces": np.array(faces, np.uint16),
        "colours": np.tile(np.array([255, 0, 0], np.uint8), (6, 1)),
        "middle": np.array([0.0, 0.0, 0.1]),
        "radius": np.array([0.4]),
    }


def renamed(made: Made, names: tuple[str, ...] = NAMES) -> None:
    """Give the first photos these names."""
    content = made.scene.to_json()
    for view, name in zip(content["views"], names, strict=False):
        view["name"] = name
    write_json(made.inputs["normalise"] / "scene.json", content)


def random_field(space: SpaceMap, background_model: bool, view_dependence: bool) -> HashGridField:
    """Thin fog with a dense middle, three levels of which the last is hashed, many empty cells."""
    settings = HashGridSettings(
        num_levels=3,
        log2_hashmap_size=10,
        base_res=4,
        max_res=24,
        space=space,
        diagonal_steps=64,
        min_step_size=0.03,
        cone_angle=0.04,
        occupancy_resolution=CELLS,
        view_dependence=view_dependence,
        background_model=background_model,
    )
    field, random = HashGridField(settings, 0, load_backend("torch", "cpu")), generator("cpu", 0, 1)
    field.table.copy_(2 * torch.randn(field.table.shape, generator=random))
    field.density_out[0].mul_(2)
    field.colour_hidden.mul_(2)
    if background_model:
        field.background_table.copy_(torch.randn(field.background_table.shape, generator=random))
    centres = cell_corners(CELLS, torch.arange(CELLS**3)) + 0.5 / CELLS
    kept = torch.rand(len(centres), generator=random) < 0.5 - (centres - 0.5).norm(dim=-1)
    field.set_occupancy(field.backend.occupancy_bits(kept.float(), 0.5))
    return field


def solid_cube() -> HashGridField:
    """Dense from -CUBE to CUBE on each axis, empty elsewhere: its surface is known exactly."""
    settings = HashGridSettings(
        num_levels=1, log2_hashmap_size=10, base_res=4, max_res=4, diagonal_steps=1024, occupancy_resolution=CELLS
    )
    field = HashGridField(settings, 0, load_backend("torch", "cpu"))
    for numbers, value in ((field.table, 1.0), (field.density_hidden, 0.25), (field.density_out, LOG_DENSITY / HIDDEN)):
        numbers.fill_(value)
    centres = cell_corners(CELLS, torch.arange(CELLS**3)) + 0.5 / CELLS
    inside = ((centres - 0.5).abs() < CUBE / (2 * Box().half)).all(dim=-1)
    field.set_occupancy(field.backend.occupancy_bits(inside.float(), 0.5))
    return field


def gains(names: list[str]) -> dict[str, dict[str, list[float]]]:
    """Effects of field.json: an exposure for each photo, and vignetting of their camera."""
    exposure = {name: [0.1 * index, 0.05 * index, 0.0] for index, name in enumerate(names)}
    return {"exposure": exposure, "vignetting": {name: [0.3, 0.2, 0.1, 0.05] for name in names}}


def inside_pose() -> np.ndarray:
    """A camera amid the scene."""
    return np.concatenate([pose_towards_origin(0.7)[:, :3], [[0.1], [-0.15], [0.05]]], axis=1)
