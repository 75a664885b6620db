import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf.geometry.rays import Rays, points_on
from nerf.geometry.space_maps import Box, SpaceMap, space_map
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import MAX_ANGLE_DEG, Ndc, enclosing_ndc
from tests.camera_layouts import FIELD_OF_VIEW_TAN, ring, room, wall

APEX = (0.3, -2.0, 0.1)
TURNED = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
NDC = Ndc(APEX, TURNED, (0.7, 0.5), 0.8)
STRAIGHT = Ndc((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.6, 0.45), 1.0)
MAPS = pytest.mark.parametrize("space", [Box(), Contraction(), NDC], ids=lambda space: space.kind)


def scene_point(x: float, y: float, depth: float) -> Tensor:
    """A point of NDC's own frame, from its apex, in the scene."""
    return (
        torch.tensor([x, y, depth], dtype=torch.float64) @ torch.tensor(TURNED).double() + torch.tensor(APEX).double()
    )


def inside(space: SpaceMap, count: int = 200) -> Tensor:
    """Scene points whose images fill the cube evenly."""
    random = torch.Generator().manual_seed(0)
    return space.inverse(0.999 * space.half * (2 * torch.rand(count, 3, dtype=torch.float64, generator=random) - 1))


def some_rays(count: int = 1000) -> Rays:
    """From all about the apex, to all sides; the last ones parallel to the image plane."""
    random = torch.Generator().manual_seed(1)
    origins = torch.tensor(APEX) + 2 * torch.randn(count, 3, dtype=torch.float64, generator=random)
    directions = torch.randn(count, 3, dtype=torch.float64, generator=random)
    forward = torch.tensor(TURNED[2], dtype=torch.float64)
    directions[-100:] -= (directions[-100:] @ forward)[:, None] * forward
    directions /= directions.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, *torch.tensor([[0.1], [50.0]], dtype=torch.float64).expand(2, count))


@MAPS
def test_the_inverse_undoes_the_map(space: SpaceMap) -> None:
    points = inside(space)
    assert (space.forward(points).abs() < space.half).all()
    torch.testing.assert_close(space.inverse(space.forward(points)), points, rtol=1e-9, atol=1e-9)


@MAPS
def test_gradients_of_the_map_and_its_inverse(space: SpaceMap) -> None:
    points = inside(space, 20).requires_grad_()
    assert torch.autograd.gradcheck(space.forward, points)
    assert torch.autograd.gradcheck(space.inverse, space.forward(points).detach().requires_grad_())


def test_gradients_are_pulled_back_by_the_transposed_jacobian() -> None:
    behind = scene_point(0.2, 0.1, -1.0)
    points = torch.cat([inside(NDC), behind[None]]).requires_grad_()
    grad = torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (wanted,) = torch.autograd.grad((NDC.forward(points) * grad).sum(), points)
    torch.testing.assert_close(NDC.pull_back(points.detach(), grad), wanted, rtol=1e-9, atol=1e-9)


def test_points_and_rays_go_where_the_paper_puts_them() -> None:
    """Mildenhall et al. 2020, eq. 25 and 26, whose z points backward, for a camera at the apex."""
    scale = torch.tensor([0.9 / 0.6, 0.9 / 0.45, 0.9], dtype=torch.float64)
    origin, direction = torch.tensor([[0.2, -0.1, 1.0], [0.3, 0.2, 1.0]], dtype=torch.float64)
    x, y, z = origin * torch.tensor([1, 1, -1])
    dx, dy, dz = direction * torch.tensor([1, 1, -1])
    published_origin = torch.stack([-x / z, -y / z, 1 + 2 / z]) * scale
    published_direction = torch.stack([-(dx / dz - x / z), -(dy / dz - y / z), -2 / z]) * scale
    torch.testing.assert_close(STRAIGHT.forward(origin), published_origin)

    unit = direction / direction.norm()
    mapped = STRAIGHT.map_rays(Rays(origin[None], unit[None], torch.zeros(1).double(), torch.tensor([7.0]).double()))
    torch.testing.assert_close(mapped.rays.origins[0], published_origin)
    torch.testing.assert_close(mapped.rays.directions[0], published_direction / published_direction.norm())
    end = published_origin + (1 - z / (z + 7 * unit[2] * -1)) * published_direction
    torch.testing.assert_close(points_on(mapped.rays, mapped.rays.far[:, None])[0, 0], end)


