"""Where a mesh's grid lies, and how fine it can be in the time there is.

A box is (2, 3): its lowest and its highest corner, in the scene frame. ``resolution`` is the number of grid points
per edge of a cube; a flat box has about as many points in all, and cubic voxels, smaller ones.
"""

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from nerf import REGION_HALF

if TYPE_CHECKING:
    import numpy as np

    from nerf.geometry.region_of_interest import Layout

# A box is cut along one axis, that of the least extent of the sparse points, if these tell of the scene: so many, along
# another axis over half of the cube, along this one over less. They may be few where walls are bare: MARGIN is added on
# either side, in sides of the cube, and the few points beyond OUTERMOST, some of them false, say nothing.
FEWEST_POINTS, SPANNED, MARGIN, OUTERMOST = 500, 0.5, 0.05, 0.001

POINTS_PER_RAY = 20  # grid points per ray trained: about a tenth of what training cost
LEAST_RESOLUTION, MOST_RESOLUTION = 64, 256
TIMED_EDGES, TIMED_SECONDS = (32, 64, 96), 0.3
# What takes time besides the densities, in multiples of the time that the surface of a ball takes (:func:`yardstick`).
# ONCE: what any mesh takes (visibility, level, colours, picture, files). PER_POINT: what each grid point adds
# (marching cubes, cleaning, decimation). Measured on an idle machine, where a ball takes 0.024 s: fox, fountain_p11 and
# herzjesu_p8 at 64 to 192 points per edge took 2.6 to 3 s and 0.8 to 1.1 µs a point (docs/experiments/mesh.md).
ONCE, PER_POINT = 150.0, 4.5e-5
# A colour reads the grids as often as this many densities, once for each of its samples. It takes 3 to 4 times as
# long as these, for the second network and because colours are not shared out among the cores
# (docs/experiments/mesh.md); that is in ONCE. Surfaces have 3 to 5 vertices for each point of a side of the grid,
# and decimation leaves 150,000.
COLOURED, VERTICES_PER_FACE, MOST_VERTICES = 8, 5, 150_000
BALL_EDGE, BALL_TIMES = 96, 3
# Of PER_POINT, and of the memory. Measured: a plain's grid in a box with 3.5 times the surface took 1.2 times the
# seconds and 1.5 times the memory. Surfaces of photos are twice as large.
SURFACE_SHARE = 1 / 3


def affordable_resolution(rays: int) -> int:
    """The resolution whose points cost about a tenth of the training of ``rays``, a multiple of 16 in 96 ... 256."""
    edge = (POINTS_PER_RAY * rays) ** (1 / 3)
    return min(MOST_RESOLUTION, max(96, round(edge / 16) * 16))


def density_grid_box(layout: "Layout", points: "np.ndarray") -> "np.ndarray":
    """The box for the grid: the region of interest, or where the scene is flat (ground from the air, a façade, the
    floor of a house) the slice of it that sparse ``points`` (n, 3) lie in.

    Not where photos were taken around an object: that may be bare at its top, and points on what it stands on do not
    tell how far it reaches.
    """
    import numpy as np

    cube = np.array([[-REGION_HALF] * 3, [REGION_HALF] * 3])
    points = points[(np.abs(points) <= REGION_HALF).all(axis=1)]
    if layout == "around" or len(points) < FEWEST_POINTS:
        return cube
    low, high = np.quantile(points, [OUTERMOST, 1 - OUTERMOST], axis=0)
    flat, side = int((high - low).argmin()), 2 * REGION_HALF
    bottom, top = low[flat] - MARGIN * side, high[flat] + MARGIN * side
    if (high - low).max() >= SPANNED * side >= top - bottom:
        cube[:, flat] = max(bottom, -REGION_HALF), min(top, REGION_HALF)
    return cube


def points_along(box: "np.ndarray", resolution: int) -> int:
    """Grid points along the longest edge of a box."""
    sides = (box[1] - box[0]).tolist()
    return round((resolution - 1) * max(sides) / math.prod(sides) ** (1 / 3)) + 1


def flatness(box: "np.ndarray") -> float:
    """How many times as many voxels of a box may be cut by a surface as of a cube with as many voxels in all."""
    sides = (box[1] - box[0]).tolist()
    return math.prod(sides) ** (1 / 3) / min(sides)


def point_cost(flatness: float) -> float:
    """What a grid point takes besides its density, in those of a cube: a part of it is its share in the surface."""
    return 1 + SURFACE_SHARE * (flatness - 1)


def resolution_in(seconds: float, per_density: float, per_ball: float, flatness: float = 1.0) -> int:
    """The resolution, a multiple of 16 in 64 ... 256, of a mesh that takes ``seconds`` where a density takes
    ``per_density`` and the surface of a ball ``per_ball`` seconds, in a box of that :func:`flatness`."""
    edges = range(LEAST_RESOLUTION, MOST_RESOLUTION + 1, 16)
    fitting = [edge for edge in edges if seconds_of(edge, per_density, per_ball, flatness) <= seconds]
    return max(fitting, default=LEAST_RESOLUTION)


def seconds_of(resolution: int, per_density: float, per_ball: float, flatness: float = 1.0) -> float:
    """What a mesh is expected to take."""
    vertices = min(VERTICES_PER_FACE * resolution**2 * flatness, MOST_VERTICES)
    densities = resolution**3 + COLOURED * vertices
    return densities * per_density + (ONCE + PER_POINT * resolution**3 * point_cost(flatness)) * per_ball


def seconds_per_density(train: Path, box: "np.ndarray", chunk: int) -> float:
    """Measured: larger grids of the field in ``train`` over a box until one takes long enough to tell."""
    import torch

    from nerf.fields.density_grid import sample_density_grid
    from stages.hardware.device import compute_device
    from stages.io.field_files import load_field

    device = compute_device()
    model, _ = load_field(train, device)
    low, high = torch.tensor(box, dtype=torch.float32, device=device)
    sample_density_grid(model, TIMED_EDGES[0], low, high, chunk)  # the first pays for memory and kernels
    seconds = per_point = 0.0
    for edge in TIMED_EDGES:
        if seconds >= TIMED_SECONDS:
            break
        began = time.perf_counter()
        count = sample_density_grid(model, points_along(box, edge), low, high, chunk).values.cpu().numel()
        seconds = time.perf_counter() - began
        per_point = seconds / count
    return per_point


def yardstick() -> float:
    """Seconds for the surface of a ball on a grid of BALL_EDGE³, the best of a few: how fast this machine is at what
    is no field."""
    import torch

    from nerf.fields.density_grid import DensityGrid
    from stages.mesh.surface import extract, vertex_normals

    line = torch.linspace(-1, 1, BALL_EDGE)
    radius = torch.stack(torch.meshgrid(line, line, line, indexing="ij")).norm(dim=0)
    grid, times = DensityGrid((4 * (0.6 - radius)).exp(), -torch.ones(3), torch.ones(3)), []
    for _ in range(BALL_TIMES):
        began = time.perf_counter()
        vertex_normals(extract(grid, 1.0))
        times.append(time.perf_counter() - began)
    return min(times)
