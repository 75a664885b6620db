"""Warp's kernels from several threads: the same bits, whoever calls, whenever, however often."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import warp as wp
from torch import Tensor

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Contraction
from nerf.kernels import RayStepping, grid_layout, warp
from nerf.kernels.torch.occupancy import binary_occupancy
from nerf.runtime.parallel import take_over_cores
from nerf.runtime.randomness import generator
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images

ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warp.compile_kernels("cpu")


@pytest.fixture
def use_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Sets the number of threads, both torch's and those of chunks."""
    before = torch.get_num_threads()

    def use(count: int) -> None:
        monkeypatch.setattr("nerf.runtime.parallel._taken", None)
        torch.set_num_threads(count)

    yield use
    torch.set_num_threads(before)


def test_kernels_compile_on_all_cores(use_cores: Callable[[int], None], monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(wp, "load_module", lambda *_, max_workers, **__: asked.append(max_workers))
    use_cores(3)
    take_over_cores()
    warp.compile_kernels("cpu")
    assert torch.get_num_threads() == 1 and asked == [3]


def noise_dataset() -> RayDataset:
    """Two opposite views of coloured noise, opaque and transparent, from 3 units away."""
    grid = (torch.arange(12) + 0.5) / 12 - 0.5
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    ray_directions = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)
    photo = torch.randint(256, (12, 12, 4), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    photo[:6, :, 3] = 255
    front = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3]])
    back = torch.tensor([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 3]])
    near, far = torch.full((2,), 1.0), torch.full((2,), 5.0)
    return ray_dataset_from_images([photo] * 2, [0, 0], [ray_directions], torch.stack([front, back]), near, far)


BOUNDED = HashGridSettings(
    num_levels=3, log2_hashmap_size=8, base_res=4, max_res=16, diagonal_steps=32, occupancy_resolution=8
)
OUTDOORS = replace(BOUNDED, space=Contraction(), min_step_size=0.1, cone_angle=0.1, background_model=True)


def small_trainer(field: HashGridSettings) -> HashGridTrainer:
    """A step has sixteen rays, two of which run to points whose distance is known."""
    background = (0.0, 0.0, 0.0) if field.background_model else "random"
    settings = HashGridTrainerSettings(
        3, background, target_samples=512, micro_batches=4, distortion_weight=1e-3, depth_weight=0.1
    )
    model = HashGridField(field, 0, warp)
    model.set_occupancy(warp.occupancy_bits(torch.rand(512, generator=torch.Generator().manual_seed(2)), 0.3))
    opaque = (noise_dataset().pixels[:, 3] == 255).nonzero()[:, 0]
    trainer = HashGridTrainer(
        model, noise_dataset().with_sparse_depths(opaque, torch.full_like(opaque, 3.0, dtype=torch.float32)), settings
    )
    trainer.samples_per_ray.fill_(32)
    return trainer


def copied(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in state.items()}


def run_briefly(trainer: HashGridTrainer, start: dict[str, Tensor]) -> dict[str, Tensor]:
    """A step and a refresh of the occupancy grid, from the same beginning each time."""
    trainer.load_state(start)
    trainer.step(0, 0.0)
    trainer.occupancy_grid.update(15, generator("cpu", 3, 15, 1))
    return trainer.state()


@pytest.mark.parametrize("field", [BOUNDED, OUTDOORS], ids=["bounded", "outdoors"])
def test_training_bits_are_the_same_on_any_threads(
    field: HashGridSettings, use_cores: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerf.fields.occupancy_grid.CHUNK_POINTS", 128)  # several chunks even here
    trainer, used = small_trainer(field), set[int]()
    guided = [
        int((trainer._batch(0, 0.0, chunk, trainer._rays_per_micro_batch()).known_depth > 0).sum())
        for chunk in range(4)
    ]
    assert sum(guided) == 2 and trainer._rays_per_micro_batch() == 4
    forward = trainer.model.forward
    monkeypatch.setattr(trainer.model, "forward", lambda *chunk: used.add(threading.get_ident()) or forward(*chunk))
    start = copied(trainer.state())
    use_cores(1)
    wanted = copied(run_briefly(trainer, start))
    changed = {name for name in wanted if not torch.equal(wanted[name], start[name])}
    assert {
        "model.table",
        "model.occupancy_bits",
        "optical_thickness",
        "exp_avg.table",
        "exp_avg_sq.colour_out",
    } <= changed
    assert ("model.background_table" in changed) == field.background_model
    for repeat in range(200):
        use_cores(count := (1, 2, 4)[repeat % 3])
        found = run_briefly(trainer, start)
        different = [name for name in wanted if not torch.equal(found[name], wanted[name])]
        assert not different, f"{different} on {count} threads, repeat {repeat}"
    assert len(used) > 4, "chunks were meant to run on one, two and four threads"


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
    hidden = torch.randn(len(samples.t), 64, generator=random)
    warp.add_ray_relu(samples, hidden, torch.randn(count, 64, generator=random))
    grad_hidden, grad_rectified = hidden.clone(), hidden + 1
    ray_hidden = warp.add_ray_relu_backward(samples, hidden, grad_hidden)
    warp.relu_backward(hidden, grad_rectified)
    adam = [torch.randn(layout.rows, 4, generator=random), grad_table.clone(), grad_table.clone(), grad_table.abs()]
    warp.adam(adam[0], adam[1], adam[2], adam[3], 1e-2, 3)
    thickness = torch.rand(512, generator=random)
    warp.scatter_max(8, thickness, points, sigma)
    return [
        *(bits, *samples, points, features, grad_table, grad_points, *grad_rays, *front, kept, *rendering, weights),
        *(*grad_field, spread, grad_weights, apart, *grad_apart, depth, near, *rounds, order),
        *(*drawn.samples, drawn.rows, drawn.weights, drawn_depth, shown, seen),
        *(harmonics, grad_directions, hidden, grad_hidden, grad_rectified, ray_hidden, *adam, thickness),
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
