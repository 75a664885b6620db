"""Warp's kernels from several threads: the same bits, whoever calls, whenever, however often."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
import warp as wp
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.kernels import Layers, RayStepping, grid_layout, warp
from nerf.kernels.torch.occupancy import binary_occupancy
from nerf.runtime.parallel import take_over_cores

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warp.compile_kernels("cpu")


def test_kernels_compile_on_all_cores(use_cores: Callable[[int], None], monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(wp, "load_module", lambda *_, max_workers, **__: asked.append(max_workers))
    use_cores(3)
    take_over_cores()
    warp.compile_kernels("cpu")
    assert torch.get_num_threads() == 1 and asked == [3]


def everything(seed: int) -> list[Tensor]:
    """What all kernels make of random numbers."""
    random = torch.Generator().manual_seed(seed)
    stepping, layout = RayStepping(0.02, 0.05, seed % 2 == 1, 8, 64), grid_layout(3, 4, 16, 8, 4)
    count = 40 + 7 * seed
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    rays = Rays(
        0.3 * torch.randn(count, 3, generator=random), directions, *torch.tensor([[0.05], [4.0]]).repeat(1, count)
    )
    bits = warp.occupancy_bits(torch.rand(512, generator=random), 0.4)
    samples = warp.march(binary_occupancy(bits), stepping, rays, torch.rand(count, generator=random))
    points = warp.sample_points(rays, samples, stepping.contracted)
    table = torch.randn(layout.rows, 4, generator=random)
    features = warp.encode(layout, table, points)
    grad_table = torch.zeros_like(table)
    for level in range(3):
        warp.encode_backward_table(layout, range(level, level + 1), points, features, grad_table)
    grad_points = warp.encode_backward_points(layout, table, points, features)
    grad_rays = warp.sample_points_backward(rays, samples, stepping.contracted, grad_points)
    sigma, colour = features[:, 0].exp(), features[:, 1:4].sigmoid()
    front, kept = warp.visible_samples(samples, sigma, 0.1, 0.5, torch.rand(count, generator=random))
    background = torch.rand(count, 3, generator=random)
    rendering, weights = warp.composite(samples, sigma, colour, background, rays.far)
    ones = Rendering(*(torch.ones_like(part) for part in rendering))
    grad_field = warp.composite_backward(samples, sigma, colour, background, rays.far, ones, weights)
    spread = warp.distortion(samples, weights, stepping)
    grad_weights = warp.distortion_backward(samples, weights, stepping, spread)
    known = torch.rand(count, generator=random) + 1
    apart = warp.depth_loss(samples, weights, rendering.opacity, rays.far, known, stepping)
    grad_apart = warp.depth_loss_backward(samples, rays.far, known, stepping, apart)
    depth, near = torch.zeros(count, dtype=torch.float64), rays.near.clone()
    warp.finish_round(stepping, samples, sigma, 0.1, known - 1, rays.far, depth, near)
    rounds, order = warp.pack_rounds([samples, front])
    drawn_depth, shown, seen = torch.zeros_like(depth), torch.zeros(count), torch.zeros(count, 4)
    drawn = warp.select_colour_samples(samples, sigma, 0.1, drawn_depth, shown)
    warp.accumulate_colours(drawn, colour.index_select(0, drawn.rows), seen)
    harmonics = warp.spherical_harmonics(directions)
    grad_directions = warp.spherical_harmonics_backward(directions, harmonics)
    layers = Layers(*(torch.randn(size, 64, generator=random) for size in (layout.width, 3)))
    ray_hidden = torch.randn(count, 64, generator=random)
    logits = warp.mlp_forward(layers, features, samples.ray, ray_hidden)
    grad_layers = warp.mlp_backward(layers, features, logits, samples, ray_hidden)
    assert grad_layers.ray_hidden is not None
    adam = [torch.randn(layout.rows, 4, generator=random), grad_table.clone(), grad_table.clone(), grad_table.abs()]
    warp.adam(adam[0], adam[1], adam[2], adam[3], 1e-2, 3)
    thickness = torch.rand(512, generator=random)
    warp.scatter_max(8, thickness, points, sigma)
    return [
        *(bits, *samples, points, features, grad_table, grad_points, *grad_rays, *front, kept, *rendering, weights),
        *(*grad_field, spread, grad_weights, apart, *grad_apart, depth, near, *rounds, order),
        *(*drawn.samples, drawn.rows, drawn.weights, drawn_depth, shown, seen),
        *(harmonics, grad_directions, logits, *grad_layers[:3], grad_layers.ray_hidden, *adam, thickness),
    ]


def test_threads_with_different_data_do_not_disturb_each_other() -> None:
    seeds = range(4)
    alone = [everything(seed) for seed in seeds]
    assert all(tensor.numel() and (not tensor.is_floating_point() or tensor.isfinite().all()) for tensor in alone[0])
    together = threading.Barrier(len(seeds))

    def repeatedly(seed: int) -> bool:
        same = True
        for _ in range(50):
            together.wait()
            same &= all(torch.equal(a, b) for a, b in zip(everything(seed), alone[seed], strict=True))
        return same

    with ThreadPoolExecutor(len(seeds)) as pool:
        assert list(pool.map(repeatedly, seeds)) == [True] * len(seeds)


COLD = """
import json, threading, torch
from nerf.kernels import grid_layout, warp
torch.set_num_threads(1)
together, results = threading.Barrier(4), {}

def encode():
    layout = grid_layout(2, 4, 8, 6, 4)
    return warp.encode(layout, torch.ones(layout.rows, 4), torch.full((5, 3), 0.3)).sum().item()

def occupied():
    return warp.occupancy_bits(torch.arange(64.0), 62.5).item()

def first_use(number):
    jobs = [encode, occupied]
    together.wait()
    results[number] = {job.__name__: job() for job in (jobs if number % 2 else reversed(jobs))}

threads = [threading.Thread(target=first_use, args=(number,)) for number in range(4)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(json.dumps(list(results.values())))
"""


def test_first_use_may_come_from_several_threads(tmp_path: Path) -> None:
    """Nothing compiled, nothing loaded: the threads find the same kernels missing at the same time."""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    answer = subprocess.run([sys.executable, "-c", COLD], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout) == [{"encode": pytest.approx(40.0), "occupied": -(1 << 63)}] * 4
    assert list(tmp_path.rglob("*.o")), "the cache was meant to be empty"
