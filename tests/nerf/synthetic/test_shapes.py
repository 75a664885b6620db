import math

import pytest
import torch

from nerf.synthetic.shapes import Box, Frustum, Sphere, Torus

SHAPES = {
    "sphere": (Sphere(0.7), 4 / 3 * math.pi * 0.7**3),
    "box": (Box((0.3, 0.5, 0.2)), 8 * 0.3 * 0.5 * 0.2),
    "cylinder": (Frustum(0.6, 0.6, 0.1), math.pi * 0.6**2 * 0.2),
    "cone": (Frustum(0.5, 0.0, 0.4), math.pi / 3 * 0.5**2 * 0.8),
    "pot": (Frustum(0.3, 0.5, 0.4), math.pi / 3 * 0.8 * (0.3**2 + 0.3 * 0.5 + 0.5**2)),
    "torus": (Torus(0.5, 0.2), 2 * math.pi**2 * 0.5 * 0.2**2),
}
PRECISION = 1e-6  # of the torus; the others are closed forms
EVERY_SHAPE = pytest.mark.parametrize("name", SHAPES)


def uniform(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def surface(name: str, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    shape = SHAPES[name][0]
    points = shape.sample(uniform(count))
    return points, shape.normal(points)


def rays_at(name: str, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from all around, towards points in and about the shape."""
    origins = 3 * torch.nn.functional.normalize(uniform(count, 1) - 0.5, dim=-1)
    targets = 1.4 * (uniform(count, 2) - 0.5)
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


@EVERY_SHAPE
def test_a_hit_lies_on_the_surface_and_is_an_entry(name: str):
    shape = SHAPES[name][0]
    origins, directions = rays_at(name, 2000)
    t = shape.intersect(origins, directions)
    hit = t.isfinite()
    assert 100 < hit.sum() < 1900
    points = origins[hit] + t[hit][:, None] * directions[hit]
    assert shape.distance(points).abs().max() < PRECISION
    assert ((shape.normal(points) * directions[hit]).sum(-1) < 0).all()
    assert points.norm(dim=-1).max() <= shape.reach + PRECISION


@EVERY_SHAPE
def test_the_first_entry_is_where_marching_first_gets_inside(name: str):
    shape, step = SHAPES[name][0], 1e-3
    origins, directions = rays_at(name, 300)
    marched = torch.arange(1.5, 4.5, step, dtype=torch.float64)
    inside = shape.distance(origins[:, None] + marched[:, None] * directions[:, None]) < 0
    first = torch.where(inside.any(1), marched[inside.int().argmax(1)], torch.inf)
    found = shape.intersect(origins, directions)
    both = first.isfinite()
    assert (found[both] <= first[both] + PRECISION).all()
    assert (found[both] >= first[both] - step - PRECISION).all()
    # Marching can step over a chord shorter than its step, and over nothing else.
    slipped = found.isfinite() & ~both
    middle = origins + (found + step)[:, None] * directions
    assert (shape.distance(middle[slipped]) > -step).all()
    assert slipped.sum() < 10


@EVERY_SHAPE
def test_rays_that_leave_a_surface_do_not_hit_it(name: str):
    points, normals = surface(name, 2000)
    aside = torch.nn.functional.normalize(uniform(2000, 3) - 0.5, dim=-1)
    outward = torch.nn.functional.normalize(normals + 0.9 * aside, dim=-1)
    t = SHAPES[name][0].intersect(points.float(), outward.float())
    assert (t > 0.01).all()
    if name != "torus":
        assert t.isinf().all(), "a convex shape is never met again"
    else:
        assert 0 < t.isfinite().sum() < 1000, "from inside the hole the other side of the ring is seen"


@EVERY_SHAPE
def test_rays_along_an_axis_are_ordinary_rays(name: str):
    shape = SHAPES[name][0]
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    origins = -3 * axes + torch.tensor([0.04, 0.03, 0.02], dtype=torch.float64)
    origins[[2, 5], 0] += 0.45 if name == "torus" else 0.0  # not through the hole
    t = shape.intersect(origins, axes)
    assert t.isfinite().all()
    assert shape.distance(origins + t[:, None] * axes).abs().max() < PRECISION


@EVERY_SHAPE
def test_the_normal_is_the_gradient_of_the_distance(name: str):
    points, normals = surface(name, 500)
    offset = (points + 0.01 * normals).requires_grad_()
    distance = SHAPES[name][0].distance(offset)
    torch.testing.assert_close(distance.detach(), torch.full((500,), 0.01).double(), rtol=0, atol=1e-9)
    (gradient,) = torch.autograd.grad(distance.sum(), offset)
    torch.testing.assert_close(gradient, normals, rtol=0, atol=1e-6)


@EVERY_SHAPE
def test_distance_is_that_to_the_nearest_surface_point(name: str):
    shape, points = SHAPES[name][0], surface(name, 20_000)[0]
    anywhere = 1.6 * (uniform(300, 4) - 0.5)
    distance = shape.distance(anywhere)
    nearest = torch.cdist(anywhere, points).amin(1)
    assert (distance.abs() <= nearest + 1e-9).all()
    assert (distance.abs() >= nearest - 0.05).all()
    assert 0 < (distance < 0).sum() < 300


@EVERY_SHAPE
def test_samples_are_uniform_by_area(name: str):
    """Divergence theorem: the normals cancel, and a third of the mean of x · n times the area is the volume."""
    shape, volume = SHAPES[name]
    points, normals = surface(name, 100_000)
    assert shape.distance(points).abs().max() < 1e-9
    assert normals.mean(0).norm() < 0.01
    assert abs(shape.area * (points * normals).sum(-1).mean() / 3 / volume - 1) < 0.02
