"""Small hash-grid fields in float64, and rays through them."""

from dataclasses import replace

import pytest
import torch

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels import torch as reference
from nerf.kernels import warp

SMALL = HashGridSettings(
    num_levels=2, log2_hashmap_size=9, base_res=3, max_res=9, diagonal_steps=24, occupancy_resolution=8
)

CONTRACTED = replace(SMALL, space=Contraction(), min_step_size=0.1, cone_angle=0.2)

OUTDOORS = replace(CONTRACTED, background_model=True)

DIFFUSE = replace(SMALL, view_dependence=False)

FORWARD = replace(
    OUTDOORS, space=Ndc((0.1, -1.5, 0.0), ((0.96, 0.28, 0.0), (0.0, 0.0, -1.0), (-0.28, 0.96, 0.0)), (1.2, 1.4), 0.4)
)

BACKENDS = pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])


def field(settings: HashGridSettings = SMALL, seed: int = 1) -> HashGridField:
    """A field in float64 whose features are large enough to matter."""
    model = HashGridField(settings, seed, reference).double()
    model.table.mul_(2e4)
    if settings.background_model:
        model.background_table.normal_(generator=torch.Generator().manual_seed(5))
    return model


def rays(count: int = 6) -> Rays:
    generator = torch.Generator().manual_seed(2)
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins = 1.7 * origins / origins.norm(dim=-1, keepdim=True)
    towards = 0.5 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - origins
    ends = torch.full((2, count), 0.3, dtype=torch.float64)
    ends[1] = 4.0
    return Rays(origins, towards / towards.norm(dim=-1, keepdim=True), *ends)


def dense_field(settings: HashGridSettings) -> HashGridField:
    model = field(settings)
    model.density_out[0] = model.density_out[0].abs() * 4
    return model
