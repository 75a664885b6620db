"""Each half has its part: the left one chooses, the right one is scored. The background has no exposure."""

import math

import pytest
import torch
from torch import Tensor

from nerf.effects.exposure import expose
from nerf.fields.interface import Rendering
from stages.evaluate.half_images import MIN_PIXELS, right_half_psnr, viewing_distance

BLACK = torch.zeros(3)


def picture(height: int = 30, width: int = 41) -> Tensor:
    return 0.1 + 0.6 * torch.rand(height, width, 3, generator=torch.Generator().manual_seed(2))


def rendering(colour: Tensor, opacity: Tensor | None = None) -> Rendering:
    whole = torch.ones(colour.shape[:2])
    return Rendering(colour, whole, whole if opacity is None else opacity)


def gain(value: float) -> Tensor:
    return torch.full((3,), value)


def test_each_half_has_its_part():
    shown, truth = picture(), expose(picture(), gain(0.5))
    raw, fitted = right_half_psnr(rendering(shown), BLACK, truth)
    assert raw is not None and fitted is not None
    assert raw == pytest.approx(-10 * math.log10((shown - truth)[:, 20:].square().mean()), abs=1e-3)
    assert fitted > 70 > 20 > raw
    other = truth.clone()
    other[:, 20:] = expose(picture(), gain(-0.5))[:, 20:]  # exposed otherwise than the left half says
    wrong = expose(shown, gain(0.5))[:, 20:] - other[:, 20:]
    assert right_half_psnr(rendering(shown), BLACK, other)[1] == pytest.approx(
        -10 * math.log10(wrong.square().mean()), abs=0.01
    )


def test_what_is_not_used_neither_chooses_nor_counts():
    shown, truth = picture(), expose(picture(), gain(0.5))
    used = torch.rand(shown.shape[:2], generator=torch.Generator().manual_seed(3)) < 0.5
    truth[~used] = 0.9
    fitted = right_half_psnr(rendering(shown), BLACK, truth, used)[1]
    everything = right_half_psnr(rendering(shown), BLACK, truth)[1]
    assert fitted is not None and everything is not None and fitted > 70 > 30 > everything


@pytest.mark.parametrize("half", [0, 1])
def test_a_half_with_too_few_pixels_is_not_scored(half: int):
    shown = picture()
    used = torch.ones(30, 40, dtype=torch.bool)
    of_half = used[:, 20 * half : 20 * half + 20]
    of_half[:] = False
    of_half.view(30, 20)[:8, :8] = True
    shown = shown[:, :40]
    assert int(of_half.sum()) == MIN_PIXELS
    assert None not in right_half_psnr(rendering(shown), BLACK, shown, used)
    of_half[0, 0] = False
    assert right_half_psnr(rendering(shown), BLACK, shown, used) == (None, None)


def test_the_background_has_no_exposure():
    """Half of the pixels show a white background, as photos with alpha are scored."""
    own, white = picture(), torch.ones(3)
    opacity = (torch.rand(own.shape[:2], generator=torch.Generator().manual_seed(4)) < 0.5).float()

    def over(colour: Tensor) -> Tensor:
        return opacity[..., None] * colour + (1 - opacity[..., None]) * white

    raw, fitted = right_half_psnr(rendering(over(own), opacity), white, over(expose(own, gain(-0.8))))
    assert raw is not None and fitted is not None and fitted > 70 > 25 > raw


def test_viewing_distance_is_of_opaque_unmasked_pixels():
    depth, opacity = torch.tensor([[1.0, 2.0, 3.0, 50.0], [9.0, 9.0, 9.0, 9.0]]), torch.ones(2, 4)
    left = torch.tensor([[True] * 4, [False] * 4])
    opacity[0, 3] = 0.4
    assert viewing_distance(Rendering(torch.zeros(2, 4, 3), depth, opacity), left) == 2
    assert viewing_distance(Rendering(torch.zeros(2, 4, 3), depth, 0 * opacity), left) == math.inf


def test_colours_beyond_white_are_white():
    shown = 3 * picture()
    raw, _ = right_half_psnr(rendering(shown), BLACK, shown.clamp(0, 1))
    assert raw == 100
