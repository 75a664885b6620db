"""Steps with capacities for their samples, as CUDA graphs hold them: computed again on a CPU; graphs where there is a
GPU."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf.effects import ImageEffects
from nerf.effects.exposure import ExposureModel
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.hash_grid import HashGridField, HashGridSettings, SampleCapacities
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels import Backend, warp
from nerf.kernels import torch as reference
from nerf.rendering.early_termination import RoundSize
from nerf.training.graph_trainer import (
    MIN_SPARE_CAPACITY,
    SPARE_CAPACITY,
    Compute,
    GraphTrainer,
    ReplayableStep,
    StepGraph,
    with_spare,
)
from nerf.training.hash_grid_trainer import HashGridBatch, HashGridTrainer, LossWeights, MicroBatch
from nerf.training.trainer import RAY_GEOMETRY, NonFinite
from tests.devices import DEVICES, skip_without
from tests.nerf.training.test_hash_grid_trainer import FIELD, TRAINER, copied, small_dataset

CONTRACTED = replace(FIELD, space=Contraction(), min_step_size=0.1, cone_angle=0.2, background_model=True)
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FORWARD = replace(FIELD, space=Ndc((0.0, 0.0, -3.0), AXES, (0.6, 0.6), 1.0), background_model=True)
LOSSES = replace(TRAINER, distortion_weight=0.1, depth_weight=0.2, backdrop_tolerance=0.05)


def trainer_on(device: str, backend: Backend, field: HashGridSettings = FIELD) -> HashGridTrainer:
    dataset = small_dataset().with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5])).to(device)
    model = HashGridField(field, 0, backend).to(device)
    centres = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, 3.0]], device=device)
    effects = ImageEffects((PoseRefinement(centres),), (ExposureModel(torch.zeros(2, 3, device=device)),))
    return HashGridTrainer(model, dataset, LOSSES, effects)


def differentiated(run: HashGridTrainer, given: SampleCapacities | None = None) -> MicroBatch:
    batch = run.draw_batch(3, 0.25, 0, 64)
    rays = run.effects.forward_rays(batch.rays, batch.view)
    return run.differentiate(batch, rays, 64, run.loss_weights(64, 0.25), given)


@pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])
@pytest.mark.parametrize("field", [FIELD, CONTRACTED, FORWARD], ids=["box", "contracted", "ndc"])
def test_capacities_that_suffice_change_no_gradient(backend: Backend, field: HashGridSettings) -> None:
    run = trainer_on("cpu", backend, field)
    for step in range(20):
        run.take_step(step, 0.1, 1.0)
    exact = differentiated(run)
    given = with_spare(exact.capacities, SPARE_CAPACITY, run.model.stepping.max_samples)
    padded, needed = differentiated(run, given), sum(each.capacity for each in exact.capacities.rounds)
    assert exact.fits and padded.fits and len(padded.points) == given.visible > len(exact.points) > 100
    assert int(padded.colour_evaluations) == len(exact.points)
    assert padded.density_evaluations == exact.density_evaluations == needed
    for name in ("loss", "squared_error", "grad_norm", "grad_networks", "grad_background", "grad_effects"):
        torch.testing.assert_close(getattr(padded, name), getattr(exact, name), rtol=1e-4, atol=1e-8)
    for name in ("points", "grad_features", "optical_thickness"):
        samples, padding = getattr(padded, name).tensor_split([len(exact.points)])
        torch.testing.assert_close(samples, getattr(exact, name), rtol=1e-4, atol=1e-8)
        assert name != "grad_features" or not padding.any()


def test_samples_beyond_the_capacities_are_noticed() -> None:
    run = trainer_on("cpu", warp)
    needed = differentiated(run).capacities
    (only,) = needed.rounds
    plenty = RoundSize(only.per_ray, 1 << 16)
    assert differentiated(run, SampleCapacities((plenty,), 1 << 16)).fits
    assert not differentiated(run, SampleCapacities((only,), 1 << 16)).fits
    assert not differentiated(run, SampleCapacities((plenty,), needed.visible)).fits
    assert not differentiated(run, SampleCapacities((plenty._replace(per_ray=3),), 1 << 16)).fits
    split = (plenty._replace(per_ray=3), plenty._replace(per_ray=run.model.stepping.max_samples - 3))
    assert differentiated(run, SampleCapacities(split, 1 << 16)).fits


def test_spare_capacity_stays_within_what_a_ray_may_have() -> None:
    needed = SampleCapacities((RoundSize(8, 1000), RoundSize(40, 10)), 500)
    more = with_spare(needed, 1.5, max_samples=1024)
    assert more.rounds[0] == RoundSize(8, 1500 + MIN_SPARE_CAPACITY) and more.rounds[1].per_ray > 80
    assert with_spare(needed, SPARE_CAPACITY, max_samples=1024).rounds[1].per_ray == 80
    assert with_spare(needed, SPARE_CAPACITY, max_samples=60).rounds[1].per_ray == 52


class Recomputed:
    """What a graph computes, on any device."""

    def __init__(
        self, compute: Compute, batch: HashGridBatch, weights: LossWeights, previous: ReplayableStep | None = None
    ) -> None:
        self.compute, self.weights, self.rays = compute, weights, len(batch.jitter)

    def replay(self, batch: HashGridBatch, weights: LossWeights) -> tuple[MicroBatch, Tensor]:
        return self.compute(batch, weights)


@pytest.fixture(params=DEVICES)
def run(request: pytest.FixtureRequest) -> GraphTrainer:
    skip_without(request.param)
    return GraphTrainer(trainer_on(request.param, warp), Recomputed if request.param == "cpu" else StepGraph)


def table_of(run: GraphTrainer) -> Tensor:
    return copied(run.state())["model.table"]


def test_a_graph_learns_what_single_launches_learn(run: GraphTrainer) -> None:
    apart, graphs = trainer_on(str(run.trainer.dataset.device), warp), set[int]()
    for step in range(299):
        run.step(step, step / 300)
        apart.step(step, step / 300)
        graphs |= {id(run.graph)} - {id(None)}
    assert len(graphs) > 1, "graphs are captured anew as the number of rays changes"
    assert run.refused < 10
    of_graph, of_apart = run.step(299, 1.0), apart.step(299, 1.0)
    assert min(of_graph.psnr, of_apart.psnr) > 40
    assert of_graph.colour_evaluations == pytest.approx(of_apart.colour_evaluations, rel=0.2)
    assert of_graph.rays == pytest.approx(of_apart.rays, rel=0.2)


def test_a_graph_refuses_what_is_not_finite_a_step_late(run: GraphTrainer) -> None:
    for step in range(200):
        run.step(step, 0.5)
    assert run.graph is not None and run.unread is not None
    (poses,) = run.effects.rays
    good, before = copied(poses.parameters), table_of(run)
    poses.parameters["turn"][:, 1] = float("nan")
    run.step(200, 0.5)
    with pytest.raises(NonFinite, match=f"the {RAY_GEOMETRY} of step 200 is not finite"):
        run.step(201, 0.5)
    assert torch.equal(table_of(run), before)
    for name, tensor in poses.parameters.items():
        tensor.copy_(good[name])
    for step in range(202, 205):
        run.step(step, 0.5)
    assert not torch.equal(table_of(run), before)


def test_a_step_beyond_the_capacities_changes_nothing(run: GraphTrainer) -> None:
    for step in range(200):
        run.step(step, 0.5)
    rays = run.trainer.rays_per_micro_batch()
    batch, weights = run.trainer.draw_batch(200, 0.5, 0, rays), run.trainer.loss_weights(rays, 0.5)
    (first, *_) = differentiated(run.trainer).capacities.rounds
    few = int((50 - MIN_SPARE_CAPACITY) / SPARE_CAPACITY)  # with what is spared about 50
    run._capture(SampleCapacities((first._replace(capacity=few),), few), batch, weights)
    before, spare, refused = table_of(run), run.spare, run.refused
    run.step(200, 0.5)
    run.step(201, 0.5)
    assert torch.equal(table_of(run), before)
    assert not run.fits and run.refused == refused + 1
    run.step(202, 0.5)
    run.step(203, 0.5)
    run.step(204, 0.5)
    assert run.fits and run.spare > spare and not torch.equal(table_of(run), before)


def test_without_memory_for_a_graph_steps_go_on(run: GraphTrainer) -> None:
    asked = list[ReplayableStep | None]()

    def no_memory(compute: Compute, batch: HashGridBatch, weights: LossWeights, previous: ReplayableStep | None):
        asked.append(previous)
        raise torch.OutOfMemoryError("too much")

    run.capture = no_memory
    results = [run.step(step, 0.5) for step in range(100)]
    assert asked == [None, None] and run.lacks_memory and run.graph is None
    assert results[-1].psnr > results[0].psnr
