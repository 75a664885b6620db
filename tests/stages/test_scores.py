"""The score of a field is one figure, whichever stage computes it, and wherever."""

from pathlib import Path
from typing import Any

import pytest

from stages import evaluate, train
from stages.contract import run_stage
from stages.evaluate import tiles
from stages.hardware import cluster
from stages.io.files import read_scene
from stages.tradeoff import Config, benchmark
from stages.tradeoff.schedule import REDUCED, Run
from stages.tradeoff.study import RunApart
from stages.train.fields.hash_grid_options import HashGridOptions
from tests.stages.photo_scene import photographed

GRID = HashGridOptions(num_levels=2, log2_hashmap_size=10, max_res=32, target_samples=1024)


def test_a_study_scores_as_evaluate_does(tmp_path: Path, progress: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "TILE_SIZE", 8)  # six cover a photo of 24 × 16 without overlap
    photos, _ = photographed(tmp_path / "photos", channels=4)
    own, scored = tmp_path / "train", tmp_path / "evaluate"
    for folder in (own, scored):
        folder.mkdir()
    run_stage(train.STAGE, train.Config(steps=70, downscale=1.0, grid=GRID), photos, own, progress)
    facts = run_stage(evaluate.STAGE, evaluate.Config(fraction=1), photos | {"train": own}, scored, progress).facts
    made = benchmark.make_benchmark(photos["ingest"], read_scene(photos["normalise"]), None, 1000, 2.0)
    figures = benchmark.score(own, made, progress)
    assert figures["psnr"] == pytest.approx(facts["psnr"], abs=0.001)


def test_a_cluster_scores_the_same(tmp_path: Path, progress: Any, ray_cluster: str) -> None:
    photos, _ = photographed(tmp_path / "photos", channels=4)
    own = tmp_path / "train"
    own.mkdir()
    run_stage(train.STAGE, train.Config(steps=5, downscale=1.0, grid=GRID), photos, own, progress)

    def scored(name: str) -> dict[str, bytes]:
        folder = tmp_path / name
        folder.mkdir()
        run_stage(evaluate.STAGE, evaluate.Config(fraction=1), photos | {"train": own}, folder, progress)
        return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*.*")}

    here = scored("here")
    with cluster.joined(ray_cluster, [tmp_path]):
        assert scored("there") == here
    assert progress.updates[-1] == ("test photo 2 of 2", 1.0) and len(here) == 1 + 2 * 2


def test_a_cluster_makes_the_same_runs(tmp_path: Path, ray_cluster: str) -> None:
    photos, _ = photographed(tmp_path / "photos", channels=4)
    config = Config(seconds=60, downscale=1.0, sizes=(1.0,), tiles=2)
    runs = [Run(REDUCED, "bounded", 1.0, 2, seed, 1.0) for seed in range(2)]

    def scores(name: str) -> list[tuple[Run, float]]:
        folder = tmp_path / name
        folder.mkdir()
        made = cluster.fan_out(RunApart(config, photos, folder), runs, place="machine")
        return [(run, figures["psnr"]) for run, figures in made]

    here = scores("here")
    with cluster.joined(ray_cluster, [tmp_path]):
        assert scores("there") == here
    assert [run for run, _ in here] == runs and len({psnr for _, psnr in here}) == 2