@MAPS
def test_rays_are_lines_of_the_space_they_are_marched_in(space: SpaceMap) -> None:
    rays = some_rays()
    mapped = space.map_rays(rays)
    t = torch.lerp(mapped.rays.near[:, None], mapped.rays.far[:, None], torch.linspace(0, 1, 9, dtype=torch.float64))
    kept = mapped.rays.near < mapped.rays.far
    assert kept.sum() > 300 and kept[-100:].any()
    distance = mapped.to_scene(t)
    line = points_on(mapped.rays, t)
    on_line = space.forward(points_on(rays, distance)) if isinstance(space, Ndc) else points_on(rays, distance)
    torch.testing.assert_close(line[kept], on_line[kept], rtol=1e-9, atol=1e-9)
    assert (distance[kept].diff(dim=-1) > 0).all() and (distance[kept] >= 0.1 - 1e-12).all()
    assert (distance[kept] <= 50 * (1 + 1e-9)).all()
    torch.testing.assert_close(mapped.from_scene(distance[:, 4])[kept], t[:, 4][kept], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(mapped.rays.directions.norm(dim=-1), torch.ones(1000, dtype=torch.float64))


def test_packed_distances_are_those_of_their_rays() -> None:
    mapped = NDC.map_rays(some_rays())
    ray = torch.tensor([3, 3, 500, 999], dtype=torch.int32)
    t = 0.5 * mapped.rays.far
    torch.testing.assert_close(mapped.to_scene(t[ray], ray), mapped.to_scene(t[:, None])[ray, 0])


def test_rays_start_at_the_near_plane() -> None:
    """From before the near plane, from behind the apex, and where it looks back: nothing, or up to the plane."""
    forward = torch.tensor(TURNED[2], dtype=torch.float64)
    origins = torch.stack([scene_point(0, 0, depth) for depth in (0.4, -3.0, 2.0, 0.4, 2.0)])
    directions = torch.stack([forward, forward, forward, -forward, -forward])
    ends = torch.tensor([[0.1], [9.0]], dtype=torch.float64).expand(2, 5)
    mapped = NDC.map_rays(Rays(origins, directions, *ends))
    start = mapped.to_scene(torch.zeros(5, 1, dtype=torch.float64))[:, 0]
    torch.testing.assert_close(start[[0, 1, 2, 4]], torch.tensor([0.4, 3.8, 0.1, 0.1], dtype=torch.float64))
    torch.testing.assert_close(
        mapped.to_scene(mapped.rays.far[:, None])[[0, 1, 2, 4], 0], torch.tensor([9.0, 9.0, 9.0, 1.2]).double()
    )
    assert mapped.rays.far[3] == 0, "it never comes before the near plane"


def test_planes_at_infinity_are_the_far_face() -> None:
    far = torch.stack([scene_point(0.3 * depth, -0.2 * depth, depth) for depth in (1e3, 1e8, 1e30)])
    mapped = NDC.forward(far)
    assert (mapped[:, 2] <= 0.9).all() and mapped[0, 2] > 0.898
    torch.testing.assert_close(mapped[1:, 2], torch.full((2,), 0.9, dtype=torch.float64))
    torch.testing.assert_close(mapped[:, :2], torch.tensor([0.3 / 0.7, -0.2 / 0.5]).double().expand(3, 2) * 0.9)


def test_points_behind_the_camera_plane_are_outside_of_the_cube() -> None:
    behind = torch.stack([scene_point(0.1, 0.1, depth) for depth in (0.79, 1e-9, 0.0, -1e-9, -1.0, -1e30)])
    mapped = NDC.forward(behind)
    assert mapped.isfinite().all() and (mapped.abs().amax(-1) > 0.9).all()


def test_lengths_in_the_scene_are_the_slope_of_distances() -> None:
    mapped = NDC.map_rays(some_rays())
    ray = (mapped.rays.far > 0).nonzero()[:, 0]
    t = 0.7 * mapped.rays.far[ray]
    _, slope = torch.autograd.functional.jvp(lambda t: mapped.to_scene(t, ray), t, torch.ones_like(t))
    torch.testing.assert_close(mapped.scene_length(t, ray), slope)
    torch.testing.assert_close(mapped.to_scene(t, ray), mapped.to_scene(mapped.rays.far[:, None] * 0.7)[ray, 0])


def test_lengths_at_points_are_those_along_lines_of_sight() -> None:
    points = inside(NDC, 50)
    towards = points - torch.tensor(APEX).double()
    towards /= towards.norm(dim=-1, keepdim=True)
    _, moved = torch.autograd.functional.jvp(NDC.forward, points, towards)
    assert isinstance(moved, Tensor)
    torch.testing.assert_close(NDC.scene_length(NDC.forward(points)), 1 / moved.norm(dim=-1))


COORDINATE = st.floats(-(2.0**60), 2.0**60, width=32)
POINT = st.lists(COORDINATE, min_size=3, max_size=3)


@given(POINT, POINT, st.floats(0, 2.0**20, width=32), st.floats(0, 2.0**20, width=32))
def test_value_and_gradient_are_finite_everywhere(
    point: list[float], towards: list[float], near: float, length: float
) -> None:
    x = torch.tensor(point, requires_grad=True)
    mapped = NDC.forward(x)
    mapped.sum().backward()
    assert mapped.isfinite().all() and x.grad is not None and x.grad.isfinite().all()
    assert NDC.pull_back(x.detach(), torch.ones(3)).isfinite().all()
    direction = torch.tensor(towards)
    if not 0 < direction.norm() < math.inf:
        return
    direction = torch.nn.functional.normalize(direction, dim=-1)
    ends = torch.tensor([near]), torch.tensor([near + length])
    rays = NDC.map_rays(Rays((x.detach() / 2**40)[None], direction[None], *ends))
    assert all(part.isfinite().all() for part in (*rays.rays, *(rays.line or ())))
    assert rays.to_scene(rays.rays.far[:, None]).isfinite().all()


def borders(count: int) -> list[np.ndarray]:
    side = np.linspace(-FIELD_OF_VIEW_TAN, FIELD_OF_VIEW_TAN, 9)
    rays = np.stack([*np.meshgrid(side, side), np.ones((9, 9))], axis=-1).reshape(-1, 3)
    return [rays / np.linalg.norm(rays, axis=1, keepdims=True)] * count


def turned(poses: np.ndarray) -> np.ndarray:
    """Each pose turned a few degrees, and moved forward or back: some cameras stand behind others."""
    random = np.random.default_rng(3)
    poses = poses.copy()
    for pose in poses:
        x, y = random.uniform(-0.15, 0.15, 2)
        turn = np.array([[math.cos(x), 0, math.sin(x)], [0, 1, 0], [-math.sin(x), 0, math.cos(x)]])
        pose[:, :3] = (
            pose[:, :3] @ turn @ np.array([[1, 0, 0], [0, math.cos(y), -math.sin(y)], [0, math.sin(y), math.cos(y)]])
        )
        pose[1, 3] += random.uniform(-0.5, 0.5)
    return poses


@pytest.mark.parametrize("poses", [wall(), turned(wall()), wall()[:1]], ids=["parallel", "turned", "one"])
def test_the_pyramid_holds_all_that_every_photo_sees(poses: np.ndarray) -> None:
    near = np.full(len(poses), 0.7)
    ndc = enclosing_ndc(poses, borders(len(poses)), near)
    assert ndc is not None
    reach = np.zeros(3)
    for pose, border in zip(poses, borders(len(poses)), strict=True):
        for distance in (0.7, 2.0, 1e5):
            mapped = ndc.forward(torch.from_numpy(pose[:, 3] + distance * border @ pose[:, :3].T))
            assert mapped.abs().max() <= 0.9 + 1e-9
            reach = np.maximum(reach, mapped.abs().amax(0).numpy())
    np.testing.assert_allclose(reach, 0.9, atol=1e-4)  # and no more than that


def test_parallel_cameras_have_a_pyramid_as_wide_as_their_photos() -> None:
    ndc = enclosing_ndc(wall(), borders(24), np.ones(24))
    assert ndc is not None
    np.testing.assert_allclose(ndc.slopes, FIELD_OF_VIEW_TAN)
    np.testing.assert_allclose(ndc.apex, [0.0, -4.0 - 0.75 / FIELD_OF_VIEW_TAN, 0.0], atol=1e-9)


@pytest.mark.parametrize("poses", [ring(), room(), ring(arc_deg=160)], ids=["ring", "room", "arc"])
def test_cameras_that_look_every_way_have_no_pyramid(poses: np.ndarray) -> None:
    assert enclosing_ndc(poses, borders(len(poses)), np.ones(len(poses))) is None
    assert MAX_ANGLE_DEG < 90


def test_photos_rolled_every_way_have_a_pyramid() -> None:
    poses = wall()[:4].copy()
    for turns, pose in enumerate(poses):
        pose[:, :3] = pose[:, :3] @ np.linalg.matrix_power(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), turns)
    assert enclosing_ndc(poses, borders(4), np.ones(4)) is not None


@MAPS
def test_a_map_is_known_by_its_parameters(space: SpaceMap) -> None:
    assert space_map(**dataclasses.asdict(space)) == space


@pytest.mark.parametrize(
    "changed",
    [
        {"slopes": (0.0, 1.0)},
        {"near": math.nan},
        {"near": -1.0},
        {"axes": ((1.0, 0.0, 0.0),) * 3},
        {"apex": (math.inf,) * 3},
    ],
    ids=["no width", "no number", "behind", "no frame", "nowhere"],
)
def test_impossible_pyramids_are_refused(changed: dict) -> None:
    with pytest.raises(ValueError, match="must be"):
        dataclasses.replace(NDC, **changed)


def test_an_unknown_map_is_refused() -> None:
    with pytest.raises(ValueError, match="must be one of"):
        space_map("sphere")
