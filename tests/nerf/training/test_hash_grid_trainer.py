import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf.effects import NO_EFFECTS, ImageEffects
from nerf.effects.exposure import ExposureModel, expose
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.background import background_colour
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.contraction import Contraction
from nerf.kernels import RayStepping
from nerf.kernels import torch as reference
from nerf.training.evaluation_pixels import evaluate, sample_evaluation_pixels
from nerf.training.hash_grid_trainer import (
    LONG_STEP_FACTOR,
    HashGridBatch,
    HashGridTrainer,
    HashGridTrainerSettings,
    depth_loss_multiplier,
)
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from nerf.training.trainer import FieldTrainer, NonFinite

FIELD = HashGridSettings(
    num_levels=2, log2_hashmap_size=10, base_res=4, max_res=16, diagonal_steps=32, occupancy_resolution=16
)
BACKGROUND = (0.2, 0.9, 0.5)
TRAINER = HashGridTrainerSettings(seed=3, background="random", target_samples=1024)


def small_dataset(size: int = 12) -> RayDataset:
    """Two opposite views of a red disc on nothing, from 3 units away."""
    grid = (torch.arange(size) + 0.5) / size - 0.5
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    ray_directions = torch.stack([x, y, torch.ones_like(x)], -1)
    ray_directions = ray_directions / ray_directions.norm(dim=-1, keepdim=True)
    inside = (x**2 + y**2 < 0.04)[..., None]
    photo = torch.cat([torch.where(inside, torch.tensor([200, 20, 20]), 255), torch.where(inside, 255, 0)], -1)
    front = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -3]])
    back = torch.tensor([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 3]])
    near, far = torch.full((2,), 1.0), torch.full((2,), 5.0)
    return ray_dataset_from_images(
        [photo.to(torch.uint8)] * 2, [0, 0], [ray_directions], torch.stack([front, back]), near, far
    )


def trainer(settings: HashGridTrainerSettings = TRAINER, field: HashGridSettings = FIELD) -> HashGridTrainer:
    return HashGridTrainer(HashGridField(field, 0, reference), small_dataset(), settings)


