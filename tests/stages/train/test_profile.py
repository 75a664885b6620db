"""The account of a training run: laws of its shares, work counted by others, and the same bits with it and without."""

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.kernels import torch as reference
from nerf.runtime.machine_rates import Rates
from nerf.synthetic.scenes import ring_of_cameras
from nerf.training.hash_grid_trainer import HashGridTrainer, HashGridTrainerSettings
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from nerf.training.trainer import StepResult
from nerf.training.vanilla_trainer import VanillaTrainer, VanillaTrainerSettings
from stages.hardware.backend import load_backend
from stages.io.files import read_json
from stages.report.profile import SPANS, profile_bar
from stages.train import Config
from stages.train.fields.field_list import field_of
from stages.train.fields.hash_grid import field_settings
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.profile import (
    FIRST_PROFILED_STEP,
    PROFILE_INTERVAL,
    RATES_SECONDS,
    profile_table,
    profiled_step,
    write_profile,
)
from tests.small_scenes import pinhole_directions

CPU = torch.device("cpu")
RATES = Rates(1e10, 1e8, 1e10)
GRID_SPANS = {"batch", "march", "gather", "encode", "mlp", "composite", "backward", "scatter", "optimiser", "occupancy"}
VANILLA_SPANS = {"batch", "sampling", "encode", "mlp", "composite", "backward", "optimiser"}
VANILLA: dict[str, Any] = {"depth": 3, "width": 16, "skip": 1, "samples_coarse": 8, "samples_fine": 8}
COUNTED: dict[str, Any] = {
    "steps": 1,
    "rays": 8,
    "colour_evaluations": 80,
    "density_evaluations": 200,
    "seconds": 1.0,
    "core_seconds": 1.0,
}


def dataset() -> RayDataset:
    random = torch.Generator().manual_seed(0)
    photos = [torch.randint(256, (12, 12, 4), generator=random, dtype=torch.uint8) for _ in range(3)]
    poses = torch.stack([torch.tensor(pose, dtype=torch.float32) for pose in ring_of_cameras(3)])
    near, far = torch.full((3,), 0.2), torch.full((3,), 4.0)
    return ray_dataset_from_images(photos, [0, 0, 0], [pinhole_directions(12, 12, 14.0)], poses, near, far)


def trainer(kind: str) -> HashGridTrainer | VanillaTrainer:
    if kind == "vanilla":
        return VanillaTrainer(
            VanillaNerf(VanillaSettings(**VANILLA), 0), dataset(), VanillaTrainerSettings(32, 0, "random")
        )
    backend = load_backend("warp" if kind == "warp" else "torch", "cpu")
    settings = HashGridTrainerSettings(0, "random", target_samples=512, micro_batches=2, distortion_weight=1e-3)
    return HashGridTrainer(
        HashGridField(HashGridSettings(2, 4, 10, 8, 16, occupancy_resolution=16), 0, backend), dataset(), settings
    )


def profiled(of: HashGridTrainer | VanillaTrainer, step: int, timings: dict[str, Any]) -> StepResult:
    return profiled_step(partial(of.step, step, 0.1, 1.0), step, timings, CPU)


