import pytest
import torch

from nerf.fields.interface import Rendering
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays
from nerf.rendering.images import render_image


class Gradient:
    """A model whose rendering tells which ray it was, and how many rays came at a time."""

    chunk_rays = 5

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def density(self, points: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError

    def density_and_colour(self, points: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        raise NotImplementedError

    def render(self, rays: Rays, background: torch.Tensor) -> Rendering:
        assert torch.is_inference_mode_enabled()
        self.sizes.append(len(rays.near))
        return Rendering(rays.origins * background, rays.near, rays.far)


def grid(height: int, width: int) -> Rays:
    numbers = torch.arange(height * width * 3, dtype=torch.float32).reshape(height, width, 3) / 100
    directions = torch.tensor([0.0, 0.0, 1.0]).expand(height, width, 3)
    return Rays(numbers, directions, numbers[..., 0], numbers[..., 1])


@pytest.mark.parametrize("chunk", [None, 1, 7, 12, 100])
def test_every_pixel_is_in_its_place(chunk: int | None) -> None:
    model, rays, told = Gradient(), grid(3, 4), []
    image = render_image(model, rays, torch.tensor([1.0, 2.0, 3.0]), chunk, told.append)
    assert torch.equal(image.colour, rays.origins * torch.tensor([1.0, 2.0, 3.0]))
    assert torch.equal(image.depth, rays.near) and torch.equal(image.opacity, rays.far)
    assert sum(model.sizes) == 12 and max(model.sizes) <= (chunk or model.chunk_rays)
    assert len(told) == len(model.sizes) and told == sorted(told) and told[-1] == 1


def test_chunks_change_the_paper_field_by_rounding_only() -> None:
    model = VanillaNerf(VanillaSettings(depth=2, width=8, samples_coarse=4, samples_fine=4), 0)
    rays = grid(4, 5)._replace(near=torch.zeros(4, 5), far=torch.ones(4, 5))
    whole, cut = (render_image(model, rays, torch.ones(3), chunk) for chunk in (100, 3))
    assert whole.opacity.max() > 0.05
    torch.testing.assert_close(cut.colour, whole.colour, atol=1e-6, rtol=0)
    assert not whole.colour.requires_grad
