import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf.effects import ImageEffects
from nerf.effects.exposure import ExposureModel
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays
from nerf.training.evaluation_pixels import evaluate, sample_evaluation_pixels
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from nerf.training.trainer import NonFinite, composite_over
from nerf.training.vanilla_trainer import VanillaTrainer, VanillaTrainerSettings
from tests.nerf.training.test_hash_grid_trainer import copied, same

FIELD = VanillaSettings(
    depth=2, width=16, skip=9, position_frequencies=3, direction_frequencies=1, samples_coarse=8, samples_fine=8
)
TRAINER = VanillaTrainerSettings(
    batch_rays=64, seed=3, background=(1.0, 1.0, 1.0), initial_learning_rate=5e-3, final_learning_rate=5e-4
)


def small_dataset(channels: int = 3, size: int = 12) -> RayDataset:
    """Two opposite views of a red disc on white (or on nothing, with alpha), from 3 units away."""
    grid = (torch.arange(size) + 0.5) / size - 0.5
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    ray_directions = torch.stack([x, y, torch.ones_like(x)], -1)
    ray_directions = ray_directions / ray_directions.norm(dim=-1, keepdim=True)
    inside = (x**2 + y**2 < 0.06)[..., None]
    photo = torch.where(inside, torch.tensor([200, 20, 20]), 255)
    if channels == 4:
        photo = torch.cat([photo, torch.where(inside, 255, 0)], -1)
    front = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3]])
    back = torch.tensor([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 3]])
    near, far = torch.full((2,), 2.0), torch.full((2,), 4.0)
    return ray_dataset_from_images(
        [photo.to(torch.uint8)] * 2, [0, 0], [ray_directions], torch.stack([front, back]), near, far
    )


def trainer(settings: VanillaTrainerSettings = TRAINER, dataset: RayDataset | None = None) -> VanillaTrainer:
    return VanillaTrainer(VanillaNerf(FIELD, seed=0), dataset or small_dataset(), settings)


def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit() -> None:
    whole, first = trainer(), trainer()
    results = [whole.step(step, step / 20) for step in range(20)]
    for step in range(10):
        first.step(step, step / 20)
    second = trainer()
    second.load_state(copied(first.state()))
    assert [second.step(step, step / 20) for step in range(10, 20)] == results[10:]
    assert same(whole.state(), second.state())


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    settings, states = replace(TRAINER, batch_rays=700), []  # three parts, the last one smaller
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            run = trainer(settings)
            for step in range(6):
                run.step(step, step / 6)
            states.append(copied(run.state()))
    finally:
        torch.set_num_threads(before)
    assert same(states[0], states[1])
    assert same(states[0], states[2])


def test_training_beats_a_flat_colour() -> None:
    dataset = small_dataset()
    run = trainer(dataset=dataset)
    probe = sample_evaluation_pixels(dataset, 288, torch.ones(3), seed=5)
    assert evaluate(run.model, probe).psnr < probe.mean_colour_psnr + 2
    for step in range(150):
        run.step(step, step / 150)
    assert probe.mean_colour_psnr + 3 < evaluate(run.model, probe).psnr < 60


def test_the_loss_sums_both_renderings_errors() -> None:
    run = trainer()
    nothing = replace(FIELD, hierarchical=False)
    alone = VanillaTrainer(VanillaNerf(nothing, seed=0), small_dataset(), TRAINER).step(0, 0.0)
    both = run.step(0, 0.0)
    assert alone.loss == pytest.approx(10 ** (-alone.psnr / 10), rel=1e-5)
    assert both.loss > 1.2 * 10 ** (-both.psnr / 10)
    assert both.rays == TRAINER.batch_rays
    assert both.colour_evaluations == both.density_evaluations == both.rays * FIELD.queries_per_ray


