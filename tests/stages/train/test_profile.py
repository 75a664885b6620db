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
from stages.report.profile import PARTS, parts_bar
from stages.train import Config
from stages.train.fields.field_list import field_of
from stages.train.fields.hash_grid import field_settings
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.profile import FIRST_TIMED, RATES_SECONDS, TIMED_EVERY, observed, parts_table, write_parts
from tests.small_scenes import pinhole_directions

CPU = torch.device("cpu")
RATES = Rates(1e10, 1e8, 1e10)
GRID_PARTS = {"batch", "march", "gather", "encode", "mlp", "composite", "backward", "scatter", "optimiser", "cache"}
VANILLA_PARTS = {"batch", "sampling", "encode", "mlp", "composite", "backward", "optimiser"}
VANILLA: dict[str, Any] = {"depth": 3, "width": 16, "skip": 1, "samples_coarse": 8, "samples_fine": 8}
COUNTED: dict[str, Any] = {"steps": 1, "rays": 8, "samples": 80, "densities": 200, "seconds": 1.0, "core_seconds": 1.0}


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
    settings = HashGridTrainerSettings(0, "random", samples=512, chunks=2, distortion=1e-3)
    return HashGridTrainer(
        HashGridField(HashGridSettings(2, 4, 10, 8, 16, occupancy_resolution=16), 0, backend), dataset(), settings
    )


def timed_step(of: HashGridTrainer | VanillaTrainer, step: int, timings: dict[str, Any]) -> StepResult:
    return observed(partial(of.step, step, 0.1, 1.0), step, timings, CPU)


@pytest.mark.parametrize("kind", ["torch", "warp", "vanilla"])
def test_timed_and_untimed_runs_have_equal_bits(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.profile.TIMED_EVERY", 1)
    monkeypatch.setattr("stages.train.profile.FIRST_TIMED", 0)
    timed, plain, timings = trainer(kind), trainer(kind), {}
    for step in range(20):  # the occupancy grid is measured in the sixteenth
        assert timed_step(timed, step, timings) == plain.step(step, 0.1, 1.0)
    assert timings["steps"] == 20
    for name, tensor in plain.state().items():
        assert torch.equal(tensor, timed.state()[name]), name


@pytest.mark.parametrize("kind", ["torch", "warp", "vanilla"])
def test_shares_sum_to_one_and_every_part_is_there(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.profile.TIMED_EVERY", 1)
    monkeypatch.setattr("stages.train.profile.FIRST_TIMED", 0)
    of, timings = trainer(kind), {}
    results = [timed_step(of, step, timings) for step in range(5)]
    table = parts_table(timings, RATES)
    assert table["steps_timed"] == 5
    for name in ("rays", "samples", "densities"):
        assert table[name] == sum(getattr(result, name) for result in results) > 0, name
    assert table["samples"] <= table["densities"], "a colour is computed where the density lets it be seen"
    assert sum(row["share"] for row in table["parts"]) == pytest.approx(1, abs=1e-3)
    assert sum(row["seconds"] for row in table["parts"]) == pytest.approx(table["core_seconds"], abs=2e-3)
    names = {row["part"] for row in table["parts"]}
    assert names == (VANILLA_PARTS if kind == "vanilla" else GRID_PARTS) | {"rest", "waiting"}
    assert all(row["seconds"] >= 0 for row in table["parts"])
    seconds = [row["seconds"] for row in table["parts"]]
    assert seconds == sorted(seconds, reverse=True)
    assert names <= set(PARTS), "the report knows every part"


def test_few_steps_are_timed() -> None:
    of, timings = trainer("vanilla"), {}
    for step in range(TIMED_EVERY + FIRST_TIMED + 1):
        timed_step(of, step, timings)
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
        timed_step(of, FIRST_TIMED, timings)
    ours = sum(work[1] for work in timings["parts"].values())
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
    timed_step(of, FIRST_TIMED, timings)
    assert timings["densities"] == points[0]
    assert timings["parts"]["gather"][2] == 8 * 2 * points[0]
    assert timings["parts"]["scatter"][2] == 8 * 2 * timings["samples"]
    assert 0 < timings["samples"] <= timings["densities"]


def test_the_floor_is_work_over_rate() -> None:
    timings: dict[str, Any] = COUNTED | {"steps": 2, "rays": 100, "core_seconds": 2.0}
    timings["parts"] = {"mlp": [1.0, 2e9, 0.0, 0.0], "gather": [0.5, 0.0, 1e7, 0.0], "rest": [0.25, 0.0, 0.0, 0.0]}
    table = parts_table(timings, RATES)
    rows = {row["part"]: row for row in table["parts"]}
    assert rows["mlp"] == {"part": "mlp", "seconds": 1.0, "share": 0.5, "floor": 0.2}
    assert rows["gather"]["floor"] == pytest.approx(0.1)
    assert rows["rest"]["floor"] is None and rows["waiting"]["share"] == 0.125
    assert table["floor_share"] == pytest.approx(0.3 / 1.75, abs=1e-4)
    assert table["most_rays_per_second"] == pytest.approx(100 * 2 / 0.3, abs=0.1)


def test_threads_that_overlap_never_make_waiting_negative() -> None:
    timings = COUNTED | {"parts": {"mlp": [1.1, 0.0, 0.0, 0.0]}}
    table = parts_table(timings, RATES)
    assert {row["part"]: row["share"] for row in table["parts"]} == {"mlp": 1.0, "waiting": 0.0}
    assert table["most_rays_per_second"] is None


def test_the_page_has_a_row_per_part() -> None:
    timings = COUNTED | {"parts": {"mlp": [0.5, 1e9, 0.0, 0.0]}}
    bar = parts_bar(parts_table(timings, RATES))
    assert bar is not None and parts_bar(None) is None
    assert (bar["rays_per_second"], bar["samples_per_second"]) == (8, 80)
    assert [(row["part"], row["percent"], row["of_rate"]) for row in bar["rows"]] == [
        ("mlp", 50.0, pytest.approx(20.0)),
        ("waiting", 50.0, None),
    ]


def test_the_file_is_written_where_a_step_was_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr("stages.train.profile.measure_rates", lambda *sizes: asked.append(sizes) or RATES)
    of, timings, config = trainer("vanilla"), {}, Config(vanilla=VanillaOptions(width=16))
    assert write_parts(tmp_path, timings, config, CPU) == []
    timed_step(of, FIRST_TIMED, timings)
    assert write_parts(tmp_path, timings, config, CPU) == ["profile.json"]
    assert read_json(tmp_path / "profile.json") == parts_table(timings, RATES)
    assert asked == [(CPU, 16, 1, RATES_SECONDS)]


def test_hash_grid_rates_are_at_its_table_size() -> None:
    grid = HashGridOptions(num_levels=2, log2_hashmap_size=8, max_res=64)
    config = Config(grid=grid, space="bounded", view_dependence=True)
    rows = field_of(config).table_rows(config)
    assert (field_of(config).matmul_width(config), rows) == (64, field_settings(config, sky=False).layout.rows)
