import pytest
import torch
from torch import Tensor

from nerf.effects import RayGradients
from nerf.effects.pose_refinement import LEARNING_RATE, PoseRefinement
from nerf.geometry.rays import Rays
from nerf.kernels import torch as reference


def rays(count: int = 6) -> Rays:
    random = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    return Rays(torch.randn(count, 3, generator=random), directions, torch.ones(count), torch.full((count,), 5.0))


VIEW = torch.tensor([0, 2, 2, 1, 0, 2])


def test_things_a_unit_away_or_farther_have_the_unit_one() -> None:
    """And then an offset is a shift, to the bit."""
    poses, farther = PoseRefinement(ring()), PoseRefinement(ring(), torch.full((8,), 3.0))
    poses.offset += torch.randn(8, 3, generator=torch.Generator().manual_seed(4))
    assert torch.equal(poses.shift, poses.offset) and torch.equal(poses.unit, farther.unit)
    assert torch.equal(poses.gauge, farther.gauge)


def test_a_correction_of_nothing_changes_no_bit() -> None:
    same = PoseRefinement(torch.zeros(3, 3)).forward(rays(), VIEW)
    assert all(torch.equal(a, b) for a, b in zip(same, rays(), strict=True))


def test_rays_turn_and_shift_with_their_own_camera() -> None:
    poses = PoseRefinement(torch.zeros(3, 3))
    poses.turn[2], poses.offset[1] = torch.tensor([0, 0, torch.pi / 2]), torch.tensor([1.0, 2, 3])
    moved, before = poses.forward(rays(), VIEW), rays()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(moved.directions[VIEW == 2], before.directions[VIEW == 2] @ quarter.T)
    torch.testing.assert_close(moved.origins[VIEW == 1] - before.origins[VIEW == 1], torch.tensor([[1.0, 2, 3]]))
    assert torch.equal(moved.directions[VIEW == 0], before.directions[VIEW == 0])
    torch.testing.assert_close(moved.directions.norm(dim=-1), torch.ones(6))


def test_moved_poses_have_the_rays_that_it_makes() -> None:
    random = torch.Generator().manual_seed(5)
    poses = PoseRefinement(torch.zeros(3, 3), torch.full((3,), 0.5))
    poses.turn += 0.3 * torch.randn(3, 3, generator=random)
    poses.offset += 0.3 * torch.randn(3, 3, generator=random)
    rotations, _ = torch.linalg.qr(torch.randn(3, 3, 3, generator=random))
    centres, local = torch.randn(3, 3, generator=random), rays(3).directions
    at = torch.arange(3)
    given = rays(3)._replace(origins=centres, directions=(rotations @ local[:, :, None])[:, :, 0])
    moved = poses.forward(given, at)
    pose = PoseRefinement.moved_poses(torch.cat([rotations, centres[:, :, None]], dim=2), poses.rows)
    torch.testing.assert_close(pose[:, :, 3], moved.origins)
    torch.testing.assert_close((pose[:, :, :3] @ local[:, :, None])[:, :, 0], moved.directions)


def test_backward_is_the_derivative_of_forward() -> None:
    poses, given = PoseRefinement(torch.zeros(3, 3)), rays()
    random = torch.Generator().manual_seed(2)
    for part in poses.parameters.values():
        part += 0.3 * torch.randn(3, 3, generator=random)
    weights = [torch.randn(6, 3, generator=random) for _ in range(2)]
    by_hand = poses.backward(given, VIEW, RayGradients(weights[0], weights[1]))
    leaves = [part.requires_grad_() for part in poses.parameters.values()]
    moved = poses.forward(given, VIEW)
    expected = torch.autograd.grad((moved.origins * weights[0]).sum() + (moved.directions * weights[1]).sum(), leaves)
    torch.testing.assert_close(list(by_hand.values()), list(expected), rtol=1e-5, atol=1e-6)
    assert list(by_hand) == list(poses.parameters)


