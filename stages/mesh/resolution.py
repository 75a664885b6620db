"""The box of the density grid, and the resolution that fits a time limit.

A box is (2, 3): its lowest and its highest corner, in the scene frame. ``resolution`` is the number of grid points per
edge of a cube; a flat box has about as many points in all, and cubic voxels, smaller ones.
"""

import math
import time
from pathlib import Path

import numpy as np
import torch

from nerf import REGION_HALF_SIZE
from nerf.fields.density_grid import DensityGrid, sample_density_grid
from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.space_maps import space_map
from stages.contract import Inputs, Progress
from stages.hardware.device import compute_device
from stages.io.field_files import load_field
from stages.io.files import read_json, read_scene, read_tensors
from stages.mesh.grid_space import DensityIn, GridSpace, box_in, grid_space, points_of_grid
from stages.mesh.marching_cubes import extract_surface
from stages.mesh.surface import vertex_normals

CHUNK = 1 << 16  # points given to the field at a time

# A box is cut along the axis of the least extent of the sparse points if there are MIN_POINTS of them, they extend over
# WIDE of the cube along another axis and over less along this one. They may be few where walls are bare, so MARGIN is
# added on either side, in sides of the cube; points beyond the QUANTILE on either side are taken for outliers.
MIN_POINTS, WIDE, MARGIN, QUANTILE = 500, 0.5, 0.05, 0.001

POINTS_PER_RAY = 20  # grid points per ray trained: about a tenth of what training cost
MIN_RESOLUTION, MAX_RESOLUTION = 64, 256
MIN_TRAINED_RESOLUTION = 96  # of those chosen from the training
TIMED_EDGES, MIN_TIMED_SECONDS = (32, 64, 96), 0.3
# What takes time besides density queries, in multiples of the reference timing (the surface of a ball). FIXED_COST:
# what any mesh takes (visibility, iso-level, colours, picture, files). COST_PER_POINT: what each grid point adds
# (marching cubes, cleaning, decimation). Measured on an idle machine with a reference timing of 0.024 s: fox,
# fountain_p11 and herzjesu_p8 at 64 to 192 points per edge took 2.6 to 3 s and 0.8 to 1.1 µs a point
# (docs/experiments/mesh.md).
FIXED_COST, COST_PER_POINT = 150.0, 4.5e-5
# A colour reads the grids as often as this many density queries, once for each of its samples. It takes 3 to 4 times as
# long as these, for the second network and because colours are not shared out among the cores
# (docs/experiments/mesh.md); that is in FIXED_COST.
# Surfaces have 3 to 5 vertices per grid point of a side, and decimation leaves 150,000.
QUERIES_PER_COLOUR, VERTICES_PER_FACE, MAX_VERTICES = 8, 5, 150_000
REFERENCE_EDGE, REFERENCE_REPEATS = 96, 3
# Of COST_PER_POINT, and of the memory. Measured: a plain's grid in a box with 3.5 times the surface took 1.2 times the
# seconds and 1.5 times the memory. Surfaces of photos are twice as large.
SURFACE_SHARE = 1 / 3


def choose_resolution(seconds: float | None, inputs: Inputs, progress: Progress) -> int:
    """The resolution that fits into ``seconds`` on this machine; without a limit the one that the training deserves."""
    if seconds is None:
        return resolution_from_training(read_json(inputs["train"] / "field.json")["rays"])
    progress.update("timing the field's density queries")
    began = time.perf_counter()
    points = read_tensors(inputs["normalise"] / "points.safetensors")["xyz"].astype(float)
    space = grid_space(space_map(**read_json(inputs["train"] / "field.json")["settings"]["space"]))
    region = grid_box(read_scene(inputs["normalise"]).capture_type, points)
    query, reference = density_query_seconds(inputs["train"], space, box_in(space, region)), reference_seconds()
    return resolution_within(seconds - (time.perf_counter() - began), query, reference, slab_factor(region))


def resolution_from_training(rays: int) -> int:
    """The resolution whose points cost about a tenth of the training of ``rays``, a multiple of 16 in 96 … 256."""
    edge = (POINTS_PER_RAY * rays) ** (1 / 3)
    return min(MAX_RESOLUTION, max(MIN_TRAINED_RESOLUTION, round(edge / 16) * 16))


