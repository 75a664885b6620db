"""Published tables: what a folder is, in what it deviates, figures of others, the table, the plot, LPIPS."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.published import literature
from benchmarks.published.__main__ import KEY, earlier
from benchmarks.published.literature import METHODS, TABLES, comparison
from benchmarks.published.lpips_distance import load_lpips, mean_lpips
from benchmarks.published.plot import draw
from benchmarks.published.protocols import SCENES, Case, deviations, find_case
from benchmarks.record import Record
from nerf.geometry.normalisation import Similarity
from nerf.geometry.scene import Camera, Scene, Split, View
from stages.io.files import write_json


def photo(file: Path, size: tuple[int, int], colour: tuple[int, ...] = (9, 9, 9)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGBA" if len(colour) == 4 else "RGB", size, colour).save(file)


def scene_of(train: int, test: int, size: tuple[int, int] = (8, 8)) -> Scene:
    splits: list[Split] = ["train" if index < train else "test" for index in range(train + test)]
    views = [View(str(i), f"images/{i}.png", 0, np.eye(4)[:3], 1.0, 2.0, split) for i, split in enumerate(splits)]
    camera = Camera("PINHOLE", *size, (9.0, 9.0, size[0] / 2, size[1] / 2))
    return Scene((camera,), tuple(views), Similarity(1.0, np.eye(3), np.zeros(3)), True, False, "object-centric", True)


def ours(table: str, scene: str, seconds: float, **more: Any) -> dict[str, Any]:
    row = {"table": table, "scene": scene, "method": "grid", "seconds": seconds, "psnr": 31.456, "ssim": 0.961}
    return row | {"deviates": None, "machine": "a laptop, no GPU"} | more


def test_folders_are_known_by_their_scene(tmp_path: Path):
    (tmp_path / "lego_400").mkdir()
    (tmp_path / "lego_400" / "transforms_test.json").write_text("{}")
    assert find_case("blender", tmp_path / "lego_400") == Case("blender", "lego", tmp_path / "lego_400", None, 1)


@pytest.mark.parametrize(
    ("table", "name"), [("blender", "fern"), ("llff", "legoland"), ("mip360", "lego"), ("blender", "lego")]
)
def test_other_folders_are_refused(tmp_path: Path, table: str, name: str):
    (tmp_path / name).mkdir()
    with pytest.raises(SystemExit):
        find_case(table, tmp_path / name)


def test_reduced_photos_and_given_cameras_are_taken(tmp_path: Path):
    photo(tmp_path / "fern" / "images_4" / "0.png", (12, 9))
    photo(tmp_path / "fern" / "images" / "0.jpg", (4032, 30))
    (tmp_path / "fern" / "poses_bounds.npy").touch()
    found = find_case("llff", tmp_path / "fern")
    assert found[2:] == (tmp_path / "fern" / "images_4", tmp_path / "fern" / "poses_bounds.npy", 1)


@pytest.mark.parametrize(("width", "downscale"), [(3118, 2), (1559, 1)])
def test_photos_as_taken_are_reduced_when_scored(tmp_path: Path, width: int, downscale: int):
    photo(tmp_path / "bonsai" / "images" / "0.jpg", (width, 30))
    assert find_case("mip360", tmp_path / "bonsai").downscale == downscale


@pytest.mark.parametrize(
    ("case", "scene", "size", "count"),
    [
        (Case("blender", "lego", Path("x"), None, 1), scene_of(100, 200), (800, 800), 0),
        (Case("blender", "lego", Path("x"), None, 1), scene_of(100, 25), (400, 400), 2),
        (Case("llff", "fern", Path("images_4"), Path("p.npy"), 1), scene_of(17, 3), (1008, 756), 0),
        (Case("llff", "fern", Path("images"), Path("p.npy"), 4), scene_of(17, 3), (1008, 756), 1),
        (Case("llff", "fern", Path("images_4"), None, 1), scene_of(17, 3), (504, 378), 2),
        (Case("mip360", "bonsai", Path("images_2"), Path("sparse"), 1), scene_of(255, 37), (1559, 1039), 0),
        (Case("mip360", "bonsai", Path("images"), None, 1), scene_of(105, 15), (800, 533), 3),
    ],
)
def test_deviations_from_a_protocol_are_told(case: Case, scene: Scene, size: tuple[int, int], count: int):
    assert len(deviations(case, scene, size)) == count


def test_every_published_figure_is_plausible_and_sourced():
    rows = [row for table in SCENES for scene in SCENES[table] for row in literature.published(table, scene)]
    assert len(rows) == 101
    assert {row["method"] for row in rows} == set(METHODS)
    assert all(10 < value < 40 for row in rows for value in (row["psnr"], row["paper_psnr"]) if value is not None)
    assert all(60 < row["seconds"] < 90_000 for row in rows if row["seconds"] is not None)
    assert all((row["psnr"] is None) == (row["seconds"] is None) for row in rows)
    assert all(row["psnr"] or row["paper_psnr"] for row in rows)
    assert len({(row["table"], row["scene"], row["method"]) for row in rows}) == len(rows)


def test_tables_are_those_of_the_protocols():
    assert set(TABLES) == set(SCENES)


def test_ours_stand_beside_the_figures_of_others():
    rows = [
        ours("llff", "fern", 60.0),
        ours("blender", "lego", 60.0, deviates="small"),
        ours("blender", "lego", 300.0, deviates="small"),
    ]
    head, _, lego, fern = (line.strip("| ").split(" | ") for line in comparison(rows).splitlines())
    assert head[:4] == ["scene", "ours, 1 min", "ours, 5 min", "NeRF"]
    assert lego[0] == "lego: small"
    assert lego[1:3] == ["31.46 / 0.96", "31.46 / 0.96"]
    assert lego[head.index("TensoRF")] == "36.46 (36.49 in 10 min 1 s)"
    assert lego[head.index("nerfacto")] == "(31.37 in 9 min 44 s)"
    assert fern[head.index("NeRF")] == "25.17"


def test_a_plot_has_a_panel_per_scene(tmp_path: Path):
    rows = [ours("llff", "fern", 60.0), ours("llff", "fern", 300.0), ours("llff", "room", 60.0, method="vanilla")]
    assert draw("blender", rows, tmp_path) is None
    file = draw("llff", rows, tmp_path)
    assert file is not None
    with Image.open(file) as drawn:
        assert drawn.width > 1.5 * drawn.height
        assert len(np.unique(np.asarray(drawn.convert("L")))) > 20


def test_rows_of_a_file_are_kept(tmp_path: Path):
    out = tmp_path / "published.json"
    assert earlier(out) == earlier(None) == []
    Record(out).add(**ours("llff", "fern", 60.0))
    assert [tuple(row[name] for name in KEY) for row in earlier(out)] == [("llff", "fern", "grid", 60.0)]


def test_lpips_needs_weights_at_hand(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert load_lpips() is None
    assert mean_lpips(tmp_path, tmp_path, scene_of(1, 1), None) is None


def test_lpips_compares_renders_with_photos_over_their_background(tmp_path: Path):
    photo(tmp_path / "images" / "1.png", (16, 16), (0, 0, 0, 0))
    photo(tmp_path / "images" / "2.png", (16, 16), (0, 0, 0, 255))
    photo(tmp_path / "images" / "3.png", (16, 16), (0, 0, 0))
    photo(tmp_path / "images" / "4.png", (16, 16), (0, 0, 0))
    Image.new("L", (16, 16)).save(tmp_path / "mask.png")
    for name in "1234":
        photo(tmp_path / "renders" / f"{name}.png", (8, 8), (255, 255, 255))
    write_json(tmp_path / "metrics.json", {"background": [1.0, 1.0, 1.0]})
    scene = scene_of(1, 4, (16, 16))
    views = (*scene.views[:4], replace(scene.views[4], alpha="mask.png"))

    def distance(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        assert first.shape == second.shape == (1, 3, 8, 8)
        return (first - second).abs().mean() / 2

    assert mean_lpips(tmp_path, tmp_path, replace(scene, views=views, has_alpha=True), distance) == 0.5
