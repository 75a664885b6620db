"""Where enough photos look: against a projection of every cell, and that nothing else is ever sampled."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.near_far import NEAR_MARGIN
from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.contraction import Contraction, uncontract
from nerf.kernels import torch as reference
from nerf.kernels.torch.marching import unit_coordinates
from nerf.kernels.torch.occupancy import cell_corners, cell_numbers, grown, is_occupied
from nerf.training import frustum_mask
from nerf.training.frustum_mask import compute_frustum_mask
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.ray_dataset import CENTRE, ROTATION, RayDataset, ray_dataset_from_images

SIZE, HALF = 12, 0.5  # pixels of a photo, and half its width at a distance of one
NEAR, FAR = 1.0, 40.0
FIELD = HashGridSettings(
    num_levels=2,
    log2_hashmap_size=10,
    base_res=4,
    max_res=16,
    diagonal_steps=32,
    occupancy_resolution=16,
    space=Contraction(),
)
TRAINER = HashGridTrainerSettings(seed=3, background=(0.0, 0.0, 0.0), target_samples=1024, min_photos=3)


def dataset(count: int = 4, half: float = HALF) -> RayDataset:
    """Photos from 2.5 units away, a fifth of the circle apart, that all look at the origin."""
    grid = 2 * half * ((torch.arange(SIZE) + 0.5) / SIZE - 0.5)
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    ray_directions = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)
    poses = []
    for angle in torch.arange(count) * (2 * math.pi / 5):
        forward = torch.stack([-angle.cos(), -angle.sin(), torch.zeros(())])
        right = torch.stack([-angle.sin(), angle.cos(), torch.zeros(())])
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
        poses.append(torch.cat([rotation, -2.5 * forward[:, None]], 1))
    photo = torch.randint(0, 256, (SIZE, SIZE, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    near, far = torch.full((count,), NEAR), torch.full((count,), FAR)
    return ray_dataset_from_images([photo] * count, [0] * count, [ray_directions], torch.stack(poses), near, far)


def knowing(views: RayDataset) -> RayDataset:
    """With a sparse point: the rule holds where some are known."""
    return views.with_sparse_depths(torch.tensor([5]), torch.tensor([2.5]))


def middles(cells: int) -> torch.Tensor:
    """Where the cells' middles are in the scene, in the order of the cache."""
    unit = cell_corners(cells, torch.arange(cells**3)) + 0.5 / cells
    return uncontract(2 * Contraction.half * (unit - 0.5))


def projected(views: RayDataset, points: torch.Tensor, near: float, half: float) -> torch.Tensor:
    """How many photos have the points in their picture, between ``near`` and far."""
    photos = torch.zeros(len(points), dtype=torch.int32)
    for geometry in views.view_geometry.T:
        local = (points - geometry[CENTRE]) @ geometry[ROTATION].view(3, 3)
        inside = (local[:, :2].abs() <= half * (1 - 1 / SIZE) * local[:, 2:]).all(-1) & (local[:, 2] > 0)
        distance = local.norm(dim=-1)
        photos += (inside & (distance > near) & (distance < FAR)).int()
    return photos


@pytest.mark.parametrize("half", [0.15, 0.5, 1.3])
@pytest.mark.parametrize("least", [1, 2, 3, 4])
def test_a_cell_needs_enough_photos_or_a_foreground(half: float, least: int) -> None:
    views = dataset(half=half)
    usable, points = compute_frustum_mask(views, Contraction(), least, 64), middles(64)
    photos = projected(views, points, NEAR, half)
    wanted = (photos >= least) | (projected(views, points, NEAR / NEAR_MARGIN, half) > 0)
    assert usable[wanted].all(), "none is overlooked, however wide the lens"
    numbers = cell_numbers(64, (cell_corners(64, torch.arange(64**3)) + 0.5 / 64)).long()
    assert torch.equal(numbers, torch.arange(64**3))
    cube = torch.zeros(64, 64, 64, dtype=torch.bool)
    x, y, z = (64 * cell_corners(64, numbers)).long().unbind(-1)
    cube[x, y, z] = wanted
    assert not (usable & ~grown(grown(cube))[x, y, z]).any(), "and others are next to one"
    if half < 0.2:  # wide photos see what is right before the others from their foregrounds on
        assert (~usable & (photos > 0)).any() == (least > 1)


def test_photos_together_find_what_each_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, found = torch.get_num_threads(), []
    try:
        for count, together in ((1, 1), (2, 2), (2, 16)):
            torch.set_num_threads(count)
            monkeypatch.setattr(frustum_mask, "TOGETHER", together)
            found.append(compute_frustum_mask(dataset(5, 0.15), Contraction(), 3, 64))
    finally:
        torch.set_num_threads(threads)
    assert 0 < found[0].float().mean() < 1
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_all_trainers_of_a_bank_ask_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def looked_at(*given: Any) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(given[-1])
        return own(*given)

    own = frustum_mask._looked_at
    monkeypatch.setattr(frustum_mask, "_looked_at", looked_at)
    views = knowing(dataset())
    fields = [HashGridField(FIELD, seed, reference) for seed in (0, 1)]
    for field in fields:
        HashGridTrainer(field, views, TRAINER)
    assert asked == [0, 1, 2, 3] and torch.equal(fields[0].occupancy_bits, fields[1].occupancy_bits)
    compute_frustum_mask(dataset(), Contraction(), 3, 16)
    compute_frustum_mask(views, Contraction(), 2, 16)
    assert len(asked) == 12, "another dataset, and another question"


def test_space_before_one_photos_foreground_is_left_empty() -> None:
    along = torch.tensor([[2.5 - t, 0.0, 0.0] for t in (-3.0, 0.4, 1.2, 1.7, 2.5, 20.0)])
    usable = compute_frustum_mask(dataset(2), Contraction(), 2, 64)
    numbers = cell_numbers(64, unit_coordinates(along, True)).long()
    assert usable[numbers].tolist() == [False, False, False, True, True, True]


def test_nothing_is_ever_sampled_elsewhere_nor_found_there() -> None:
    field = HashGridField(FIELD, 0, reference)
    views = knowing(dataset(4, 0.15))
    trainer = HashGridTrainer(field, views, TRAINER)
    usable = compute_frustum_mask(views, Contraction(), 3, 16)
    assert 0.02 < usable.float().mean() < 0.98
    numbers = torch.arange(16**3, dtype=torch.int32)
    for step in range(40):
        assert not (is_occupied(field.occupancy_bits, numbers) & ~usable).any()
        trainer.step(step, step / 40)
    elsewhere = cell_corners(16, numbers[~usable]) + 0.5 / 16
    assert not field.density(uncontract(2 * Contraction.half * (elsewhere - 0.5))).any()
    assert field.unit_density(elsewhere).any(), "which is not what the networks say"


@pytest.mark.parametrize(
    ("views", "space", "least"),
    [
        (knowing(dataset(2)), Contraction(), 3),
        (dataset(), Contraction(), 3),
        (knowing(dataset()), Box(), 3),
        (knowing(dataset()), Contraction(), 1),
    ],
    ids=["two photos", "no points", "a box", "one is enough"],
)
def test_where_the_rule_says_nothing_all_of_space_is_used(views: RayDataset, space: SpaceMap, least: int) -> None:
    field = HashGridField(replace(FIELD, space=space), 0, reference)
    HashGridTrainer(field, views, replace(TRAINER, min_photos=least))
    assert (field.occupancy_bits == -1).all()