def copied(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in state.items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_it_trains_behind_the_common_interface() -> None:
    run: FieldTrainer = trainer()
    probe = sample_evaluation_pixels(small_dataset(), 288, torch.ones(3), seed=5)
    before = evaluate(run.model, probe).psnr
    for step in range(80):
        run.step(step, step / 80, 1.0)
    after = evaluate(run.model, probe).psnr
    assert before < probe.mean_colour_psnr < probe.mean_colour_psnr + 5 < after < 60


@pytest.mark.parametrize("long_steps_until", [0.0, 0.5, 0.6])
def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(long_steps_until: float) -> None:
    settings = replace(TRAINER, long_steps_until=long_steps_until)
    whole, first = trainer(settings), trainer(settings)
    results = [whole.step(step, step / 40) for step in range(40)]
    for step in range(20):
        first.step(step, step / 40)
    second = trainer(settings)
    second.load_state(copied(first.state()))
    assert [second.step(step, step / 40) for step in range(20, 40)] == results[20:]
    assert same(whole.state(), second.state())
    assert len({result.rays for result in results}) > 5, "the number of rays is meant to adapt"


def test_steps_along_rays_are_long_at_first() -> None:
    run = trainer(replace(TRAINER, long_steps_until=0.5))
    own = run.model.stepping
    short, long = (run.step(step, progress) for step, progress in enumerate((0.5, 0.49)))
    assert run.model.stepping == own.longer(LONG_STEP_FACTOR)
    assert long.density_evaluations / long.rays < 0.7 * short.density_evaluations / short.rays
    assert long.rays > 1.5 * short.rays, "as many colours, at once"
    run.step(2, 0.5)
    assert run.model.stepping == own


def test_longer_steps_grow_from_the_same_distance_on() -> None:
    stepping = RayStepping(0.01, 0.02, True, 32, 1024)
    assert stepping.longer(2) == RayStepping(0.02, 0.04, True, 32, 1024)
    assert stepping.longer(2).linear_until == stepping.linear_until


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    settings = replace(TRAINER, target_samples=3 << 12)
    threads, states = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            run = trainer(settings, replace(FIELD, num_levels=3, max_res=64, log2_hashmap_size=16))
            for step in range(20):  # the occupancy grid is refreshed once
                run.step(step, step / 20)
            states.append(copied(run.state()))
    finally:
        torch.set_num_threads(threads)
    assert same(states[0], states[1]) and same(states[0], states[2])


def test_a_batchs_gradient_is_the_sum_over_chunks() -> None:
    run = trainer(replace(TRAINER, target_samples=1 << 14, distortion_weight=0.1, depth_weight=0.2, micro_batches=4))
    run.dataset = run.dataset.with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5]))
    rays = run.rays_per_micro_batch()
    parts = [run._compute_micro_batch(0, 0.25, rays, chunk) for chunk in range(4)]
    batches = [part.batch for part in parts if part.batch is not None]
    assert len(batches) == 4 and sum(int((batch.known_depth > 0).sum()) for batch in batches) == 4 * rays // 8
    assert rays > 10 and not torch.equal(batches[0].target, batches[1].target)
    whole = HashGridBatch(
        Rays(*(torch.cat(part) for part in zip(*(batch.rays for batch in batches), strict=True))),
        *(torch.cat(part) for part in zip(*(batch[1:] for batch in batches), strict=True)),
    )
    done = run.model.forward(whole.rays, whole.jitter, whole.thinning_offset, whole.background)
    loss = run._loss(4 * rays, run.loss_weights(4 * rays, 0.25), done, whole)
    gradients = run.model.backward(done, loss.grad, loss.grad_weights)
    summed = [torch.stack(of_parts).sum(0) for of_parts in zip(*(part.grad_networks for part in parts), strict=True)]
    torch.testing.assert_close(summed, list(gradients.weights), rtol=1e-4, atol=1e-9)
    torch.testing.assert_close(
        torch.cat([part.grad_features for part in parts]), gradients.features, rtol=1e-4, atol=1e-9
    )
    torch.testing.assert_close(sum(part.loss for part in parts), loss.value)


def test_rays_adapt_to_the_samples_they_need() -> None:
    run = trainer()
    results = [run.step(step, 0.5) for step in range(100)]
    assert results[0].rays == 1024 // 128
    assert (
        results[0].rays
        < results[0].colour_evaluations
        <= results[0].density_evaluations
        <= results[0].rays * FIELD.stepping.max_samples
    )
    needed = results[-1].rays * float(run.samples_per_ray)
    assert 0.7 * 1024 < needed < 1.4 * 1024
    assert results[-1].rays > 5 * results[0].rays


def test_empty_space_is_closed_and_the_object_stays_open() -> None:
    run = trainer(field=replace(FIELD, diagonal_steps=200))
    for step in range(96):
        run.step(step, 0.5)
    words = torch.stack([(run.model.occupancy_bits >> bit) & 1 for bit in range(64)], -1)
    opened = words.sum() / FIELD.occupancy_resolution**3
    assert 0.02 < opened < 0.7
    rays, _, alpha, _ = run.dataset.lookup(torch.arange(len(run.dataset.pixels)))
    opacity = run.model.render(rays, torch.ones(3)).opacity
    assert opacity[alpha == 1].mean() > 0.7
    assert opacity[alpha == 0].mean() < 0.1