def grid_box(capture_type: CaptureType, points: np.ndarray) -> np.ndarray:
    """The box of the scene that is meshed: the region of interest, or where the scene is flat (ground from the air, a
    façade, the floor of a house) the slab of it that sparse ``points`` (n, 3) lie in.

    Never a slab where photos were taken around an object: its top may be bare, and points on what it stands on do not
    tell how far it reaches.
    """
    cube = np.array([[-REGION_HALF_SIZE] * 3, [REGION_HALF_SIZE] * 3])
    points = points[(np.abs(points) <= REGION_HALF_SIZE).all(axis=1)]
    if capture_type == "object-centric" or len(points) < MIN_POINTS:
        return cube
    low, high = np.quantile(points, [QUANTILE, 1 - QUANTILE], axis=0)
    flat, side = int((high - low).argmin()), 2 * REGION_HALF_SIZE
    bottom, top = low[flat] - MARGIN * side, high[flat] + MARGIN * side
    if (high - low).max() >= WIDE * side >= top - bottom:
        cube[:, flat] = max(bottom, -REGION_HALF_SIZE), min(top, REGION_HALF_SIZE)
    return cube


def slab_factor(box: np.ndarray) -> float:
    """How many times as many voxels of a box a surface may cut as of a cube with as many voxels in all."""
    sides = (box[1] - box[0]).tolist()
    return math.prod(sides) ** (1 / 3) / min(sides)


def point_cost(slab: float) -> float:
    """What a grid point costs besides its density query, relative to a cube: part of it is its share in the surface."""
    return 1 + SURFACE_SHARE * (slab - 1)


def resolution_within(seconds: float, query: float, reference: float, slab: float = 1.0) -> int:
    """The largest resolution, a multiple of 16 in 64 … 256, of a mesh that takes ``seconds`` where a density query
    takes ``query`` seconds and the reference ``reference``, in a box of that :func:`slab_factor`."""
    edges = range(MIN_RESOLUTION, MAX_RESOLUTION + 1, 16)
    fitting = [edge for edge in edges if expected_seconds(edge, query, reference, slab) <= seconds]
    return max(fitting, default=MIN_RESOLUTION)


def expected_seconds(resolution: int, query: float, reference: float, slab: float = 1.0) -> float:
    """What a mesh is expected to take."""
    vertices = min(VERTICES_PER_FACE * resolution**2 * slab, MAX_VERTICES)
    queries = resolution**3 + QUERIES_PER_COLOUR * vertices
    return queries * query + (FIXED_COST + COST_PER_POINT * resolution**3 * point_cost(slab)) * reference


def density_query_seconds(train: Path, space: GridSpace, box: np.ndarray) -> float:
    """Measured seconds per density query of the field in ``train``: larger and larger grids over a box of their
    ``space``, until one takes long enough to tell."""
    device = compute_device()
    model, _ = load_field(train, device)
    field = DensityIn(space, model)
    low, high = torch.tensor(box, dtype=torch.float32, device=device)
    sample_density_grid(field, TIMED_EDGES[0], low, high, CHUNK)  # the first pays for memory and kernels
    seconds = per_point = 0.0
    for edge in TIMED_EDGES:
        if seconds >= MIN_TIMED_SECONDS:
            break
        began = time.perf_counter()
        counts = points_of_grid(space, box, edge, np.zeros((0, 3)))
        count = sample_density_grid(field, counts, low, high, CHUNK).values.cpu().numel()
        seconds = time.perf_counter() - began
        per_point = seconds / count
    return per_point


def reference_seconds() -> float:
    """The reference timing: how long this machine takes for the surface of a ball on a grid of REFERENCE_EDGE³, the
    best of a few."""
    line = torch.linspace(-1, 1, REFERENCE_EDGE)
    radius = torch.stack(torch.meshgrid(line, line, line, indexing="ij")).norm(dim=0)
    grid, times = DensityGrid((4 * (0.6 - radius)).exp(), -torch.ones(3), torch.ones(3)), []
    for _ in range(REFERENCE_REPEATS):
        began = time.perf_counter()
        vertex_normals(extract_surface(grid, 1.0))
        times.append(time.perf_counter() - began)
    return min(times)
