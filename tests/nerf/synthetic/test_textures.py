import pytest
import torch

from nerf.synthetic import textures
from nerf.synthetic.textures import LATTICE, make_noise

TEXTURES = ("mosaic", "marble", "wrapping", "banded", "foliage", "doughnut", "peel")


def points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def test_noise_at_whole_numbers_is_the_lattice():
    noise = make_noise(3)
    whole = torch.tensor([[0.0, 1, 2], [5, 60, 63], [LATTICE, LATTICE + 1, -1]])
    expected = noise.lattice[[0, 5, 0], [1, 60, 1], [2, 63, LATTICE - 1]]
    torch.testing.assert_close(noise.octave(whole), expected, rtol=0, atol=1e-5)


def test_noise_is_smooth_across_cells():
    noise, near = make_noise(0), points(1000).double() * 20
    slope = (noise.octave(near + 1e-4) - noise.octave(near)).abs() / 1e-4
    assert 0.1 < slope.max() < 3 * 1.5  # the smooth step is at most 1.5 steep, in each of three directions


def test_octaves_add_detail_and_stay_in_range():
    noise, near = make_noise(0), points(5000) * 20
    one, five = noise.fractal(near, 1), noise.fractal(near, 5)
    assert 0 <= five.min() < 0.3
    assert 0.7 < five.max() <= 1
    assert 0.01 < (five - one).std() < 0.2


def test_seeds_give_different_noise_and_one_seed_the_same():
    assert torch.equal(make_noise(1).lattice, make_noise(1).lattice)
    assert not torch.equal(make_noise(1).lattice, make_noise(2).lattice)


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_colourful_and_depend_on_the_point_alone(name: str):
    texture, noise, where = getattr(textures, name), make_noise(0), points(4000)
    colour = texture(noise, where)
    assert colour.isfinite().all()
    assert colour.min() >= 0
    assert 0.3 < colour.max() < 1.6
    assert colour.std(0).max() > 0.03
    torch.testing.assert_close(texture(noise, where[:7]), colour[:7], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", TEXTURES)
def test_no_texture_repeats_itself(name: str):
    texture, noise, where = getattr(textures, name), make_noise(0), points(2000) * 0.3
    here = texture(noise, where).flatten()
    for shift in ([0.5, 0.0, 0.0], [0.0, 0.35, 0.0], [-0.2, 0.4, 0.0]):
        there = texture(noise, where + torch.tensor(shift)).flatten()
        assert not torch.allclose(here, there, atol=0.1)
        assert torch.corrcoef(torch.stack([here, there]))[0, 1] < 0.95
