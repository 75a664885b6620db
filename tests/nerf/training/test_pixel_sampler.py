"""The order of the pixels: each once an epoch, evenly, and whatever the order of asking."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.training.pixel_sampler import BLOCK_SIZE, PixelSampler


@pytest.mark.parametrize("count", [BLOCK_SIZE, 12 * BLOCK_SIZE, 701 * BLOCK_SIZE])
def test_every_epoch_has_every_number_once_in_another_order(count: int) -> None:
    epochs = PixelSampler(count, 3, "cpu").take(0, 3 * count).view(3, count)
    assert all(torch.equal(epoch.sort().values, torch.arange(count)) for epoch in epochs)
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])


@given(count=st.integers(1, 5 * BLOCK_SIZE))
def test_of_other_counts_an_epoch_has_some_numbers_once_more(count: int) -> None:
    epoch = -(-count // BLOCK_SIZE) * BLOCK_SIZE
    often = PixelSampler(count, 0, "cpu").take(0, epoch).bincount(minlength=count)
    assert len(often) == count and often.sum() == epoch
    assert often.max() - often.min() <= 1


def test_over_many_epochs_all_numbers_come_as_often() -> None:
    often = PixelSampler(288, 0, "cpu").take(0, 400 * 512).bincount(minlength=288)
    assert abs(often / (400 * 512 / 288) - 1).max() < 0.1


@given(data=st.data(), count=st.sampled_from([300, 3 * BLOCK_SIZE, 20 * BLOCK_SIZE + 5]))
def test_a_place_has_its_number_however_it_is_asked_for(data: st.DataObject, count: int) -> None:
    first = data.draw(st.integers(0, 5 * count))
    takes = data.draw(st.lists(st.integers(0, 2 * count), min_size=1, max_size=4))
    whole, order = PixelSampler(count, 1, "cpu").take(first, sum(takes)), PixelSampler(count, 1, "cpu")
    starts = torch.tensor([first, *takes[:-1]]).cumsum(0).tolist()
    parts = [order.take(start, each) for start, each in reversed(list(zip(starts, takes, strict=True)))]
    assert torch.equal(torch.cat(parts[::-1]), whole)


def test_a_round_takes_one_of_every_stratum_and_seeds_differ() -> None:
    first, other = (PixelSampler(1000 * BLOCK_SIZE, seed, "cpu").take(0, 1000) for seed in (0, 1))
    apart = first.sort().values.diff()  # blocks do not begin at 0
    assert apart.max() < 2 * BLOCK_SIZE and 254 < apart.float().mean() < 258
    assert not torch.equal(first, other)
    assert (first % BLOCK_SIZE).bincount(minlength=BLOCK_SIZE).max() < 20, "each stands somewhere else in its block"
