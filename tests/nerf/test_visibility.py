"""Where enough photos look: against a projection of every cell, and that nothing else is ever sampled."""

import math
from dataclasses import replace

import pytest
import torch

from nerf.contraction import uncontract
from nerf.depth_range import NEAR_MARGIN
from nerf.grid_field import GridField, GridSettings
from nerf.grid_training import GridTrainer, GridTrainerSettings
from nerf.kernels import CONTRACTED_BOX, reference
from nerf.kernels.cache import cell_corners, grown, is_occupied
from nerf.kernels.marching import unit_coordinates
from nerf.ray_bank import RayBank, build_ray_bank
from nerf.visibility import photos_looking, usable_cells

SIZE, HALF = 12, 0.5  # pixels of a photo, and half its width at a distance of one
NEAR, FAR = 1.0, 40.0
SIDE = 32
FIELD = GridSettings(levels=2, log2_rows=10, coarsest=4, finest=16, steps=32, cache_cells=16, contracted=True)
TRAINER = GridTrainerSettings(seed=3, background=(0.0, 0.0, 0.0), samples=1024, most_rays=256, least_photos=3)


def bank(count: int = 4, half: float = HALF) -> RayBank:
    """Photos from 2.5 units away, a fifth of the circle apart, that all look at the origin."""
    grid = 2 * half * ((torch.arange(SIZE) + 0.5) / SIZE - 0.5)
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    bearings = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)
    poses = []
    for angle in torch.arange(count) * (2 * math.pi / 5):
        forward = torch.stack([-angle.cos(), -angle.sin(), torch.zeros(())])
        right = torch.stack([-angle.sin(), angle.cos(), torch.zeros(())])
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
        poses.append(torch.cat([rotation, -2.5 * forward[:, None]], 1))
    photo = torch.randint(0, 256, (SIZE, SIZE, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    near, far = torch.full((count,), NEAR), torch.full((count,), FAR)
    return build_ray_bank([photo] * count, [0] * count, [bearings], torch.stack(poses), near, far)


def centres(side: int) -> torch.Tensor:
    """Where the cells' middles are in the scene."""
    line = 2 * CONTRACTED_BOX * ((torch.arange(side) + 0.5) / side - 0.5)
    return uncontract(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1))


def projected(views: RayBank, points: torch.Tensor, near: float) -> torch.Tensor:
    """How many photos have the points in their picture, between ``near`` and far."""
    count = torch.zeros(points.shape[:-1], dtype=torch.int32)
    for geometry in views.geometry.T:
        local = (points - geometry[9:12]) @ geometry[:9].view(3, 3)
        edge = HALF * (1 - 1 / SIZE)  # the middles of the outermost pixels
        inside = (local[..., :2].abs() <= edge * local[..., 2:]).all(-1) & (local[..., 2] > 0)
        distance = local.norm(dim=-1)
        count += (inside & (distance > near) & (distance < FAR)).int()
    return count


def test_photos_are_counted_as_a_projection_counts_them() -> None:
    views = bank()
    found, true = photos_looking(views, SIDE).photos, projected(views, centres(SIDE), NEAR)
    assert (found >= true).all(), "no photo that looks into a cell is overlooked"
    assert set(found.unique().tolist()) == set(range(len(views.near) + 1))
    for least in range(1, len(views.near) + 1):
        around = grown(grown(true >= least))
        assert (around[found >= least]).float().mean() > 0.97, "and others are next to one"


def test_the_foreground_begins_where_the_nearest_point_is_known() -> None:
    views = bank()
    found, true = photos_looking(views, SIDE).behind, projected(views, centres(SIDE), NEAR / NEAR_MARGIN) > 0
    assert found[true].all() and grown(grown(true))[found].float().mean() > 0.97
    one = bank(1)
    along = torch.tensor([[2.5 - t, 0.0, 0.0] for t in (-3.0, 0.4, 1.15, 1.7, 2.5, 20.0)])
    cells = tuple((SIDE * unit_coordinates(along, True)).long().T)
    looks = photos_looking(one, SIDE)
    assert looks.photos[cells].tolist() == [0, 0, 1, 1, 1, 1], "behind a camera and before near it sees nothing"
    assert looks.behind[cells].tolist() == [False, False, False, True, True, True]


def test_before_all_foregrounds_several_photos_are_needed() -> None:
    views = bank()
    looks = photos_looking(views, 64)
    x, y, z = (64 * cell_corners(64, torch.arange(64**3))).long().unbind(-1)
    for least in (1, 2, 3):
        usable = usable_cells(views, least, 64)
        count, behind = looks.photos[x, y, z], looks.behind[x, y, z]
        assert torch.equal(usable, (count >= least) | behind)
        assert (~usable & (count > 0)).any() == (least > 1)


def test_nothing_is_ever_sampled_elsewhere_nor_found_there() -> None:
    field = GridField(FIELD, 0, reference)
    views = bank(4, 0.15)
    trainer = GridTrainer(field, views, TRAINER)
    usable = usable_cells(views, 3, 16)
    assert 0.02 < usable.float().mean() < 0.98
    numbers = torch.arange(16**3, dtype=torch.int32)
    for step in range(40):
        assert not (is_occupied(field.bits, numbers) & ~usable).any()
        trainer.step(step, step / 40)
    elsewhere = cell_corners(16, numbers[~usable]) + 0.5 / 16
    assert not field.density(uncontract(2 * CONTRACTED_BOX * (elsewhere - 0.5))).any()
    assert field.unit_density(elsewhere).any(), "which is not what the networks say"


@pytest.mark.parametrize(("views", "contracted", "least"), [(1, True, 3), (2, True, 3), (4, False, 3), (4, True, 1)])
def test_where_photos_are_few_or_space_ends_all_of_it_is_used(views: int, contracted: bool, least: int) -> None:
    field = GridField(replace(FIELD, contracted=contracted), 0, reference)
    GridTrainer(field, bank(views), replace(TRAINER, least_photos=least))
    assert (field.bits == -1).all()