@pytest.mark.parametrize("kind", ["torch", "warp", "vanilla"])
def test_timed_and_untimed_runs_have_equal_bits(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.profile.PROFILE_INTERVAL", 1)
    monkeypatch.setattr("stages.train.profile.FIRST_PROFILED_STEP", 0)
    timed, plain, timings = trainer(kind), trainer(kind), {}
    for step in range(20):  # the occupancy grid is measured in the sixteenth
        assert profiled(timed, step, timings) == plain.step(step, 0.1, 1.0)
    assert timings["steps"] == 20
    for name, tensor in plain.state().items():
        assert torch.equal(tensor, timed.state()[name]), name


@pytest.mark.parametrize("kind", ["torch", "warp", "vanilla"])
def test_shares_sum_to_one_and_every_part_is_there(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.profile.PROFILE_INTERVAL", 1)
    monkeypatch.setattr("stages.train.profile.FIRST_PROFILED_STEP", 0)
    of, timings = trainer(kind), {}
    results = [profiled(of, step, timings) for step in range(5)]
    table = profile_table(timings, RATES)
    assert table["profiled_steps"] == 5
    for name in ("rays", "colour_evaluations", "density_evaluations"):
        assert table[name] == sum(getattr(result, name) for result in results) > 0, name
    assert table["colour_evaluations"] <= table["density_evaluations"], (
        "a colour is computed where the density lets it be seen"
    )
    assert sum(row["share"] for row in table["spans"]) == pytest.approx(1, abs=1e-3)
    assert sum(row["seconds"] for row in table["spans"]) == pytest.approx(table["core_seconds"], abs=2e-3)
    names = {row["span"] for row in table["spans"]}
    assert names == (VANILLA_SPANS if kind == "vanilla" else GRID_SPANS) | {"rest", "idle"}
    assert all(row["seconds"] >= 0 for row in table["spans"])
    seconds = [row["seconds"] for row in table["spans"]]
    assert seconds == sorted(seconds, reverse=True)
    assert names <= set(SPANS), "the report knows every part"


def test_few_steps_are_timed() -> None:
    of, timings = trainer("vanilla"), {}
    for step in range(PROFILE_INTERVAL + FIRST_PROFILED_STEP + 1):
        profiled(of, step, timings)
    assert timings["steps"] == 2


@pytest.mark.parametrize("kind", ["torch", "vanilla"])
@pytest.mark.parametrize("changed", [{}, {"hierarchical": False}, {"skip": 4}, {"view_dependence": False}])
def test_products_are_those_that_torch_counts(
    kind: str, changed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "torch" and changed:
        pytest.skip("settings of the vanilla field")
    for name, value in changed.items():
        monkeypatch.setitem(VANILLA, name, value)
    of, timings = trainer(kind), {}
    monkeypatch.setattr("nerf.runtime.parallel.workers", lambda: 1)  # the counter sees the thread that it is opened in
    with FlopCounterMode(display=False) as counted:
        profiled(of, FIRST_PROFILED_STEP, timings)
    ours = sum(work[1] for work in timings["spans"].values())
    # We leave out what is once per ray (directions) and, of the grid field, a hidden layer computed again; and torch
    # counts a rectangle of unneeded gradients.
    least = 0.7 if kind == "torch" else 0.8
    assert least * counted.get_total_flops() < ours <= counted.get_total_flops()


def test_rows_are_eight_corners_of_each_grid_of_each_point() -> None:
    of = trainer("torch")
    assert isinstance(of, HashGridTrainer)
    points, encode, timings = [0], reference.encode, {}

    class Counting:
        def __getattr__(self, name: str) -> Any:
            return getattr(reference, name)

        def encode(self, layout: Any, table: Any, unit: torch.Tensor) -> torch.Tensor:
            points[0] += len(unit)
            return encode(layout, table, unit)

    of.model.backend = Counting()  # type: ignore[assignment]
    profiled(of, FIRST_PROFILED_STEP, timings)
    assert timings["density_evaluations"] == points[0]
    assert timings["spans"]["gather"][2] == 8 * 2 * points[0]
    assert timings["spans"]["scatter"][2] == 8 * 2 * timings["colour_evaluations"]
    assert 0 < timings["colour_evaluations"] <= timings["density_evaluations"]


def test_the_floor_is_work_over_rate() -> None:
    timings: dict[str, Any] = COUNTED | {"steps": 2, "rays": 100, "core_seconds": 2.0}
    timings["spans"] = {"mlp": [1.0, 2e9, 0.0, 0.0], "gather": [0.5, 0.0, 1e7, 0.0], "rest": [0.25, 0.0, 0.0, 0.0]}
    table = profile_table(timings, RATES)
    rows = {row["span"]: row for row in table["spans"]}
    assert rows["mlp"] == {"span": "mlp", "seconds": 1.0, "share": 0.5, "min_seconds": 0.2}
    assert rows["gather"]["min_seconds"] == pytest.approx(0.1)
    assert rows["rest"]["min_seconds"] is None and rows["idle"]["share"] == 0.125
    assert table["efficiency"] == pytest.approx(0.3 / 1.75, abs=1e-4)
    assert table["max_rays_per_second"] == pytest.approx(100 * 2 / 0.3, abs=0.1)


def test_threads_that_overlap_never_make_waiting_negative() -> None:
    timings = COUNTED | {"spans": {"mlp": [1.1, 0.0, 0.0, 0.0]}}
    table = profile_table(timings, RATES)
    assert {row["span"]: row["share"] for row in table["spans"]} == {"mlp": 1.0, "idle": 0.0}
    assert table["max_rays_per_second"] is None


def test_the_page_has_a_row_per_part() -> None:
    timings = COUNTED | {"spans": {"mlp": [0.5, 1e9, 0.0, 0.0]}}
    bar = profile_bar(profile_table(timings, RATES))
    assert bar is not None and profile_bar(None) is None
    assert (bar["rays_per_second"], bar["colours_per_second"]) == (8, 80)
    assert [(row["span"], row["percent"], row["of_rate"]) for row in bar["rows"]] == [
        ("mlp", 50.0, pytest.approx(20.0)),
        ("idle", 50.0, None),
    ]


def test_the_file_is_written_where_a_step_was_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr("stages.train.profile.measure_rates", lambda *sizes: asked.append(sizes) or RATES)
    of, timings, config = trainer("vanilla"), {}, Config(vanilla=VanillaOptions(width=16))
    assert write_profile(tmp_path, timings, config, CPU) == []
    profiled(of, FIRST_PROFILED_STEP, timings)
    assert write_profile(tmp_path, timings, config, CPU) == ["profile.json"]
    assert read_json(tmp_path / "profile.json") == profile_table(timings, RATES)
    assert asked == [(CPU, 16, 1, RATES_SECONDS)]


def test_hash_grid_rates_are_at_its_table_size() -> None:
    grid = HashGridOptions(num_levels=2, log2_hashmap_size=8, max_res=64)
    config = Config(grid=grid, space="bounded", view_dependence=True)
    rows = field_of(config).table_rows(config)
    assert (field_of(config).matmul_width(config), rows) == (
        64,
        field_settings(config, background_model=False).layout.rows,
    )
