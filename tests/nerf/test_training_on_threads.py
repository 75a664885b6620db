"""Training of the hash-grid field on Warp: the same bits on any number of threads."""

import threading
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.space_maps.contraction import Contraction
from nerf.kernels import warp
from nerf.runtime.randomness import generator
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warp.compile_kernels("cpu")


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
        int((trainer.draw_batch(0, 0.0, chunk, trainer.rays_per_micro_batch()).known_depth > 0).sum())
        for chunk in range(4)
    ]
    assert sum(guided) == 2 and trainer.rays_per_micro_batch() == 4
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
