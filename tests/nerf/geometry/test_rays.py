import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf.geometry.rays import Rays, clip_to_box, join_rays, points_on, rays_of_view
from tests.reference import paper_loop


def ray(origin: list[float], direction: list[float], near: float = 0, far: float = 10) -> Rays:
    unit = torch.nn.functional.normalize(torch.tensor([direction], dtype=torch.float64), dim=-1)
    o = torch.tensor([origin], dtype=torch.float64)
    return Rays(o, unit, o.new_tensor([near]), o.new_tensor([far]))


def interval(rays: Rays, half: float = 1.0) -> tuple[float, float]:
    cut = clip_to_box(rays, -half, half)
    return cut.near.item(), cut.far.item()


def test_a_ray_through_the_middle() -> None:
    assert interval(ray([-3, 0, 0], [1, 0, 0])) == (2, 4)
    assert interval(ray([3, 0, 0], [-1, 0, 0])) == (2, 4)
    assert interval(ray([-2, -2, -2], [1, 1, 1])) == pytest.approx((math.sqrt(3), 3 * math.sqrt(3)))


def test_near_and_far_stay_where_they_cut_deeper() -> None:
    assert interval(ray([-3, 0, 0], [1, 0, 0], 2.5, 3.5)) == (2.5, 3.5)
    assert interval(ray([0, 0, 0], [0, 0, 1], 0.25, 10)) == (0.25, 1)


@pytest.mark.parametrize(
    "missing",
    [
        ray([-3, 2, 0], [1, 0, 0]),  # passes beside it, parallel to an axis
        ray([-3, 0, 0], [-1, 0, 0]),  # looks away
        ray([-3, 0, 0], [1, 0, 0], 0, 1.5),  # ends before it
        ray([-3, 0, 0], [1, 0, 0], 4.5, 10),  # starts behind it
        ray([-3, 0, 0], [1, 1.2, 0]),
    ],
)
def test_a_miss_is_the_empty_interval_at_far(missing: Rays) -> None:
    assert interval(missing) == (missing.far.item(), missing.far.item())


@pytest.mark.parametrize("zero", [0.0, -0.0])
@pytest.mark.parametrize("face", [1.0, -1.0])
def test_a_ray_along_a_face_is_finite(zero: float, face: float) -> None:
    near, far = interval(ray([-3, face, 0], [1, zero, zero]))
    assert 0 <= near <= far <= 10


COORDINATE = st.one_of(st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-38, -1e-300]), st.floats(-4, 4))


@given(st.lists(COORDINATE, min_size=3, max_size=3), st.lists(COORDINATE, min_size=3, max_size=3))
def test_agrees_with_the_slow_loop_and_stays_inside(origin: list[float], direction: list[float]) -> None:
    if math.hypot(*direction) < 1e-2:
        direction = [1.0, *direction[1:]]
    # A ray that runs exactly within a face may count either way.
    faces = any(abs(o) == 1 and abs(d) < 1e-12 for o, d in zip(origin, direction, strict=True))
    rays = ray(origin, direction)
    cut = clip_to_box(rays, -1.0, 1.0)
    assert torch.isfinite(torch.stack([cut.near, cut.far])).all()
    assert 0 <= cut.near.item() <= cut.far.item() <= 10
    if cut.near < cut.far:
        assert points_on(cut, torch.stack([cut.near, cut.far], -1)).abs().max() <= 1 + 1e-9
    if not faces:
        expected = paper_loop.box_interval(rays.origins[0].numpy(), rays.directions[0].numpy(), 0, 10, 1)
        assert interval(rays) == pytest.approx(expected, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_the_interval_in_a_box_matches_dense_samples(numbers: list[float]) -> None:
    if math.hypot(*numbers[3:]) < 1e-2:
        return
    low, high = torch.tensor([-0.9, -0.5, -0.2]), torch.tensor([0.9, 0.8, 1.1])
    rays = ray(numbers[:3], numbers[3:])
    inside = clip_to_box(rays, low, high)
    t = torch.linspace(0, 10, 20001)
    point = points_on(rays, t[None])[0]
    within = ((point >= low) & (point <= high)).all(-1)
    assert float(inside.far - inside.near) == pytest.approx(float(within.sum()) * 10 / 20000, abs=2e-3)
    if within.sum() > 4:
        assert float(inside.near) == pytest.approx(float(t[within].min()), abs=2e-3)


def test_rays_are_joined_one_after_the_other() -> None:
    one, other = ray([1, 2, 3], [0, 0, -1]), ray([0, 0, 0], [1, 0, 0], 1, 2)
    joined = join_rays([one, other, other])
    assert joined.origins.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0]]
    assert joined.near.tolist() == [0, 1, 1] and joined.far.tolist() == [10, 2, 2]
    beside = join_rays((rays.each(lambda part: part[None]) for rays in (one, other)), dim=1)
    assert beside.directions.tolist() == [[[0, 0, -1], [1, 0, 0]]] and beside.far.tolist() == [[10, 2]]


def test_rays_start_at_the_view_and_turn_with_it() -> None:
    """A camera at (1, 2, 3) that looks along +x with +z up: x right is -y, y down is -z, z forward is +x."""
    pose = torch.tensor([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3]])
    rays = rays_of_view(torch.eye(3), pose, 0.5, 4.0)
    assert rays.origins.tolist() == [[1, 2, 3]] * 3
    assert rays.directions.tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert rays.near.tolist() == [0.5] * 3 and rays.far.tolist() == [4] * 3


def test_points_on_rays() -> None:
    rays = ray([1, 2, 3], [0, 0, -1])
    assert points_on(rays, torch.tensor([[0.0, 2.0]], dtype=torch.float64)).tolist() == [[[1, 2, 3], [1, 2, 1]]]