@pytest.mark.parametrize(("broken", "quantity"), [(math.nan, "loss"), (math.inf, "gradient")])
def test_a_non_finite_step_changes_nothing_and_shows_its_batch(
    broken: float, quantity: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer()
    run.step(0, 0.0)
    if quantity == "loss":
        run.model.colour_out[0, 0] = broken
    else:
        backward = run.model.backward
        monkeypatch.setattr(
            run.model,
            "backward",
            lambda *a: backward(*a)._replace(features=torch.full((1, FIELD.num_levels * 4), broken)),
        )
    before = copied(run.state())
    with pytest.raises(NonFinite, match=f"the {quantity} of step 1 is not finite") as caught:
        run.step(1, 0.5)
    for name, tensor in run.state().items():
        torch.testing.assert_close(tensor, before[name], rtol=0, atol=0, equal_nan=True)
    assert set(caught.value.batch) == {
        *Rays._fields,
        "target",
        "background",
        "jitter",
        "thinning_offset",
        "view",
        "known_depth",
    }


def test_the_rate_scale_scales_the_update() -> None:
    whole, half = trainer(), trainer()
    start = copied(whole.state())
    whole.step(0, 0.0, 1.0)
    half.step(0, 0.0, 0.5)
    for name in ("model.table", "model.colour_out"):
        moved, moved_half = whole.state()[name] - start[name], half.state()[name] - start[name]
        assert moved.any()
        torch.testing.assert_close(moved_half, moved / 2, atol=1e-7, rtol=1e-3)


def test_the_distortion_loss_is_added_and_has_its_gradient() -> None:
    plain, with_it = trainer(), trainer(replace(TRAINER, distortion_weight=1.0))
    one, other = plain.step(0, 1.0), with_it.step(0, 1.0)
    assert one.psnr == other.psnr
    assert one.loss < other.loss < one.loss + 5
    assert torch.equal(plain.exp_avg["colour_out"], with_it.exp_avg["colour_out"])
    assert not torch.equal(plain.exp_avg["density_out"], with_it.exp_avg["density_out"])


def test_the_distortion_loss_begins_weak() -> None:
    losses = [
        trainer(replace(TRAINER, distortion_weight=1.0)).step(0, share).loss for share in (0.0, 0.05, 0.15, 0.3, 1.0)
    ]
    bare = trainer().step(0, 0.0).loss
    added = [(loss - bare) / (losses[-1] - bare) for loss in losses]
    assert added == pytest.approx([0.25, 0.25, 0.5, 1, 1], rel=1e-4)


def test_unbounded_scenes_train_too() -> None:
    run = trainer(
        replace(TRAINER, background=(0.0, 0.0, 0.0), distortion_weight=1e-3),
        replace(FIELD, space=Contraction(), min_step_size=0.05, cone_angle=0.1),
    )
    results = [run.step(step, step / 60) for step in range(60)]
    first, last = (sum(r.psnr for r in part) / 10 for part in (results[:10], results[-10:]))
    assert first + 3 < last < 60


def test_a_state_of_another_architecture_is_refused() -> None:
    other = trainer(field=replace(FIELD, num_levels=1))
    with pytest.raises(RuntimeError, match=r"another field: exp_avg\.density_hidden, exp_avg\.table"):
        trainer().load_state(other.state())


def test_a_state_of_equal_shapes_but_other_settings_is_refused() -> None:
    other = trainer(field=replace(FIELD, diagonal_steps=33))
    with pytest.raises(RuntimeError, match="another field: settings differ"):
        trainer().load_state(other.state())


def test_unbounded_occupancy_has_finite_steps() -> None:
    model = HashGridField(replace(FIELD, space=Contraction()), 0, reference)
    cache = HashGridTrainer(model, small_dataset(), TRAINER).occupancy_grid
    cache.update(15, torch.Generator().manual_seed(1))
    assert cache.optical_thickness.isfinite().all()
    assert cache.optical_thickness.max() > 20 * cache.optical_thickness.min() > 0


def unequal_dataset() -> RayDataset:
    """The disc on black from one place twice, the second time at half the light."""
    dataset = small_dataset(40)
    half = len(dataset.pixels) // 2
    colour = dataset.pixels[:half, :3].where(dataset.pixels[:half, 3:] > 0, 0)
    darker = (255 * expose(colour / 255, torch.full((3,), -math.log(2)))).round().byte()
    geometry = dataset.view_geometry[:, :1].repeat(1, 2)
    return dataset._replace(pixels=torch.cat([colour, darker]), view_geometry=geometry)


def test_exposures_are_learnt_where_they_are_modelled() -> None:
    settings, errors = replace(TRAINER, background=(0.0, 0.0, 0.0), seed=0), []  # of some seeds all becomes black
    exposures = ExposureModel(torch.zeros(2, 3))
    for effects in (NO_EFFECTS, ImageEffects(colours=(exposures,))):
        run = HashGridTrainer(HashGridField(FIELD, 0, reference), unequal_dataset(), settings, effects)
        errors.append([run.step(step, step / 300).psnr for step in range(300)][-1])
    red = exposures.log_gain[:, 0]
    assert 0.15 < float(red[0] - red[1]) < 0.8 and exposures.log_gain.mean(0).abs().max() < 1e-6
    assert errors[1] > errors[0] + 1


@pytest.mark.parametrize("seed", [1, 2])
def test_the_gradient_of_poses_is_that_of_the_loss(seed: int) -> None:
    """As far as differences tell: of other fields, samples that come to lie in another cell weigh more in them."""
    poses, settings = PoseRefinement(torch.eye(3)[:2]), replace(TRAINER, background=BACKGROUND)
    poses.turn += torch.tensor([[0.02, 0.01, -0.01], [0.0, -0.02, 0.03]])
    run = HashGridTrainer(HashGridField(FIELD, seed, reference), small_dataset(), settings, ImageEffects((poses,)))
    for step in range(60):
        run.step(step, 0.84)  # at a third of the rate
    by_hand = run._compute_micro_batch(7, 0.5, 128, 0).grad_effects
    assert set(by_hand) == {"pose_refinement.turn", "pose_refinement.offset"}

    def difference(part: Tensor, view: int, axis: int) -> float:
        losses = []
        for sign in (1, -1):
            part[view, axis] += sign * 2e-3
            losses.append(float(run._compute_micro_batch(7, 0.5, 128, 0).loss))
            part[view, axis] -= sign * 2e-3
        return (losses[0] - losses[1]) / 4e-3

    for name, part in poses.parameters.items():
        # across the line of sight: what a shift along it or a turn about it does is too little to measure like this
        found = torch.tensor([[difference(part, view, axis) for axis in (0, 1)] for view in (0, 1)])
        torch.testing.assert_close(
            by_hand[f"pose_refinement.{name}"][:, :2], found, rtol=0.2, atol=0.1 * float(found.abs().max())
        )


def test_per_image_parameters_are_part_of_the_state() -> None:
    def fresh() -> HashGridTrainer:
        exposures = ExposureModel(torch.tensor([[0.0, 0, 0], [0.5, 0.5, 0.5]]))
        effects = ImageEffects((PoseRefinement(torch.eye(3)[:2]),), (exposures,))
        return HashGridTrainer(HashGridField(FIELD, 0, reference), small_dataset(), TRAINER, effects)

    whole, first, second = fresh(), fresh(), fresh()
    for step in range(20):
        whole.step(step, step / 20)
    for step in range(10):
        first.step(step, step / 20)
    second.load_state(copied(first.state()))
    for step in range(10, 20):
        second.step(step, step / 20)
    assert same(whole.state(), second.state())
    names = {"image.pose_refinement.turn", "image.pose_refinement.offset", "image.exposure.log_gain"}
    assert names <= whole.state().keys()
    with pytest.raises(RuntimeError, match="image"):
        trainer().load_state(whole.state())


def test_without_view_dependence_a_point_has_one_colour() -> None:
    run = HashGridTrainer(HashGridField(replace(FIELD, view_dependence=False), 0, reference), small_dataset(), TRAINER)
    psnr = [run.step(step, step / 60).psnr for step in range(60)]
    points, directions = torch.rand(50, 3) - 0.5, torch.nn.functional.normalize(torch.randn(2, 50, 3), dim=-1)
    one, other = (run.model.density_and_colour(points, towards)[1] for towards in directions)
    assert torch.equal(one, other)
    assert psnr[-1] > 12 and run.model.colour_hidden.shape[0] == 16


def test_the_sky_becomes_what_is_seen_in_its_direction() -> None:
    """Two opposite views, one of blue and one of yellow: even through the first fog that shows at once."""
    dataset = small_dataset()
    colours = torch.tensor([[30, 60, 230], [240, 200, 30]], dtype=torch.uint8)
    dataset = dataset._replace(pixels=colours.repeat_interleave(len(dataset.pixels) // 2, 0))
    outdoors = replace(FIELD, space=Contraction(), min_step_size=0.05, cone_angle=0.1, background_model=True)
    run = HashGridTrainer(
        HashGridField(outdoors, 0, reference), dataset, replace(TRAINER, background=(0.0, 0.0, 0.0), learning_rate=1e-2)
    )
    for step in range(20):
        run.step(step, step / 20)
    ahead = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0.1, 1]])
    seen = background_colour(reference, run.model.background_table, ahead / ahead.norm(dim=-1, keepdim=True))
    assert torch.equal(seen > 0.5, colours[[0, 1, 0]] > 127)
    assert (seen - 0.5).abs().min() > 0.05
    assert {"model.background_table", "exp_avg.background_table", "exp_avg_sq.background_table"} <= run.state().keys()
    assert not any("sky" in name for name in trainer().state())


