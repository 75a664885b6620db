"""The pose of a photo, found in a field; that it is found on photos: tests/stages/effects/test_ab_runs.py."""

import torch
from torch import Tensor

from nerf.effects.pose_refinement import fit_pose
from nerf.fields.hash_grid import HashGridField, HashGridGradients, HashGridPass, HashGridSettings, SampleCapacities
from nerf.geometry.rays import Rays
from nerf.kernels import torch as reference

SMALLER = 1 / 16  # a power of two: numbers that differ by it have the same digits
FIELD = HashGridSettings(
    num_levels=2, log2_hashmap_size=10, base_res=4, max_res=16, diagonal_steps=32, occupancy_resolution=16
)


class Small(HashGridField):
    """What the same field is in a scene that is smaller by SMALLER."""

    def forward(
        self,
        rays: Rays,
        jitter: Tensor,
        thinning_offset: Tensor,
        background: Tensor,
        capacities: SampleCapacities | None = None,
    ) -> HashGridPass:
        large = Rays(rays.origins / SMALLER, rays.directions, rays.near / SMALLER, rays.far / SMALLER)
        return super().forward(large, jitter, thinning_offset, background, capacities)

    def rays_backward(self, forward_pass: HashGridPass, gradients: HashGridGradients) -> tuple[Tensor, Tensor]:
        origins, directions = super().rays_backward(forward_pass, gradients)
        return origins / SMALLER, directions


def test_a_fitted_pose_scales_with_the_scene() -> None:
    random = torch.Generator().manual_seed(1)
    directions = 0.3 * torch.randn(100, 3, generator=random) + torch.tensor([0.0, 0, 1])
    directions = torch.nn.functional.normalize(directions, dim=-1)
    near, far = torch.full((100,), 0.5), torch.full((100,), 3.0)
    target, black = torch.rand(100, 3, generator=random), torch.zeros(3)
    found = []
    for field, scale in ((HashGridField(FIELD, 0, reference), 1.0), (Small(FIELD, 0, reference), SMALLER)):
        field.table *= 3000  # something to be seen
        rays = Rays(scale * torch.tensor([0.0, 0, -1.5]).repeat(100, 1), directions, scale * near, scale * far)
        found.append(fit_pose(field, rays, target, black, distance=scale))
    large, small = found
    assert float(large.turn.norm()) > 1e-3 < float(large.shift.norm())
    assert torch.equal(small.turn, large.turn) and torch.equal(small.shift, SMALLER * large.shift)
