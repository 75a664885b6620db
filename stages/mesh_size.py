"""How fine a mesh's lattice can be in the time there is."""

import time
from pathlib import Path

POINTS_PER_RAY = 20  # lattice points per ray trained: about a tenth of what training cost
LEAST_RESOLUTION, MOST_RESOLUTION = 64, 256
TIMED_EDGES, TIMED_SECONDS = (32, 64, 96), 0.3
# What takes time besides the densities, in multiples of the time that the surface of a ball takes (:func:`yardstick`).
# ONCE: what any mesh takes (visibility, level, colours, picture, files). PER_POINT: what each lattice point adds
# (marching cubes, cleaning, decimation). Measured on an idle machine, where a ball takes 0.024 s: fox, fountain_p11 and
# herzjesu_p8 at 64 to 192 points per edge took 2.6 to 3 s and 0.8 to 1.1 µs a point (docs/numbers.md).
ONCE, PER_POINT = 150.0, 4.5e-5
# A colour reads the grids as often as this many densities, once for each of its samples. It takes 3 to 4 times as
# long as these, for the second network and because colours are not shared out among the cores (docs/numbers.md); that
# is in ONCE. Surfaces have 3 to 5 vertices for each point of a side of the lattice, and decimation leaves 150,000.
COLOURED, VERTICES_PER_FACE, MOST_VERTICES = 8, 5, 150_000
BALL_EDGE, BALL_TIMES = 96, 3


def affordable_resolution(rays: int) -> int:
    """Lattice points per edge that cost about a tenth of the training of ``rays``, a multiple of 16 in 96 ... 256."""
    edge = (POINTS_PER_RAY * rays) ** (1 / 3)
    return min(MOST_RESOLUTION, max(96, round(edge / 16) * 16))


def resolution_in(seconds: float, per_density: float, per_ball: float) -> int:
    """Lattice points per edge, a multiple of 16 in 64 ... 256, of a mesh that takes ``seconds`` where a density takes
    ``per_density`` and the surface of a ball ``per_ball`` seconds."""
    edges = range(LEAST_RESOLUTION, MOST_RESOLUTION + 1, 16)
    fitting = [edge for edge in edges if seconds_of(edge, per_density, per_ball) <= seconds]
    return max(fitting, default=LEAST_RESOLUTION)


def seconds_of(edge: int, per_density: float, per_ball: float) -> float:
    """What a mesh of ``edge`` lattice points per edge is expected to take."""
    densities = edge**3 + COLOURED * min(VERTICES_PER_FACE * edge**2, MOST_VERTICES)
    return densities * per_density + (ONCE + PER_POINT * edge**3) * per_ball


def seconds_per_density(train: Path, half_box: float, chunk: int) -> float:
    """Measured: larger lattices of the field in ``train`` over [-half_box, half_box]³ until one takes long enough to
    tell."""
    import torch

    from nerf.lattice import density_lattice
    from stages.device import compute_device
    from stages.field_files import load_field

    device = compute_device()
    model, _ = load_field(train, device)
    corner = torch.full((3,), half_box, device=device)
    density_lattice(model, TIMED_EDGES[0], -corner, corner, chunk)  # the first pays for memory and kernels
    seconds = per_point = 0.0
    for edge in TIMED_EDGES:
        if seconds >= TIMED_SECONDS:
            break
        began = time.perf_counter()
        density_lattice(model, edge, -corner, corner, chunk).values.cpu()
        seconds = time.perf_counter() - began
        per_point = seconds / edge**3
    return per_point


def yardstick() -> float:
    """Seconds for the surface of a ball on a lattice of BALL_EDGE³, the best of a few: how fast this machine is at what
    is no field."""
    import torch

    from nerf.lattice import Lattice
    from stages.mesh_surface import extract, vertex_normals

    line = torch.linspace(-1, 1, BALL_EDGE)
    radius = torch.stack(torch.meshgrid(line, line, line, indexing="ij")).norm(dim=0)
    lattice, times = Lattice((4 * (0.6 - radius)).exp(), -torch.ones(3), torch.ones(3)), []
    for _ in range(BALL_TIMES):
        began = time.perf_counter()
        vertex_normals(extract(lattice, 1.0))
        times.append(time.perf_counter() - began)
    return min(times)
