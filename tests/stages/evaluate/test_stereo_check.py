"""Walls whose depth maps are stereo's own, and fields of these walls that are right, or wrong in a known way."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from nerf import REGION_HALF_SIZE
from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps import Box, Contraction, SpaceMap
from nerf.kernels import torch as reference
from stages import depth, evaluate
from stages.contract import Inputs, StageResult, run_stage
from stages.depth.files import depth_map_file, read_depth_map
from stages.evaluate import stereo_check
from stages.evaluate.stereo_check import FARTHER, GAP, NEARER, Compared, Known, StereoCheck, check
from stages.io.files import read_scene, write_json
from stages.render.renderer import Renderer
from tests.conftest import RecordedProgress
from tests.nerf.hash_grid_fields import SMALL
from tests.stages.depth.walls import Wall, WallScene, cameras_before, wall

BACK, FRONT = wall((0, 1.0, 0), (3, 2), 10, seed=1), wall((0.1, -0.3, 0), (0.35, 0.3), -10, seed=2)
FLOATER = wall((0.4, -1.5, 0), (0.15, 0.15))
POSES = cameras_before()
DOWNSCALE = 1.5


def shifted_back(by: float) -> Wall:
    """The wall behind, 3.5 away from the cameras, farther away."""
    return BACK._replace(centre=BACK.centre + np.array([0, by, 0]))


class WallField:
    """Walls as a field: opaque, and nothing beside them."""

    chunk_rays = 4096

    def __init__(self, *walls: Wall) -> None:
        self.walls = WallScene(walls, POSES)

    def density(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def density_and_colour(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def render(self, rays: Rays, background: Tensor) -> Rendering:
        origins, directions = (part.double().numpy()[None] for part in rays[:2])
        grey, distance = (torch.from_numpy(part[0]).float() for part in self.walls._solid(origins, directions))
        hit = distance.isfinite()
        return Rendering(grey[:, None].expand(-1, 3), torch.where(hit, distance, rays.far), hit.float())


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Five training photos and a test photo, and what stereo makes of them."""
    folder = tmp_path_factory.mktemp("walls")
    made = WallScene([BACK, FRONT], POSES).write(folder, test_every=6) | {"depth": folder / "depth"}
    made["depth"].mkdir()
    depth.run(depth.Config(downscale=DOWNSCALE), made, made["depth"], RecordedProgress())
    return made


Check = Callable[..., dict[str, Any]]


@pytest.fixture
def checked(inputs: Inputs, tmp_path: Path) -> Check:
    def of_walls(*walls: Wall, seconds: float = 1000.0) -> dict[str, Any]:
        renderer = Renderer(WallField(*walls), torch.zeros(3))
        scene = read_scene(inputs["normalise"])
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        written = check(scene, inputs, renderer, seconds, folder, RecordedProgress())
        assert json.loads((folder / "stereo_check.json").read_text("utf-8")) == written
        return written

    return of_walls


def true_share(walls: Sequence[Wall], inputs: Inputs, view: int) -> float:
    """Of the pixels of a photo that stereo covers, at how many a field of ``walls`` is off by more than 3 %."""
    covered = read_depth_map(depth_map_file(inputs["depth"], f"images/{view:03d}.png")).distance
    height, width = covered.shape
    field = WallScene(walls, POSES).distances(view, width, height)
    known = covered > 0
    return float(np.mean(np.abs(field[known] / covered[known] - 1) > 0.03))


def test_a_right_field_agrees_with_stereo(checked: Check):
    result = checked(BACK, FRONT)
    assert (result["photos_compared"], result["photos_train"], len(result["images"])) == (5, 5, 5)
    assert result["pixels"] == 5 * 2048
    assert result["differ"] < 0.002 and result["median_difference"] < 0.003
    assert max(image["differ"] for image in result["images"]) < 0.005


def test_a_floater_is_nearer_in_photos_that_show_it(checked: Check, inputs: Inputs):
    result = checked(BACK, FRONT, FLOATER)
    shares = [true_share([BACK, FRONT, FLOATER], inputs, view) for view in range(5)]
    assert max(shares) > 0.03 and max(shares) > 1.2 * min(shares), "photos show more of it and less"
    for image, share in zip(result["images"], shares, strict=True):
        assert image["differ"] == pytest.approx(share, abs=0.015)
        assert image["nearer"] > 0.9 * image["differ"]
    assert result["differ"] == pytest.approx(np.mean(shares), abs=0.007)
    assert result["median_difference"] < 0.003, "of most pixels nothing has changed"
    assert result["worst"][0] == max(result["images"], key=lambda image: image["differ"])["name"]


def test_a_wall_that_is_shifted_back_is_farther(checked: Check, inputs: Inputs):
    shifted = shifted_back(0.35)
    result = checked(shifted, FRONT)
    assert result["differ"] == pytest.approx(
        np.mean([true_share([shifted, FRONT], inputs, view) for view in range(5)]), abs=0.01
    )
    assert result["differ"] > 0.6 and result["nearer"] < 0.002 and 0.08 < result["median_difference"] < 0.12
    assert checked(shifted_back(0.05), FRONT)["differ"] < 0.02


