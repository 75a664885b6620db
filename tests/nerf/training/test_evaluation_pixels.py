import math

import pytest
import torch

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.training.evaluation_pixels import (
    evaluate,
    render_patches,
    sample_evaluation_patches,
    sample_evaluation_pixels,
)
from nerf.training.psnr import PSNR_LIMIT
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images


class Painted:
    """A model that answers with each ray's first direction component as grey, half opaque."""

    chunk_rays = 64

    def density(self, points):
        raise NotImplementedError

    def density_and_colour(self, points, directions):
        raise NotImplementedError

    def render(self, rays: Rays, background):
        grey = (rays.directions[..., :1] / rays.directions[..., 2:]).expand(*rays.near.shape, 3)
        return Rendering(grey, rays.far, torch.full_like(rays.far, 0.5))


def painted_dataset() -> RayDataset:
    values = torch.arange(256)
    directions = torch.stack([values / 255, values * 0.0, values * 0.0 + 1], -1)[None]
    photo = values.to(torch.uint8)[None, :, None].expand(1, 256, 3)
    return ray_dataset_from_images(
        [photo], [0], [directions], torch.eye(3, 4)[None], torch.ones(1), torch.full((1,), 2.0)
    )


def test_a_perfect_model_scores_the_limit() -> None:
    result = evaluate(Painted(), sample_evaluation_pixels(painted_dataset(), 3000, torch.zeros(3), seed=0))
    assert result.psnr == PSNR_LIMIT
    assert result.opacity == 0.5


def test_flat_psnr_is_the_variance_of_the_colours() -> None:
    pixels = sample_evaluation_pixels(painted_dataset(), 20_000, torch.zeros(3), seed=0)
    assert abs(pixels.mean_colour_psnr - -10 * math.log10(1 / 12)) < 0.2


def test_a_probe_is_always_the_same() -> None:
    first, again, other = (
        sample_evaluation_pixels(painted_dataset(), 50, torch.zeros(3), seed).colours for seed in (4, 4, 5)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def two_photos(grey: float = 0.0) -> RayDataset:
    """Photos of 20 x 30 and 13 x 17 pixels whose colours tell view, row and column; Painted paints them ``grey``."""
    photos, directions = [], []
    for view, (height, width) in enumerate(((20, 30), (13, 17))):
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        photos.append(torch.stack([torch.full_like(x, 100 * view), y, x], -1).to(torch.uint8))
        directions.append(torch.tensor([grey, 0.0, 1.0]).expand(height, width, 3))
    poses = torch.eye(3, 4).expand(2, 3, 4)
    return ray_dataset_from_images(photos, [0, 1], directions, poses, torch.ones(2), torch.full((2,), 2.0))


def test_patches_are_squares_of_the_photos() -> None:
    shown, truth = render_patches(Painted(), sample_evaluation_patches(two_photos(), 40, 9, torch.zeros(3), seed=1))
    assert shown.shape == truth.shape == (40, 9, 9, 3) and not shown.any()
    values = (truth * 255).round().long()
    steps = torch.arange(9)
    assert (values[..., 0] == values[:, :1, :1, 0]).all(), "a patch lies in one photo"
    assert (values[..., 1] == values[:, :1, :1, 1] + steps[:, None]).all()
    assert (values[..., 2] == values[:, :1, :1, 2] + steps).all()
    assert set(values[:, 0, 0, 0].tolist()) == {0, 100}, "both photos have some"
    assert values[values[:, 0, 0, 0] == 0][..., 1].max() == 19, "some touch the border"


def test_patches_fit_into_the_smallest_photo() -> None:
    patches = sample_evaluation_patches(two_photos(), 5, 50, torch.zeros(3), seed=1)
    assert patches.used.shape == (5, 13, 13) and patches.used.all()


def test_patches_know_what_masks_ignore() -> None:
    ignored = torch.zeros(20, 30, dtype=torch.bool)
    ignored[:, :10] = True
    dataset = two_photos().with_masks([ignored, torch.ones(13, 17, dtype=torch.bool)])
    patches = sample_evaluation_patches(dataset, 40, 9, torch.zeros(3), seed=1)
    _, truth = render_patches(Painted(), patches)
    values = (truth * 255).round().long()
    assert (values[..., 0] == 0).all(), "nothing of the second photo is used"
    assert torch.equal(patches.used, values[..., 2] >= 10)
    assert 0 < patches.used.float().mean() < 1


def test_a_picture_is_as_bright_as_a_photo_can_be() -> None:
    shown, _ = render_patches(Painted(), sample_evaluation_patches(two_photos(grey=1.5), 4, 9, torch.zeros(3), seed=1))
    assert (shown == 1).all()


def test_scores_clamp_colours_like_a_photo() -> None:
    too_bright, white = (
        evaluate(Painted(), sample_evaluation_pixels(two_photos(grey), 50, torch.zeros(3), seed=0)).psnr
        for grey in (1.5, 1.0)
    )
    assert too_bright == white


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_what_is_no_finite_number_has_no_score(value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    painted = Painted.render
    monkeypatch.setattr(Painted, "render", lambda *given: painted(*given)._replace(colour=value * torch.ones(1, 50, 3)))
    with pytest.raises(ValueError, match="mean squared error"):
        evaluate(Painted(), sample_evaluation_pixels(two_photos(), 50, torch.zeros(3), seed=0))
