import itertools

import torch

from nerf.runtime.randomness import generator


def draw(*numbers: int) -> list[float]:
    return torch.rand(4, generator=generator("cpu", *numbers)).tolist()


def test_equal_numbers_give_equal_draws_whatever_was_drawn_before() -> None:
    first = draw(1, 2, 3)
    torch.manual_seed(99)
    torch.rand(7)
    assert draw(1, 2, 3) == first


def test_every_list_of_numbers_has_its_own_stream() -> None:
    lists = [(), (0,), (0, 0), (1, 2), (12,), (2, 1), (-1,), (2**70,)]
    draws = [draw(5, *numbers) for numbers in lists] + [draw(0)]
    assert all(a != b for a, b in itertools.combinations(draws, 2))


def test_neighbouring_counters_are_uncorrelated() -> None:
    first = torch.tensor([draw(0, step)[0] for step in range(2000)], dtype=torch.float64)
    second = torch.tensor([draw(0, step)[1] for step in range(2000)], dtype=torch.float64)
    # The standard errors are 0.0065 for a mean of uniforms and 0.022 for a correlation.
    assert abs(first.mean() - 0.5) < 0.03
    assert abs(torch.corrcoef(torch.stack([first[1:], first[:-1]]))[0, 1]) < 0.1
    assert abs(torch.corrcoef(torch.stack([first, second]))[0, 1]) < 0.1