def test_known_distances_decide_a_shape_that_colours_leave_open() -> None:
    """Photos of one colour fit any depth; the centre of one is known to be 3 units away."""
    dataset = small_dataset()
    grey = dataset._replace(pixels=torch.full_like(dataset.pixels[:, :3], 128))
    guided = grey.with_sparse_depths(torch.tensor([78]), torch.tensor([3.0]))
    settings = replace(TRAINER, background=(0.0, 0.0, 0.0), depth_weight=0.1)
    centre, depth = grey.lookup(torch.tensor([78])).rays, {}
    for name, photos in {"open": grey, "guided": guided}.items():
        run = HashGridTrainer(HashGridField(FIELD, 0, reference), photos, settings)
        for step in range(120):
            run.step(step, step / 120)
        depth[name] = float(run.model.render(centre, torch.zeros(3)).depth)
    assert abs(depth["guided"] - 3) < 0.15 < abs(depth["open"] - 3) - 0.3


def test_points_guide_a_run_less_and_less() -> None:
    settings = replace(TRAINER, depth_weight=0.1)
    plain, guided = trainer(settings), trainer(settings)
    guided.dataset = guided.dataset.with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5]))
    assert depth_loss_multiplier(0.0) == 1 and depth_loss_multiplier(0.25) == 0.75 and depth_loss_multiplier(1.0) == 0
    assert plain.step(0, 1.0) == guided.step(0, 1.0)
    assert same(plain.state(), guided.state())
    plain.step(1, 0.9)
    guided.step(1, 0.9)
    assert not same(plain.state(), guided.state())


