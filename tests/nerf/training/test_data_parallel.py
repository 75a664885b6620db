"""Data-parallel training against one process: rank 0 is the test, rank 1 a process that meets it over gloo, or over
NCCL where two GPUs are."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, multiprocessing
from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]

from nerf.effects import ImageEffects, Images
from nerf.effects.exposure import ExposureModel
from nerf.effects.pose_refinement import PoseRefinement
from nerf.effects.vignetting import VignettingModel
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.space_maps.contraction import Contraction
from nerf.kernels import torch as reference
from nerf.runtime.ranks import Ranks, leave, packed, packed_bytes, unpacker
from nerf.training.data_parallel import LeadingTrainer, end_others, follow_first_rank
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.ray_dataset import CENTRE
from nerf.training.trainer import RAY_GEOMETRY, NonFinite
from tests.nerf.training.test_hash_grid_trainer import FIELD, TRAINER, copied, same, small_dataset

LARGE_TABLE = replace(FIELD, log2_hashmap_size=14, max_res=64)
UNBOUNDED = replace(LARGE_TABLE, space=Contraction(), min_step_size=0.05, cone_angle=0.1, background_model=True)
SHARED = replace(TRAINER, micro_batches=2, distortion_weight=0.01, depth_weight=0.1)
PLAIN, UNEVEN, EFFECTS, DENSE, BROKEN = range(5)
STEPS = 20  # the occupancy grid is updated once


def case(number: int, device: torch.device, backend: Any = reference) -> HashGridTrainer:
    """The trainer of a case, the same in every process."""
    field = {DENSE: FIELD, EFFECTS: UNBOUNDED}.get(number, LARGE_TABLE)
    settings = SHARED
    if number == UNEVEN:
        settings = replace(SHARED, micro_batches=3)
    if number == DENSE:
        settings = replace(SHARED, target_samples=1 << 16)
    dataset = small_dataset().with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5]))
    effects = ImageEffects()
    if number == EFFECTS:
        settings = replace(settings, background=(0.0, 0.0, 0.0))
        dataset = dataset._replace(pixels=dataset.pixels[:, :3].contiguous())
        poses = torch.stack([torch.eye(4)[:3]] * 2)
        images = Images(poses.to(device), torch.tensor([0, 0], device=device), torch.full((2,), 0.2, device=device))
        colours = ExposureModel(torch.zeros(2, 3, device=device)), VignettingModel.initial(images, None)
        effects = ImageEffects((PoseRefinement(torch.eye(3)[:2].to(device)),), colours)
    return HashGridTrainer(HashGridField(field, 0, backend).to(device), dataset.to(device), settings, effects)


def other_rank(port: int, kind: str) -> None:
    """What rank 1 does until rank 0 needs it no more."""
    torch.set_num_threads(1)
    device = torch.device(kind, 1) if kind == "cuda" else torch.device("cpu")

    def make(number: int) -> HashGridTrainer:
        made = case(number, device)
        if number == BROKEN:
            made.dataset.view_geometry[CENTRE] = float("nan")
        return made

    ranks = Ranks.join(TCPStore("127.0.0.1", port, is_master=False), 1, 2, device)
    follow_first_rank(ranks, make)
    leave()


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def ranks(request: pytest.FixtureRequest) -> Iterator[Ranks]:
    if request.param == "cuda" and torch.cuda.device_count() < 2:
        pytest.skip("NCCL needs two GPUs")
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    child = multiprocessing.get_context("spawn").Process(target=other_rank, args=(store.port, request.param))
    child.start()
    joined = Ranks.join(store, 0, 2, torch.device(request.param))
    yield joined
    end_others(joined)
    leave()
    child.join(60)
    assert child.exitcode == 0


def close(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.allclose(a[name], b[name]) for name in a)


@pytest.mark.parametrize("number", [PLAIN, UNEVEN, EFFECTS])
def test_two_ranks_train_with_the_bits_of_one(number: int, ranks: Ranks) -> None:
    one, both = case(number, ranks.device), LeadingTrainer(case(number, ranks.device), number, ranks)
    before, received = copied(one.state()), ranks.received_bytes
    for step in range(STEPS):
        alone, together = one.step(step, step / STEPS), both.step(step, step / STEPS)
        assert ranks.device.type == "cuda" or alone == together
    assert not same(before, one.state())
    assert ranks.device.type == "cuda" or (same(one.state(), both.state()) and not both.exchange.is_dense)
    assert both.exchange.steps == STEPS and ranks.received_bytes > received
    assert all(effect.rows.abs().max() > 0 for effect in both.effects.all)


def test_dense_gradients_equal_those_of_one_process(ranks: Ranks) -> None:
    gradients: list[list[Tensor]] = [[], []]

    def recording(into: list[Tensor]) -> SimpleNamespace:
        def adam(parameter: Tensor, gradient: Tensor, *rest) -> None:
            into.append(gradient.clone())
            reference.adam(parameter, gradient, *rest)

        return SimpleNamespace(**vars(reference) | {"adam": adam})

    trainers = [case(DENSE, ranks.device, recording(into)) for into in gradients]
    both = LeadingTrainer(trainers[1], DENSE, ranks)
    for step in range(2):
        both.load_state(copied(trainers[0].state()))  # Adam turns the last bit of a small gradient into a step
        trainers[0].step(step, 0.1)
        both.step(step, 0.1)
    assert both.exchange.is_dense
    ours, theirs = ([*sorted(of, key=lambda each: (each.shape, float(each.sum())))] for of in gradients)
    assert len(ours) == len(theirs) > 8 and any(each.numel() > 4000 and each.any() for each in ours)
    for own, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-6, atol=1e-6 * float(own.abs().max()))


@pytest.mark.parametrize("first", [1, 2])
def test_a_state_goes_on_with_another_number_of_ranks(first: int, ranks: Ranks) -> None:
    whole, alone = case(PLAIN, ranks.device), case(PLAIN, ranks.device)
    together = LeadingTrainer(case(PLAIN, ranks.device), PLAIN, ranks)
    before, after = (alone, together) if first == 1 else (together, alone)
    for step in range(6):
        whole.step(step, 0.1)
        if step == 3:
            after.load_state(copied(before.state()))
        (before if step < 3 else after).step(step, 0.1)
    assert same(whole.state(), after.state()) or ranks.device.type == "cuda"


def test_what_is_not_finite_is_told_to_all_ranks(ranks: Ranks) -> None:
    one, both = case(PLAIN, ranks.device), LeadingTrainer(case(PLAIN, ranks.device), PLAIN, ranks)
    good = copied(both.state())
    both.load_state(good | {"model.colour_out": torch.full_like(good["model.colour_out"], float("nan"))})
    with pytest.raises(NonFinite) as failure:
        both.step(0, 0.1)
    assert failure.value.quantity == "loss"
    both.load_state(good)
    result = both.step(0, 0.1)
    assert result.rays == len(failure.value.batch["jitter"]), "those of both ranks"
    assert result == one.step(0, 0.1) or ranks.device.type == "cuda"


def test_rays_that_another_rank_finds_broken_are_named(ranks: Ranks) -> None:
    both = LeadingTrainer(case(BROKEN, ranks.device), BROKEN, ranks)
    with pytest.raises(NonFinite) as failure:
        both.step(0, 0.1)
    assert failure.value.quantity == RAY_GEOMETRY
    assert not failure.value.batch["origins"].isfinite().all() and len(failure.value.batch["jitter"]) == 4


def test_shares_cover_every_micro_batch_once() -> None:
    for size in (1, 2, 3, 5):
        shares = [Ranks(rank, size, torch.device("cpu"), nccl=False).share(7) for rank in range(size)]
        assert [number for share in shares for number in share] == [*range(7)]
        assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_packed_tensors_come_out_as_they_went_in() -> None:
    tensors = [torch.tensor(0.5), torch.rand(3, 5), torch.rand(0, 3), torch.arange(7), torch.rand(2).double()]
    data = packed(tensors)
    assert len(data) == packed_bytes(tensors)
    take: Callable[..., Tensor] = unpacker(data)
    assert all(torch.equal(take(each.dtype, each.shape), each) for each in tensors)
