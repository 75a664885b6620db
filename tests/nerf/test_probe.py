import math

import torch

from nerf.metrics import PSNR_LIMIT
from nerf.model import Rendering
from nerf.probe import make_probe, measure
from nerf.ray_bank import RayBank, build_ray_bank
from nerf.rays import Rays


class Painted:
    """A model that answers with each ray's first direction component as grey, half opaque."""

    chunk_rays = 64

    def density(self, points):
        raise NotImplementedError

    def colour(self, points, directions):
        raise NotImplementedError

    def render(self, rays: Rays, background):
        grey = (rays.directions[..., :1] / rays.directions[..., 2:]).expand(*rays.near.shape, 3)
        return Rendering(grey, rays.far, torch.full_like(rays.far, 0.5))


def painted_bank() -> RayBank:
    values = torch.arange(256)
    directions = torch.stack([values / 255, values * 0.0, values * 0.0 + 1], -1)[None]
    photo = values.to(torch.uint8)[None, :, None].expand(1, 256, 3)
    return build_ray_bank([photo], [0], [directions], torch.eye(3, 4)[None], torch.ones(1), torch.full((1,), 2.0))


def test_a_perfect_model_scores_the_limit() -> None:
    result = measure(Painted(), make_probe(painted_bank(), 3000, torch.zeros(3), seed=0))
    assert result.psnr == PSNR_LIMIT
    assert result.opacity == 0.5


def test_flat_psnr_is_the_variance_of_the_colours() -> None:
    probe = make_probe(painted_bank(), 20_000, torch.zeros(3), seed=0)
    assert abs(probe.flat_psnr - -10 * math.log10(1 / 12)) < 0.2


def test_a_probe_is_always_the_same() -> None:
    first, again, other = (make_probe(painted_bank(), 50, torch.zeros(3), seed).colours for seed in (4, 4, 5))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