@pytest.mark.parametrize(("broken", "quantity"), [("loss", "loss"), ("gradient", "gradient")])
def test_a_non_finite_step_changes_nothing_and_shows_its_batch(
    broken: str, quantity: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer()
    run.step(0, 0.0)
    if broken == "loss":
        run.model.fine.colour_head.bias.data[1] = math.nan
    else:
        run.model.fine.colour_head.bias.register_hook(lambda gradient: gradient * math.inf)
    before = copied(run.state())
    with pytest.raises(NonFinite, match=f"the {quantity} of step 1 is not finite") as caught:
        run.step(1, 0.5)
    assert all(torch.equal(a, b) or a.isnan().any() for a, b in zip(before.values(), run.state().values(), strict=True))
    assert caught.value.batch["target"].shape == (64, 3)
    assert set(caught.value.batch) == {*Rays._fields, "target", "view", "background"}


def test_the_rate_scale_scales_the_update() -> None:
    whole, half = trainer(), trainer()
    start = copied(whole.state())
    whole.step(0, 0.0, 1.0)
    half.step(0, 0.0, 0.5)
    del start["settings"]
    for name, weight in start.items():
        moved, moved_half = whole.state()[name] - weight, half.state()[name] - weight
        torch.testing.assert_close(moved_half, moved / 2, atol=1e-6, rtol=1e-3)


def test_a_random_background_is_new_each_step() -> None:
    run = trainer(replace(TRAINER, background="random"), small_dataset(channels=4))
    seen = []
    forward = run.model.render_training

    def spy(rays, background, generator):
        seen.append(background)
        return forward(rays, background, generator)

    run.model.render_training = spy
    run.step(0, 0.0)
    run.step(1, 0.0)
    assert not torch.equal(seen[0], seen[1])
    assert all(((b >= 0) & (b < 1)).all() for b in seen)


def test_steps_draw_every_pixel_once_before_any_again(monkeypatch: pytest.MonkeyPatch) -> None:
    run, drawn = trainer(dataset=small_dataset(size=16)), list[Tensor]()
    monkeypatch.setattr(RayDataset, "unmasked_pixels", lambda _, numbers: drawn.append(numbers) or numbers)
    for step in range(12):
        run.step(step, 0.0)
    often = torch.cat(drawn).bincount(minlength=512)
    assert often.sum() == 12 * TRAINER.batch_rays and often.max() - often.min() <= 1


def test_over_is_linear_between_background_and_colour() -> None:
    colour, background = torch.tensor([[0.2, 0.4, 0.6]]), torch.tensor([1.0, 0.0, 0.5])
    assert torch.equal(composite_over(colour, None, background), colour)
    torch.testing.assert_close(composite_over(colour, torch.zeros(1), background)[0], background)
    torch.testing.assert_close(composite_over(colour, torch.ones(1), background), colour)
    torch.testing.assert_close(
        composite_over(colour, torch.tensor([0.25]), background)[0], torch.tensor([0.8, 0.1, 0.525])
    )


def test_a_state_of_another_architecture_is_refused() -> None:
    other = VanillaTrainer(VanillaNerf(replace(FIELD, width=8), seed=0), small_dataset(), TRAINER)
    with pytest.raises(RuntimeError, match="this state belongs to another field: settings differ"):
        trainer().load_state(other.state())


def test_per_image_parameters_are_trained_and_resumed() -> None:
    def fresh() -> VanillaTrainer:
        exposures = ExposureModel(torch.tensor([[0.0, 0, 0], [0.5, 0.5, 0.5]]))
        effects = ImageEffects((PoseRefinement(torch.eye(3)[:2]),), (exposures,))
        return VanillaTrainer(VanillaNerf(FIELD, seed=0), small_dataset(), TRAINER, effects)

    whole, first, second = fresh(), fresh(), fresh()
    begun = {name: part.detach().clone() for name, part in whole.effects.parameters.items()}
    for step in range(12):
        whole.step(step, step / 12)
    for step in range(6):
        first.step(step, step / 12)
    second.load_state(copied(first.state()))
    for step in range(6, 12):
        second.step(step, step / 12)
    assert same(whole.state(), second.state())
    moved = {name: (part.detach() - begun[name]).abs().max() for name, part in whole.effects.parameters.items()}
    assert set(moved) == {"pose_refinement.turn", "pose_refinement.offset", "exposure.log_gain"}
    assert all(1e-4 < change < 0.2 for change in moved.values())


def test_white_matter_before_white_fades() -> None:
    photos, left = small_dataset(), []
    rays, colour = photos.lookup(torch.arange(288))[:2]
    for tolerance in (0.0, 0.3):
        run = trainer(replace(TRAINER, backdrop_tolerance=tolerance), photos)
        for step in range(300):
            run.step(step, step / 300)
        seen = run.model.render(rays, torch.ones(3))
        left.append(float(seen.opacity[colour.amin(1) == 1].mean()))
    assert left[1] < left[0] / 2
