"""Scoring against fields and photos known in closed form, and what happens at the edges."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from nerf.effects.exposure import expose
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages import evaluate
from stages.evaluate import affordable
from stages.io.files import write_json, write_png
from tests.refusals import refused

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
WAVES = np.array([[5.0, 2.0, 3.0], [-4.0, 6.0, 1.0], [2.0, -3.0, 7.0]])


def sky(directions: np.ndarray) -> np.ndarray:
    """A world that is all sky: colour by direction alone, within [0.2, 0.8]."""
    return 0.5 + 0.3 * np.sin(directions @ WAVES.T)


class SkyField:
    """The sky as a field, off by ``error`` in every channel; with ``half`` the side x < 0 is empty."""

    chunk_rays = 64

    def __init__(self, error: float = 0, half: bool = False) -> None:
        self.error, self.half = error, half

    def density(self, points: Tensor) -> Tensor:
        return torch.zeros_like(points[..., 0])

    def density_and_colour(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        return self.density(points), torch.from_numpy(sky(directions.double().numpy())) + self.error

    def render(self, rays: Rays, background: Tensor) -> Rendering:
        directions = rays.directions.double()
        _, colour = self.density_and_colour(rays.origins, directions)
        opacity = (directions[:, 0] >= 0).double() if self.half else torch.ones(len(directions))
        shown = opacity[:, None] * colour + (1 - opacity[:, None]) * background
        return Rendering(shown.float(), rays.far, opacity.float())


def _view(index: int, name: str, split: Any) -> View:
    """Cameras on a circle, looking outward."""
    angle = 0.25 * index
    forward, down = np.array([math.cos(angle), math.sin(angle), 0]), np.array([0.0, 0.0, -1.0])
    pose = np.stack([np.cross(down, forward), down, forward, 0.3 * forward], axis=1)
    return View(name, f"images/{Path(name).stem}.png", 0, pose, 0.1, 4.0, split)


def _photo(view: View, alpha: bool) -> Image.Image:
    """What a pinhole camera sees of the sky, computed from scratch."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    ray_directions = np.stack([x, y, np.full_like(x, FOCAL)], -1)
    directions = (
        ray_directions / np.linalg.norm(ray_directions, axis=-1, keepdims=True) @ view.scene_from_camera[:, :3].T
    )
    pixels = np.rint(255 * sky(directions))
    if alpha:
        covered = directions[..., :1] >= 0
        pixels = np.concatenate([np.where(covered, pixels, 0), 255 * covered], axis=-1)
    return Image.fromarray(pixels.astype(np.uint8))