def test_pictures_show_where_they_differ(checked: Check, inputs: Inputs, tmp_path: Path):
    result = checked(shifted_back(0.35), FRONT, FLOATER)
    shown = [image for image in result["images"] if "picture" in image]
    assert sorted(image["name"] for image in shown) == sorted(result["worst"]) and len(shown) == stereo_check.SHOWN
    for image in shown:
        pixels = np.asarray(Image.open(tmp_path / "0" / image["picture"]))
        assert pixels.shape == (2 * 120 + GAP, 2 * 160 + GAP, 3), "panels have no more pixels than the depth map"
        photo, differs, stereo, field = (
            pixels[rows, columns] for rows in (np.s_[:120], np.s_[-120:]) for columns in (np.s_[:160], np.s_[-160:])
        )
        nearer, farther = ((differs == colour).all(-1) for colour in (NEARER, FARTHER))
        known = read_depth_map(depth_map_file(inputs["depth"], f"images/{image['name']}")).distance > 0
        assert nearer.sum() / known.sum() == pytest.approx(image["nearer"], abs=0.01)
        assert (nearer | farther).sum() / known.sum() == pytest.approx(image["differ"], abs=0.03)
        assert ((stereo == stereo_check.UNKNOWN).all(-1) == ~known).all()
        taken = Image.open(inputs["ingest"] / "images" / image["name"]).resize((160, 120), Image.Resampling.BOX)
        assert np.abs(photo.astype(float) - np.asarray(taken)).mean() < 8
        same = known & ~nearer & ~farther
        assert np.abs(stereo[same].astype(float) - field[same]).mean() < 10, "one scale for both depths"


def test_short_time_leaves_out_photos_and_says_so(checked: Check):
    result = checked(BACK, FRONT, seconds=1e-9)
    assert result["photos_compared"] == len(result["images"]) == 1 and result["pixels"] == 2048
    assert "1 of 5 training photos" in stereo_check.line_of(result)
    assert "training photos" not in stereo_check.line_of(checked(BACK, FRONT))


def test_what_rays_transmit_does_not_count(inputs: Inputs):
    distance, far = torch.tensor([[2.0, 2.0, 2.0]]), torch.full((1, 3), 100.0)
    opacity = torch.tensor([[1.0, 0.6, 0.4]])

    class Veil(WallField):
        def render(self, rays: Rays, background: Tensor) -> Rendering:
            return Rendering(torch.zeros(3, 3), (opacity * distance + (1 - opacity) * far)[0], opacity[0])

    rays = Rays(torch.zeros(1, 3, 3), torch.zeros(1, 3, 3), torch.zeros(1, 3), far)
    one = StereoCheck(
        read_scene(inputs["normalise"]), inputs["ingest"], inputs["depth"], Renderer(Veil(), torch.zeros(3))
    )
    seen = one.compare(Known(rays, distance, distance)).field
    assert seen[0].tolist() == pytest.approx([2.0, 2.0, 100.0], rel=1e-5), "more than half goes through: a hole"


def test_uncertain_stereo_allows_larger_differences():
    stereo, field = torch.tensor([1.0, 1.0, 1.0, 0.0]), torch.tensor([1.05, 1.05, 0.9, 7.0])
    compared = Compared(stereo, field, torch.tensor([0.03, 0.06, 0.06, 0.03]))
    assert compared.farther.tolist() == [True, False, False, False] and compared.nearer.tolist() == [0, 0, 1, 0]
    figures = compared.figures()
    assert (figures["pixels"], figures["differ"], figures["nearer"]) == (3, pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert figures["median_difference"] == pytest.approx(0.05)


@pytest.mark.parametrize("space", [Box(), Contraction()])
def test_what_lies_outside_a_box_is_not_compared(space: SpaceMap, inputs: Inputs):
    field = HashGridField(replace(SMALL, space=space), 5, reference)
    scene = read_scene(inputs["normalise"])
    view = scene.of_split("train")[0]
    one = StereoCheck(scene, inputs["ingest"], inputs["depth"], Renderer(field, torch.zeros(3)))
    known = one.sample(view, 0)
    whole = read_depth_map(depth_map_file(inputs["depth"], view.file)).distance
    beyond = 1.1 * (2.5 + REGION_HALF_SIZE)  # from a camera through the box and out of it
    behind = np.count_nonzero(whole > beyond) / np.count_nonzero(whole)
    assert behind > 0.1
    compared_behind = float((known.distance > beyond).float().mean())
    assert compared_behind == pytest.approx(behind if space.unbounded else 0, abs=0.04)


@pytest.fixture
def run(inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., StageResult]:
    """Run the whole stage on a right field."""
    info = {"kind": "walls", "downscale": 2.0, "background": [0.0, 0.0, 0.0], "effects": {}}
    train = tmp_path / "train"
    train.mkdir()
    write_json(train / "field.json", info)
    write_json(train / "curve.json", {"points": [{"seconds": 200.0}]})
    monkeypatch.setattr("stages.render.renderer.compute_device", lambda: "cpu")
    monkeypatch.setattr("stages.render.renderer.load_field", lambda *_: (WallField(BACK, FRONT), info))

    def of_stages(folder: Path, *stages: str) -> StageResult:
        folder.mkdir()
        given = {name: inputs[name] for name in stages} | {"train": train}
        return run_stage(evaluate.STAGE, evaluate.Config(), given, folder, RecordedProgress())

    return of_stages


def test_scores_are_the_same_with_depth_maps(run: Callable[..., StageResult], tmp_path: Path):
    without = run(tmp_path / "without", "ingest", "normalise")
    checked = run(tmp_path / "with", "ingest", "normalise", "depth")
    assert without.records == () and without.outputs == checked.outputs and without.facts == checked.facts
    assert set(checked.records) == {"stereo_check.json", "stereo_check"}
    assert checked.line.startswith(f"{without.line} · ")
    metrics = [(tmp_path / name / "metrics.json").read_bytes() for name in ("without", "with")]
    assert metrics[0] == metrics[1]
    assert [path.name for path in (tmp_path / "without").iterdir() if "stereo" in path.name] == []