def test_the_depth_loss_fades_in_value_and_gradient() -> None:
    run = trainer(replace(TRAINER, depth_weight=0.1))
    run.dataset = run.dataset.with_sparse_depths(torch.tensor([78]), torch.tensor([3.0]))
    batch = run.draw_batch(0, 0.0, 0, 64)
    done = run.model.forward(batch.rays, batch.jitter, batch.thinning_offset, batch.background)
    weights = (run.loss_weights(64, share) for share in (0.25, 0.75, 1.0))
    early, late, over = (run._loss(64, each, done, batch) for each in weights)
    of_depth = [float(loss.value - over.value) for loss in (early, late)]
    assert of_depth[0] == pytest.approx(3 * of_depth[1]) and of_depth[1] > 0
    pulls = [loss.grad_weights - over.grad_weights for loss in (early, late)]
    torch.testing.assert_close(pulls[0], 3 * pulls[1])
    pulls = [loss.grad.opacity - over.grad.opacity for loss in (early, late)]
    torch.testing.assert_close(pulls[0], 3 * pulls[1])
    assert pulls[0].any()


def test_an_eighth_of_the_rays_run_to_points() -> None:
    run = trainer(replace(TRAINER, depth_weight=0.1))
    run.dataset = run.dataset.with_sparse_depths(torch.tensor([78]), torch.tensor([3.0]))
    for count in (1, 3, 5, 8, 21):
        to_points = [int((run.draw_batch(0, 0.1, chunk, count).known_depth > 0).sum()) for chunk in range(32)]
        assert sum(to_points) == 32 * count // 8 and max(to_points) - min(to_points) <= 1