Make = Callable[..., dict[str, Path]]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Finished folders for a scene of the sky and a field of it."""

    def build(
        field: SkyField | None = None, *, tests: int = 4, speed: int = 10**9, downscale: float = 1, alpha: bool = False
    ) -> dict[str, Path]:
        inputs = {stage: tmp_path / stage for stage in evaluate.INPUTS}
        for folder in inputs.values():
            folder.mkdir()
        (inputs["ingest"] / "images").mkdir()
        views = [_view(i, f"{i:03d}.jpg", "test" if i % 3 == 1 and i // 3 < tests else "train") for i in range(15)]
        for view in views:
            _photo(view, alpha).save(inputs["ingest"] / view.file)
        camera = Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (FOCAL, WIDTH / 2, HEIGHT / 2))
        identity = Similarity(1.0, np.eye(3), np.zeros(3))
        scene = Scene((camera,), tuple(views), identity, False, alpha, "inside", True)
        write_json(inputs["normalise"] / "scene.json", scene.to_json())
        info = {"kind": "sky", "downscale": downscale, "background": [0.0, 0.0, 0.0], "effects": {}}
        write_json(inputs["train"] / "field.json", info)
        write_json(inputs["train"] / "curve.json", {"points": [{"seconds": 2.0}]})
        monkeypatch.setattr("stages.render.renderer.Renderer.rays_per_second", lambda *_: speed)
        monkeypatch.setattr("stages.render.renderer.compute_device", lambda: "cpu")
        monkeypatch.setattr("stages.render.renderer.load_field", lambda *_: (field or SkyField(), info))
        return inputs

    return build


def _run(inputs: dict[str, Path], folder: Path, progress: Any, **settings: Any) -> tuple[dict[str, Any], str]:
    folder.mkdir()
    result = evaluate.run(evaluate.Config(**settings), inputs, folder, progress)
    return json.loads((folder / "metrics.json").read_text("utf-8")), result.line


def test_a_perfect_field_is_sharp_and_beats_both_trivial_predictions(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(), tmp_path / "out", progress)
    assert 50 < metrics["psnr"] < 65  # the photos are rounded to 8 bits: 59 dB
    assert 0.99 < metrics["ssim"] <= 1
    assert 5 < metrics["psnr_mean_image"] < 25 and 5 < metrics["psnr_nearest_view"] < 25
    assert metrics["verdict"].startswith("Sharp and trustworthy: 5")
    assert line.endswith("· 4 photos") and "nearest photo" in line
    assert progress.updates[-1] == ("test photo 4 of 4", 1.0)


@pytest.mark.parametrize("error", [0.05, 0.1])
def test_psnr_of_a_constant_error_is_its_closed_form(error: float, make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(SkyField(error)), tmp_path / "out", progress)
    assert metrics["psnr"] == pytest.approx(-20 * math.log10(error), abs=0.05)


def test_overall_figures_are_the_means_of_the_photos(make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(SkyField(0.1)), tmp_path / "out", progress)
    assert [image["name"] for image in metrics["images"]] == ["001.jpg", "004.jpg", "007.jpg", "010.jpg"]
    for key in set(evaluate.FIGURES) - {"psnr_pose_fitted"}:
        assert metrics[key] == pytest.approx(np.mean([image[key] for image in metrics["images"]]))
    assert metrics["psnr_pose_fitted"] is None and not metrics["poses_fitted"]
    low, high = metrics["psnr_interval"]
    assert low <= metrics["psnr"] <= high
    assert all(image["nearest_view"] not in ("001.jpg", "004.jpg") for image in metrics["images"])


def test_pictures_are_what_the_figures_say(make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(SkyField(0.1)), tmp_path / "out", progress)
    for image in metrics["images"]:
        render = np.asarray(Image.open(tmp_path / "out" / image["render"]), float) / 255
        error = np.asarray(Image.open(tmp_path / "out" / image["error"]))
        truth = np.asarray(Image.open(tmp_path / "ingest/images" / Path(image["render"]).name), float) / 255
        assert np.abs(render - truth - 0.1).max() < 0.01
        assert error.shape == (HEIGHT, WIDTH, 3) and error.std(axis=(0, 1)).max() < 8 < error.mean()


@pytest.mark.parametrize(("background", "empty"), [("white", 255), ("black", 0)])
def test_alpha_data_is_scored_over_the_background(
    background: str, empty: int, make: Make, tmp_path: Path, progress: Any
):
    inputs = make(SkyField(half=True), alpha=True)
    metrics, _ = _run(inputs, tmp_path / "out", progress, background=background)
    assert 50 < min(image["psnr"] for image in metrics["images"]) < 65  # photos that are all empty match exactly
    render = np.asarray(Image.open(tmp_path / "out" / metrics["images"][-1]["render"]))
    assert (render == empty).all(axis=-1).any()


def test_scores_at_the_size_the_field_was_trained_at(make: Make, tmp_path: Path, progress: Any):
    inputs = make(downscale=2)
    metrics, line = _run(inputs, tmp_path / "out", progress)
    assert metrics["width_share"] == 0.5 and line.endswith("· 4 photos at 50% width")
    assert Image.open(tmp_path / "out" / metrics["images"][0]["render"]).size == (16, 12)
    assert " dB on unseen photos at 50% of their width, " in metrics["verdict"]
    full, _ = _run(inputs, tmp_path / "full", progress, downscale=1)
    assert full["width_share"] == 1 and full["psnr"] > metrics["psnr"]


def masked(inputs: dict[str, Path], ignore: np.ndarray) -> dict[str, Path]:
    """Spoil every photo where ``ignore`` (H, W) is set, and give it a mask that says so."""
    scene = json.loads((inputs["normalise"] / "scene.json").read_text("utf-8"))
    for view in scene["views"]:
        pixels = np.array(Image.open(inputs["ingest"] / view["file"]))
        pixels[ignore] = 255 - pixels[ignore]
        Image.fromarray(pixels).save(inputs["ingest"] / view["file"])
        view["mask"] = f"masks/{Path(view['file']).name}.png"
        write_png(inputs["ingest"] / view["mask"], np.where(ignore, np.uint8(0), np.uint8(255)))
    write_json(inputs["normalise"] / "scene.json", scene)
    return inputs


def exposed(inputs: dict[str, Path], log_gain: float, noise: float) -> dict[str, Path]:
    """Take every photo again at that gain, with noise on top, the same for all gains."""
    random = np.random.default_rng(5)
    for file in sorted((inputs["ingest"] / "images").iterdir()):
        light = expose(torch.from_numpy(np.array(Image.open(file))) / 255, torch.full((3,), log_gain)).numpy()
        pixels = (light + noise * random.standard_normal(light.shape)).clip(0, 1)
        Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(file)
    return inputs


@pytest.mark.parametrize("stops", [-1.0, 0.5])
def test_a_test_photos_exposure_is_no_fault(stops: float, make: Make, tmp_path: Path, progress: Any):
    log_gain = stops * math.log(2)
    metrics, line = _run(exposed(make(), log_gain, 0.03), tmp_path / "out", progress)
    noise_alone = -20 * math.log10(0.03)
    assert metrics["psnr_exposure_fitted"] == pytest.approx(noise_alone, abs=0.1)
    assert metrics["psnr"] < noise_alone - 6 and metrics["psnr_right_half"] < noise_alone - 6
    right, fitted = metrics["psnr_right_half"], metrics["psnr_exposure_fitted"]
    words = f"right halves {right:.1f} dB, {fitted:.1f} dB with its exposure fitted on the left half · nearest photo"
    assert words in line and line.startswith(f"{metrics['psnr']:.1f} ± ")
    assert f"{metrics['psnr']:.1f} dB" in metrics["verdict"], "the verdict keeps the raw score"


def test_without_a_gain_both_scores_of_right_halves_agree(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(exposed(make(), 0.0, 0.03), tmp_path / "out", progress)
    assert metrics["psnr_exposure_fitted"] == pytest.approx(metrics["psnr_right_half"], abs=0.05)
    assert metrics["psnr_right_half"] == pytest.approx(metrics["psnr"], abs=0.3)
    assert "right" not in line and metrics["psnr_exposure_fitted"] != metrics["psnr_right_half"]


def test_masks_count_in_the_scores_of_right_halves(make: Make, tmp_path: Path, progress: Any):
    ignore = np.zeros((HEIGHT, WIDTH), bool)
    ignore[:, 4:9] = ignore[:14, 20:] = True
    metrics, _ = _run(masked(make(), ignore), tmp_path / "out", progress)
    assert min(image["psnr_exposure_fitted"] for image in metrics["images"]) > 50
    ignore[:, 4 : WIDTH // 2] = True  # 96 pixels of the left half are left
    ignore[:10, :4] = True  # 56
    metrics, line = _run(masked(make_again(tmp_path), ignore), tmp_path / "narrow", progress)
    assert all(metrics[key] is None for key in ("psnr_right_half", "psnr_exposure_fitted")) and metrics["psnr"] > 25
    assert "a half of 4 photos has too few pixels to fit an exposure on or to score with it" in metrics["notes"]
    assert "right" not in line


def make_again(folder: Path) -> dict[str, Path]:
    """The folders that were made before."""
    return {stage: folder / stage for stage in evaluate.INPUTS}


def test_what_masks_ignore_does_not_count(make: Make, tmp_path: Path, progress: Any):
    ignore = np.zeros((HEIGHT, WIDTH), bool)
    ignore[:, 20:] = True
    metrics, _ = _run(masked(make(SkyField(0.1)), ignore), tmp_path / "out", progress)
    for image in metrics["images"]:
        assert image["psnr"] == pytest.approx(20, abs=0.05)  # the error is 0.1 wherever it counts
        error = np.asarray(Image.open(tmp_path / "out" / image["error"]))
        assert (error[:, 20:] == error[0, -1]).all() and (error[:, :20] != error[0, -1]).any(-1).all()
        render = np.asarray(Image.open(tmp_path / "out" / image["render"]))
        assert render[:, 20:].std() > 10  # the picture itself is whole
    assert metrics["psnr_mean_image"] < 25 and metrics["ssim"] > 0.5


def test_a_fully_masked_photo_is_not_scored(make: Make, tmp_path: Path, progress: Any):
    inputs = masked(make(downscale=2), np.zeros((HEIGHT, WIDTH), bool))
    dot = np.zeros((HEIGHT, WIDTH), np.uint8)
    dot[3, 3] = 255
    write_png(inputs["ingest"] / "masks/004.png.png", dot)
    metrics, line = _run(inputs, tmp_path / "out", progress)
    assert [image["name"] for image in metrics["images"]] == ["001.jpg", "007.jpg", "010.jpg"]
    assert progress.notes == ["masks leave nothing to compare of 1 photo at this size"] == metrics["notes"][:1]
    assert line.endswith("· 3 of 4 photos at 50% width")


def test_masks_that_leave_nothing_of_any_test_photo_are_named(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(masked(make(), np.ones((HEIGHT, WIDTH), bool)), tmp_path / "out", progress)
    why = "masks leave nothing of the test photos looked at"
    assert metrics["verdict"] == f"Not measured: {why}." and line == f"nothing measured: {why}"
    assert metrics["notes"][:2] == [
        "masks leave nothing to compare of 4 photos at this size",
        f"{why}, so nothing is measured",
    ]


def test_a_slow_field_is_scored_on_fewer_photos(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(speed=5 * WIDTH * HEIGHT), tmp_path / "out", progress)
    words = "3 of 4 test photos are scored, evenly spread"
    assert progress.notes == [
        "3.8 k rays/s here: all 4 test photos take about 0.8 s, training took 2 s; --evaluate.photos asks for more",
        words,
    ]
    assert metrics["notes"][0] == words
    assert (metrics["photos_scored"], metrics["photos_test"], len(metrics["images"])) == (3, 4, 3)
    assert line.endswith("· 3 of 4 photos")


def test_photos_asked_for_are_scored_whatever_they_take(make: Make, tmp_path: Path, progress: Any):
    inputs = make(speed=1)
    assert _run(inputs, tmp_path / "two", progress, photos=2)[0]["photos_scored"] == 2
    assert _run(inputs, tmp_path / "all", progress, photos=99)[0]["photos_scored"] == 4


def test_a_photo_too_large_for_the_time_is_scored_smaller(make: Make, progress: Any, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(evaluate, "MIN_SIDE", 4)
    monkeypatch.setattr("stages.render.renderer.Allowance.left", lambda _: 2.0)
    inputs = make(speed=WIDTH * HEIGHT // 32)  # a photo takes 32 seconds

    def downscale(**asked: Any) -> float | None:
        return evaluate.plan(evaluate.Config(seconds=2, **asked), inputs, progress).downscale

    assert downscale() == 4
    assert "it is scored at 25% of its width; --evaluate.downscale 1 asks for more" in progress.notes[-1]
    assert downscale(downscale=1) == 1, "as asked"
    monkeypatch.setattr(evaluate, "MIN_SIDE", WIDTH / 3)
    assert downscale() == 3, "no smaller than can be judged"
    monkeypatch.setattr(evaluate, "READING", 30 / 15 + 0.01)
    assert downscale() == 1, "reading fifteen photos at another size takes as long"


def test_plan_answers_every_open_question_once(make: Make, progress: Any):
    inputs = make(downscale=1.5, speed=1)
    planned = evaluate.plan(evaluate.Config(), inputs, progress)
    assert (planned.downscale, planned.photos) == (1.5, 1)
    assert evaluate.plan(planned, inputs, progress) == planned
    assert len(progress.notes) == 1


def test_two_photos_give_no_interval_and_no_trust(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(tests=2), tmp_path / "out", progress)
    assert metrics["psnr_interval"] is None and "±" not in line
    assert metrics["notes"][0] == "no interval: 2 photos cannot show how much the figures vary"
    assert metrics["verdict"].startswith("Sharp, as far as 2 photos can tell: ")


def test_without_test_photos_nothing_is_measured_and_nothing_fails(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(tests=0), tmp_path / "out", progress)
    assert all(metrics[key] is None for key in (*evaluate.FIGURES, "psnr_interval", "ssim_interval"))
    assert metrics["images"] == [] and metrics["verdict"] == "Not measured: no photo was kept for testing."
    assert metrics["notes"][0] == "no photo was kept for testing, so nothing is measured"
    assert line == "nothing measured: no photo was kept for testing"
    assert (tmp_path / "out/renders").is_dir()


def test_the_same_inputs_give_the_same_bytes(make: Make, tmp_path: Path, progress: Any):
    inputs = make(SkyField(0.03))
    _run(inputs, tmp_path / "a", progress)
    _run(inputs, tmp_path / "b", progress)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 1 + 2 * 4
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_lpips_is_named_as_missing(make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(), tmp_path / "out", progress)
    assert metrics["lpips"] is None
    assert metrics["notes"][-1].startswith("LPIPS is not computed: ")


@given(st.lists(st.integers(1, 100), max_size=12), st.integers(1, 1000))
def test_affordable_is_the_largest_even_choice_within_the_budget(pixels: list[int], budget: int):
    chosen = affordable(pixels, budget)
    assert chosen == sorted(set(chosen)) and all(0 <= i < len(pixels) for i in chosen)
    if sum(pixels) <= budget:
        assert chosen == list(range(len(pixels)))
    assert sum(pixels[i] for i in chosen) <= budget or len(chosen) == 1
    assert bool(chosen) == bool(pixels)
    if len(chosen) > 1:
        gaps = np.diff([-0.5, *chosen, len(pixels) - 0.5])
        assert gaps[1:-1].max() - gaps[1:-1].min() <= 1


def test_poses_need_gradients_of_rays(make: Make, tmp_path: Path, progress: Any) -> None:
    inputs = make()
    with refused("evaluate.no-pose-fit", "sky"):
        _run(inputs, tmp_path / "on", progress, fit_poses="on")
    metrics, _ = _run(inputs, tmp_path / "auto", progress)
    assert metrics["psnr_pose_fitted"] is None and not metrics["poses_fitted"]


@pytest.mark.parametrize(("seconds", "count"), [(0.9, 1), (2.9, 2), (5.0, 4), (0.01, 1)])
def test_seconds_given_bound_the_photos_whatever_training_took(make: Make, progress: Any, seconds: float, count: int):
    inputs = make(speed=WIDTH * HEIGHT)  # a photo a second; reading fifteen takes 0.75 of them
    planned = evaluate.plan(evaluate.Config(seconds=seconds), inputs, progress)
    assert planned.photos == count
    assert not progress.notes or f", given {seconds:g} s, of which" in progress.notes[0].replace("0 s", "0.01 s")