@pytest.mark.parametrize("radians", [0.0, 1e-4, 1.0, 3.1])
def test_its_derivatives_are_those_of_differences_at_every_size(radians: float) -> None:
    random = torch.Generator().manual_seed(3)
    axes = torch.nn.functional.normalize(torch.randn(3, 3, generator=random, dtype=torch.float64), dim=-1)
    poses, given = PoseRefinement(torch.zeros(3, 3).double()), rays().each(Tensor.double)

    def moved(turn: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        poses.turn, poses.offset = turn, shift
        there = poses.forward(given, VIEW)
        return there.origins, there.directions

    parts = [(radians * axes).requires_grad_(), (radians * axes.flip(0)).requires_grad_()]
    assert torch.autograd.gradcheck(moved, parts)
    weights = torch.randn(2, 6, 3, generator=random, dtype=torch.float64)
    expected = torch.autograd.grad(moved(parts[0], parts[1]), parts, list(weights))
    by_hand = poses.backward(given, VIEW, RayGradients(weights[0], weights[1]))
    torch.testing.assert_close(list(by_hand.values()), list(expected), rtol=1e-12, atol=1e-12)


def ring(count: int = 8) -> torch.Tensor:
    angle = torch.arange(count) * 2 * torch.pi / count
    return torch.stack([3 * angle.cos() + 1, 3 * angle.sin(), 0.2 * (5 * angle).sin()], -1)


@pytest.mark.parametrize("distance", [None, torch.tensor([0.1, 0.3, 5.0, 0.2, 0.7, 1.0, 0.4, 0.1])])
def test_what_all_cameras_share_is_taken_out(distance: Tensor | None) -> None:
    poses, centres = PoseRefinement(ring(), distance), ring()
    turn, shift = torch.tensor([0.01, -0.02, 0.03]), torch.tensor([0.1, 0.2, -0.3])
    poses.turn += turn
    poses.offset += (shift + torch.linalg.cross(turn.expand_as(centres), centres) + 0.05 * centres) / poses.unit
    poses.fix_gauge()
    assert poses.turn.abs().max() < 1e-6 and poses.offset.abs().max() < 2e-6


def test_what_is_a_cameras_own_stays() -> None:
    poses = PoseRefinement(ring())
    poses.turn[3] = torch.tensor([0.0, 0.02, 0])
    poses.fix_gauge()
    once = poses.turn.clone()
    poses.fix_gauge()
    torch.testing.assert_close(poses.turn, once)  # a projection
    assert poses.turn[3, 1] > 0.01 and poses.turn[[0, 1, 2, 4, 5, 6, 7]].abs().max() < 0.01


def refined(scale: float) -> tuple[PoseRefinement, float]:
    """Poses that were jittered, after some steps towards noisy pictures of known points half a unit away, in a scene
    made so many times larger; and how far off (radians) points then appear at most in the mean of a view."""
    random = torch.Generator().manual_seed(5)
    points = 0.25 * torch.randn(60, 3, generator=random)
    view = torch.arange(8).repeat_interleave(60)
    towards = points.repeat(8, 1) - ring()[view] / 5
    distance, directions = towards.norm(dim=-1), torch.nn.functional.normalize(towards, dim=-1)
    median = distance.view(8, 60).median(1).values
    wrong = PoseRefinement(ring() / 5, median)
    wrong.turn += 0.02 * torch.randn(8, 3, generator=random)
    wrong.offset += 0.02 * torch.randn(8, 3, generator=random)
    wrong.fix_gauge()
    origins = ring()[view] / 5
    given = wrong.forward(Rays(origins, directions, torch.ones(480), torch.ones(480)), view)
    given = given._replace(origins=scale * given.origins)
    poses = PoseRefinement(scale * ring() / 5, scale * median)
    moments = [{name: torch.zeros(8, 3) for name in poses.parameters} for _ in range(2)]

    def off(moved: Rays, noise: Tensor) -> Tensor:
        seen = torch.nn.functional.normalize(scale * points.repeat(8, 1) - moved.origins, dim=-1)
        return seen - moved.directions + noise

    for step in range(150):
        noise = 5e-3 * torch.randn(480, 3, generator=random)
        moved = poses.forward(given, view).each(lambda part: part.detach().requires_grad_())
        grad_origins, grad_directions = torch.autograd.grad(off(moved, noise).square().mean(), moved[:2])
        gradients = poses.backward(given, view, RayGradients(grad_origins, grad_directions))
        for name, gradient in gradients.items():
            mean, square = moments[0][name], moments[1][name]
            reference.adam(poses.parameters[name], gradient, mean, square, LEARNING_RATE, step + 1)
        poses.fix_gauge()
    left = off(poses.forward(given, view), torch.zeros(480, 3)).view(8, 60, 3).mean(1).norm(dim=-1)
    return poses, float(left.max())


def test_poses_are_refined_alike_at_any_scene_size() -> None:
    (large, off), (small, off_in_small) = refined(1.0), refined(1 / 20)
    assert 1e-5 < off < 2e-3, "by less than a photo's noise"
    assert off_in_small == pytest.approx(off, rel=0.02)
    torch.testing.assert_close(small.turn, large.turn, rtol=1e-2, atol=1e-5)
    torch.testing.assert_close(20 * small.shift, large.shift, rtol=1e-2, atol=1e-5)


def test_cameras_in_one_place_have_a_gauge_too() -> None:
    poses = PoseRefinement(torch.zeros(2, 3))
    poses.turn += torch.tensor([[1.0, 0, 0], [3, 0, 3]])
    poses.fix_gauge()
    torch.testing.assert_close(poses.turn, torch.tensor([[-1.0, 0, -1.5], [1, 0, 1.5]]))
