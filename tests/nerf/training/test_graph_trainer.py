"""Steps with a plan for their samples, as CUDA graphs hold them; where there is a GPU, the graphs themselves."""

from dataclasses import replace

import pytest
import torch

from nerf.effects import ImageEffects
from nerf.effects.exposure import ExposureModel
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.hash_grid import HashGridField, HashGridSettings, SamplePlan
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.kernels import Backend, warp
from nerf.kernels import torch as reference
from nerf.rendering.early_termination import RoundSize
from nerf.training.graph_trainer import MIN_SPARE_ROOM, ROOM, GraphTrainer, with_spare_room
from nerf.training.hash_grid_trainer import HashGridTrainer, MicroBatch
from nerf.training.trainer import RAY_GEOMETRY, NonFinite
from tests.devices import skip_without
from tests.nerf.training.test_hash_grid_trainer import FIELD, TRAINER, copied, small_dataset

CONTRACTED = replace(FIELD, space=Contraction(), min_step_size=0.1, cone_angle=0.2, background_model=True)
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FORWARD = replace(FIELD, space=Ndc((0.0, 0.0, -3.0), AXES, (0.6, 0.6), 1.0), background_model=True)
LOSSES = replace(TRAINER, distortion_weight=0.1, depth_weight=0.2)


def trainer_on(device: str, backend: Backend, field: HashGridSettings = FIELD) -> HashGridTrainer:
    dataset = small_dataset().with_sparse_depths(torch.tensor([78, 222]), torch.tensor([3.0, 2.5])).to(device)
    model = HashGridField(field, 0, backend).to(device)
    centres = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, 3.0]], device=device)
    effects = ImageEffects((PoseRefinement(centres),), (ExposureModel(torch.zeros(2, 3, device=device)),))
    return HashGridTrainer(model, dataset, LOSSES, effects)


def differentiated(run: HashGridTrainer, plan: SamplePlan | None = None) -> MicroBatch:
    batch = run.draw_batch(3, 0.25, 0, 64)
    rays = run.effects.forward_rays(batch.rays, batch.view)
    return run.differentiate(batch, rays, 64, run.loss_weights(64, 0.25), plan)


@pytest.mark.parametrize("backend", [reference, warp], ids=["reference", "warp"])
@pytest.mark.parametrize("field", [FIELD, CONTRACTED, FORWARD], ids=["box", "contracted", "ndc"])
def test_a_plan_with_room_changes_no_gradient(backend: Backend, field: HashGridSettings) -> None:
    run = trainer_on("cpu", backend, field)
    for step in range(20):
        run.take_step(step, 0.1, 1.0)
    exact = differentiated(run)
    plan = with_spare_room(exact.room, run.model.stepping.max_samples)
    padded = differentiated(run, plan)
    assert exact.fits and padded.fits and len(padded.points) == plan.visible > len(exact.points) > 100
    assert int(padded.colour_evaluations) == len(exact.points)
    assert padded.density_evaluations == exact.density_evaluations == sum(each.capacity for each in exact.room.rounds)
    for name in ("loss", "squared_error", "grad_norm", "grad_networks", "grad_background", "grad_effects"):
        torch.testing.assert_close(getattr(padded, name), getattr(exact, name), rtol=1e-4, atol=1e-8)
    for name in ("points", "grad_features", "optical_thickness"):
        samples, padding = getattr(padded, name).tensor_split([len(exact.points)])
        torch.testing.assert_close(samples, getattr(exact, name), rtol=1e-4, atol=1e-8)
        assert name != "grad_features" or not padding.any()


def test_samples_without_room_are_noticed() -> None:
    run = trainer_on("cpu", warp)
    room = differentiated(run).room
    (only,) = room.rounds
    plenty = RoundSize(only.per_ray, 1 << 16)
    assert differentiated(run, SamplePlan((plenty,), 1 << 16)).fits
    assert not differentiated(run, SamplePlan((only,), 1 << 16)).fits
    assert not differentiated(run, SamplePlan((plenty,), room.visible)).fits
    assert not differentiated(run, SamplePlan((plenty._replace(per_ray=3),), 1 << 16)).fits
    split = (plenty._replace(per_ray=3), plenty._replace(per_ray=run.model.stepping.max_samples - 3))
    assert differentiated(run, SamplePlan(split, 1 << 16)).fits


def test_room_to_spare_stays_within_what_a_ray_may_have() -> None:
    room = SamplePlan((RoundSize(8, 1000), RoundSize(40, 10)), 500)
    plan = with_spare_room(room, max_samples=1024)
    assert plan.rounds[0] == RoundSize(8, 1150 + MIN_SPARE_ROOM) and plan.rounds[1].per_ray == 80
    assert with_spare_room(room, max_samples=60).rounds[1].per_ray == 52


@pytest.fixture
def on_gpu() -> GraphTrainer:
    skip_without("cuda")
    return GraphTrainer(trainer_on("cuda", warp))


@pytest.mark.gpu
def test_a_graph_learns_what_single_launches_learn(on_gpu: GraphTrainer) -> None:
    apart, graphs = trainer_on("cuda", warp), set[int]()
    for step in range(299):
        on_gpu.step(step, step / 300)
        apart.step(step, step / 300)
        graphs |= {id(on_gpu.graph)} - {id(None)}
    assert len(graphs) > 1, "graphs are made anew as the number of rays changes"
    of_graph, of_apart = on_gpu.step(299, 1.0), apart.step(299, 1.0)
    assert min(of_graph.psnr, of_apart.psnr) > 40
    assert of_graph.colour_evaluations == pytest.approx(of_apart.colour_evaluations, rel=0.2)
    assert of_graph.rays == pytest.approx(of_apart.rays, rel=0.2)


@pytest.mark.gpu
def test_a_graph_refuses_what_is_not_finite_a_step_late(on_gpu: GraphTrainer) -> None:
    for step in range(200):
        on_gpu.step(step, 0.5)
    assert on_gpu.graph is not None and on_gpu.unread is not None
    (poses,) = on_gpu.effects.rays
    good = copied(poses.parameters)
    before = copied(on_gpu.state())["model.table"]
    poses.parameters["turn"][:, 1] = float("nan")
    on_gpu.step(200, 0.5)
    with pytest.raises(NonFinite, match=f"the {RAY_GEOMETRY} of step 200 is not finite"):
        on_gpu.step(201, 0.5)
    assert torch.equal(on_gpu.state()["model.table"], before)
    for name, tensor in poses.parameters.items():
        tensor.copy_(good[name])
    for step in range(202, 205):
        on_gpu.step(step, 0.5)


@pytest.mark.gpu
def test_a_step_without_room_changes_nothing(on_gpu: GraphTrainer) -> None:
    for step in range(200):
        on_gpu.step(step, 0.5)
    assert on_gpu.graph is not None
    batch, weights = on_gpu.graph.batch, on_gpu.graph.weights
    (first, *_) = differentiated(on_gpu.trainer).room.rounds
    few = int((50 - MIN_SPARE_ROOM) / ROOM)  # with room to spare that is about 50
    on_gpu.graph = on_gpu._new_graph(SamplePlan((first._replace(capacity=few),), few), batch, weights)
    before = copied(on_gpu.state())["model.table"]
    on_gpu.step(200, 0.5)
    assert torch.equal(on_gpu.state()["model.table"], before)
    on_gpu.step(201, 0.5)
    assert not on_gpu.has_room
    on_gpu.step(202, 0.5)
    on_gpu.step(203, 0.5)
    assert on_gpu.has_room and not torch.equal(on_gpu.state()["model.table"], before)
