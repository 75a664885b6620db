"""What a step of a hash-grid field takes of the photos: pixels, each once, and effects, which change no bit where
they are off and are refused where they run away."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from nerf.effects import ImageEffects
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import Rendering
from nerf.kernels import torch as reference
from nerf.training.colour_loss import huber_loss
from nerf.training.hash_grid_trainer import HashGridTrainer, MicroBatch
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import RAY_GEOMETRY, NonFinite
from tests.nerf.training.test_hash_grid_trainer import FIELD, TRAINER, copied, same, small_dataset, trainer


def part_without_effects(run: HashGridTrainer, step: int, progress: float, rays: int, chunk: int) -> MicroBatch:
    """What a chunk adds to loss and gradients, written as if there were no effects."""
    batch = run.draw_batch(step, progress, chunk, rays)
    done = run.model.forward(batch.rays, batch.jitter, batch.thinning_offset, batch.background)
    error = done.rendering.colour - batch.target
    huber, half_gradient = huber_loss(error)
    none = torch.zeros(rays)
    grad = Rendering(half_gradient * (2 / (3 * rays)), none, none)
    gradients = run.model.backward(done, grad, torch.zeros_like(done.weights))
    norm = torch.nn.utils.get_total_norm([*gradients.weights, gradients.features])
    losses = huber.sum() / (3 * rays), error.square().sum() / (3 * rays)
    learnt = gradients.weights, gradients.features, done.points, dict[str, Tensor](), dict[str, Tensor]()
    counts = done.samples.starts[-1], done.density_evaluations
    return MicroBatch(batch, *losses, *learnt, norm, done.optical_thickness, *counts, done.capacities, done.fits)


def test_effects_that_are_off_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    off, without = trainer(), trainer()
    monkeypatch.setattr(without, "_compute_micro_batch", partial(part_without_effects, without))
    for step in range(30):
        assert off.step(step, step / 30) == without.step(step, step / 30)
    assert same(off.state(), without.state())
    assert not same(off.state(), trainer().state())


@pytest.mark.parametrize("runaway", [1e30, float("nan")])
def test_turns_that_run_away_are_refused_and_change_nothing(runaway: float) -> None:
    poses = PoseRefinement(torch.eye(3)[:2])
    run = HashGridTrainer(HashGridField(FIELD, 0, reference), small_dataset(), TRAINER, ImageEffects((poses,)))
    run.step(0, 0.0)
    poses.turn[:, 1] = runaway
    before = copied(run.state())
    with pytest.raises(NonFinite, match=f"the {RAY_GEOMETRY} of step 1 is not finite"):
        run.step(1, 0.1)
    for name, tensor in run.state().items():
        torch.testing.assert_close(tensor, before[name], rtol=0, atol=0, equal_nan=True)


def test_steps_draw_every_pixel_once_before_any_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the number of rays, of chunks, and of rays to sparse points, which end half-way."""
    dataset, drawn = (
        small_dataset(16).with_sparse_depths(torch.tensor([136, 392]), torch.tensor([3.0, 2.5])),
        list[Tensor](),
    )
    assert dataset.sparse_pixels is not None and dataset.unmasked_count == 512
    monkeypatch.setattr(RayDataset, "unmasked_pixels", lambda _, numbers: drawn.append(numbers) or numbers)
    settings = replace(TRAINER, micro_batches=3, depth_weight=0.1)
    run, rays = HashGridTrainer(HashGridField(FIELD, 0, reference), dataset, settings), set[int]()
    for step in range(40):
        rays.add(run.step(step, min(1.0, step / 20)).rays)
    often = torch.cat(drawn).bincount(minlength=512)
    assert len(rays) > 5 and often.sum() == run.pixels_sampled > 1024
    assert often.max() - often.min() <= 1


BEFORE_GREY = replace(TRAINER, background=(128 / 255, 128 / 255, 128 / 255))


def before_grey() -> tuple[RayDataset, Tensor]:
    """A red disc before grey, from both sides, without alpha; and which pixels are grey."""
    dataset = small_dataset()
    plain = dataset.pixels[:, 3] == 0
    pixels = torch.where(plain[:, None], torch.full((3,), 128, dtype=torch.uint8), dataset.pixels[:, :3])
    return dataset._replace(pixels=pixels), plain


def before_backdrop(tolerance: float) -> HashGridTrainer:
    settings = replace(BEFORE_GREY, backdrop_tolerance=tolerance)
    return HashGridTrainer(HashGridField(FIELD, 0, reference), before_grey()[0], settings)


def test_opacity_costs_the_squared_tolerance_before_a_backdrop() -> None:
    free, costly = before_backdrop(0.0), before_backdrop(0.1)
    batch = free.draw_batch(0, 0.0, 0, 64)
    done = free.model.forward(batch.rays, batch.jitter, batch.thinning_offset, batch.background)
    losses = [run._loss(64, run.loss_weights(64, 0.0), done, batch) for run in (free, costly)]
    plain = (batch.target == batch.background).all(1)
    assert 0 < plain.float().mean() < 1 and done.rendering.opacity[plain].sum() > 0
    torch.testing.assert_close(losses[1].grad.opacity - losses[0].grad.opacity, 0.1**2 / 64 * plain)
    expected = float(0.1**2 / 64 * done.rendering.opacity[plain].sum())
    assert float(losses[1].value - losses[0].value) == pytest.approx(expected, rel=1e-3)
    assert losses[0].squared_error == losses[1].squared_error, "what it costs is no error of colours"


def test_grey_lumps_before_grey_fade_and_the_object_stays() -> None:
    photos, plain = before_grey()
    rays, colour = photos.lookup(torch.arange(len(plain)))[:2]
    opacity = []
    for tolerance in (0.0, 8 / 255):
        run = before_backdrop(tolerance)
        for step in range(200):
            run.step(step, step / 200)
        seen = run.model.render(rays, run.fixed_background)
        opacity.append((float(seen.opacity[plain].mean()), float(seen.opacity[~plain].mean())))
        assert (seen.colour - colour).square().mean() < 1e-4
    assert opacity[1][0] < 0.1 * opacity[0][0] and opacity[1][1] > 0.8