def test_depth_maps_supervise_opaque_pixels_in_the_box() -> None:
    run = trainer(replace(TRAINER, depth_weight=0.1))
    run.dataset = run.dataset.with_depth_maps([torch.full((3, 3), 2.5), torch.full((12, 12), 4.9)])
    batch = run.draw_batch(0, 0.1, 0, 288)
    _, _, alpha, view = run.dataset.lookup(run.dataset.unmasked_pixels(run.pixel_sampler.take(0, 288)))
    assert alpha is not None and 0 < (alpha == 1).float().mean() < 1
    assert torch.equal(batch.known_depth, torch.where((alpha == 1) & (view == 0), 2.5, 0.0)), "4.9 ends behind the box"
    assert not run.draw_batch(0, 1.0, 0, 288).known_depth.any(), "at the end photos alone decide"


def test_depth_maps_pull_density_to_where_they_are() -> None:
    at = []
    for distance in (2.4, 3.4):
        run = trainer(replace(TRAINER, depth_weight=1.0, background=BACKGROUND))
        run.dataset = run.dataset._replace(pixels=run.dataset.pixels[:, :3].contiguous())
        run.dataset = run.dataset.with_depth_maps([torch.full((1, 1), distance)] * 2)
        for step in range(150):
            run.step(step, 0.0)
        rays = run.dataset.rays(torch.arange(60, 84))[0]
        at.append(float(run.model.render(rays, torch.tensor(BACKGROUND)).depth.median()))
    assert at[0] < at[1] - 0.4


def test_points_beyond_a_bounded_box_are_no_guide() -> None:
    dataset = small_dataset().with_sparse_depths(torch.tensor([78, 78]), torch.tensor([3.0, 4.5]))
    outdoors = replace(FIELD, space=Contraction(), min_step_size=0.05, cone_angle=0.1)
    for field, distances in {FIELD: [3.0], outdoors: [3.0, 4.5]}.items():
        kept = HashGridTrainer(HashGridField(field, 0, reference), dataset, TRAINER).dataset.sparse_depths
        assert kept is not None and kept.tolist() == distances


def test_without_a_weight_known_distances_change_nothing() -> None:
    plain, other = trainer(), trainer()
    other.dataset = other.dataset.with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5]))
    assert [plain.step(step, 0.1) for step in range(3)] == [other.step(step, 0.1) for step in range(3)]
    assert same(plain.state(), other.state())


def test_an_always_hidden_background_turns_grey(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light of a millionth reaches it now and then; Adam alone would follow that anywhere."""
    outdoors = replace(FIELD, space=Contraction(), min_step_size=0.05, cone_angle=0.1, background_model=True)
    run = HashGridTrainer(
        HashGridField(outdoors, 0, reference), small_dataset(), replace(TRAINER, background=(0.0, 0.0, 0.0))
    )
    run.model.background_table.fill_(3.0)
    noise = torch.Generator().manual_seed(0)

    def faint(*_: object) -> Tensor:
        light = 1e-10 * torch.randn(run.model.background_table.shape, generator=noise)
        light[:100] = 0
        return light

    monkeypatch.setattr(run.model, "background_backward", faint)
    for step in range(120):
        run.step(step, 0.0)
    assert run.model.background_table[100:].abs().mean() < 0.5
    assert torch.equal(run.model.background_table[:100], torch.full((100, 4), 3.0)), "no ray of any batch ran there"
