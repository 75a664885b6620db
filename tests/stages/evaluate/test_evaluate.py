"""Scoring against fields and photos known in closed form, and what happens at the edges."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from nerf.effects.exposure import expose
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages import evaluate
from stages.contract import run_stage
from stages.evaluate import planning, seconds
from stages.evaluate.image_metrics import ssim
from stages.evaluate.summary import FIGURES
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


def _photo(view: View, alpha: bool, scale: int) -> Image.Image:
    """What a pinhole camera sees of the sky, computed from scratch; so many times larger."""
    width, height = scale * WIDTH, scale * HEIGHT
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    ray_directions = np.stack([x, y, np.full_like(x, scale * FOCAL)], -1)
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
        field: SkyField | None = None,
        *,
        photos: int = 15,
        tests: int = 4,
        speed: int = 10**9,
        downscale: float = 1,
        alpha: bool = False,
        scale: int = 1,
    ) -> dict[str, Path]:
        inputs = {stage: tmp_path / stage for stage in evaluate.STAGE.inputs}
        for folder in inputs.values():
            folder.mkdir()
        (inputs["ingest"] / "images").mkdir()
        views = [_view(i, f"{i:03d}.jpg", "test" if i % 3 == 1 and i // 3 < tests else "train") for i in range(photos)]
        for view in views:
            _photo(view, alpha, scale).save(inputs["ingest"] / view.file)
        width, height = scale * WIDTH, scale * HEIGHT
        camera = Camera("SIMPLE_PINHOLE", width, height, (scale * FOCAL, width / 2, height / 2))
        identity = Similarity(1.0, np.eye(3), np.zeros(3))
        scene = Scene((camera,), tuple(views), identity, False, alpha, "inside-out", True)
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
    result = run_stage(evaluate.STAGE, evaluate.Config(**settings), inputs, folder, progress)
    return json.loads((folder / "metrics.json").read_text("utf-8")), result.line


def test_a_perfect_field_is_sharp_and_beats_both_trivial_predictions(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(), tmp_path / "out", progress)
    assert 50 < metrics["psnr"] < 65  # the photos are rounded to 8 bits: 59 dB
    assert 0.99 < metrics["ssim"] <= 1
    assert 5 < metrics["psnr_mean_image"] < 25 and 5 < metrics["psnr_nearest_view"] < 25
    assert metrics["verdict"].startswith("Sharp and trustworthy: 5")
    assert line.endswith("· 4 photos at 32 × 24") and "nearest training view" in line
    assert progress.updates[-1] == ("test photo 4 of 4", 1.0)


@pytest.mark.parametrize("error", [0.05, 0.1])
def test_psnr_of_a_constant_error_is_its_closed_form(error: float, make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(SkyField(error)), tmp_path / "out", progress)
    assert metrics["psnr"] == pytest.approx(-20 * math.log10(error), abs=0.05)


def test_overall_figures_are_the_means_of_the_photos(make: Make, tmp_path: Path, progress: Any):
    metrics, _ = _run(make(SkyField(0.1)), tmp_path / "out", progress)
    assert [image["name"] for image in metrics["images"]] == ["001.jpg", "004.jpg", "007.jpg", "010.jpg"]
    for key in set(FIGURES) - {"psnr_pose_fitted"}:
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


def test_photos_are_scored_at_their_own_size_whatever_was_trained(make: Make, tmp_path: Path, progress: Any):
    inputs = make(NoisyField(0.05), downscale=2)
    metrics, line = _run(inputs, tmp_path / "out", progress)
    assert line.endswith("· 4 photos at 32 × 24 (trained at 16 × 12)")
    assert " dB on 4 test photos at 32 × 24 (trained at 16 × 12), " in metrics["verdict"]
    assert (metrics["photo_size"], metrics["scored_size"], metrics["trained_size"]) == ([32, 24], [32, 24], [16, 12])
    for image in metrics["images"]:
        render, truth = (
            torch.from_numpy(np.array(Image.open(file))) / 255
            for file in (tmp_path / "out" / image["render"], inputs["ingest"] / "images" / Path(image["render"]).name)
        )
        direct = -10 * math.log10(float((render - truth).square().mean()))
        assert image["psnr"] == pytest.approx(direct, abs=0.01), "renders are rounded to 8 bits"
        assert image["ssim"] == pytest.approx(ssim(render, truth), abs=1e-3)
    smaller, line = _run(inputs, tmp_path / "smaller", progress, downscale=2)
    assert smaller["scored_size"] == [16, 12] and line.endswith("· 4 photos at 16 × 12")
    assert smaller["psnr"] != metrics["psnr"]


def test_large_photos_are_scored_at_1600_pixels(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(photos=5, scale=54), tmp_path / "out", progress, fraction=0.01)
    assert (metrics["photo_size"], metrics["scored_size"]) == ([1728, 1296], [1600, 1200])
    assert line.endswith("2 photos at 1600 × 1200 (trained at 1728 × 1296)")


class NoisyField(SkyField):
    """The sky with errors that differ from place to place: a tenth of the directions are off by half of white."""

    def render(self, rays: Rays, background: Tensor) -> Rendering:
        rendering = super().render(rays, background)
        waves = torch.sin(40 * rays.directions[:, :1]) * torch.sin(40 * rays.directions[:, 2:])
        return rendering._replace(colour=rendering.colour + torch.where(waves > 0.8, 0.5, 0.02 * waves))


def test_short_time_means_tiles_of_every_photo(make: Make, tmp_path: Path, progress: Any):
    inputs = make(NoisyField(), scale=10, downscale=2)  # 320 × 240: 300 tiles
    whole, _ = _run(inputs, tmp_path / "whole", progress, fraction=1)
    metrics, line = _run(inputs, tmp_path / "tiles", progress, fraction=0.25)
    assert (metrics["fraction"], metrics["photos_scored"], metrics["photos_test"]) == (0.25, 4, 4)
    assert " dB on 25% of each of 4 test photos at 320 × 240 (trained at 160 × 120), " in metrics["verdict"]
    assert line.endswith(" · 25% of each of 4 photos at 320 × 240 (trained at 160 × 120)")
    for image, of_all in zip(metrics["images"], whole["images"], strict=True):
        assert image["name"] == of_all["name"]
        assert 0 < abs(image["psnr"] - of_all["psnr"]) < 1.5 and 0 < abs(image["ssim"] - of_all["ssim"]) < 0.05
        assert abs(image["psnr_nearest_view"] - of_all["psnr_nearest_view"]) < 1
        assert abs(image["psnr_right_half"] - of_all["psnr_right_half"]) < 2
    assert metrics["psnr"] == pytest.approx(whole["psnr"], abs=0.6)
    assert metrics["ssim"] == pytest.approx(whole["ssim"], abs=0.02)
    low, high = metrics["psnr_interval"]
    assert low < whole["psnr"] < high


def test_pictures_of_photos_scored_in_tiles_are_whole_and_smaller(make: Make, tmp_path: Path, progress: Any):
    inputs = make(SkyField(0.1), scale=10)
    metrics, _ = _run(inputs, tmp_path / "tiles", progress, fraction=0.25)
    assert metrics["psnr"] == pytest.approx(20, abs=0.05)
    for image in metrics["images"]:
        render = Image.open(tmp_path / "tiles" / image["render"])
        truth = Image.open(inputs["ingest"] / "images" / Path(image["render"]).name).resize(
            render.size, Image.Resampling.BOX
        )
        assert render.size == Image.open(tmp_path / "tiles" / image["error"]).size == (80, 60)
        assert np.abs(np.asarray(render, float) - np.asarray(truth, float) - 25.5).max() < 8


def test_tiles_leave_out_what_masks_ignore(make: Make, tmp_path: Path, progress: Any):
    ignore = np.zeros((240, 320), bool)
    ignore[:, :250] = True
    metrics, _ = _run(masked(make(SkyField(0.1), scale=10), ignore), tmp_path / "out", progress, fraction=0.1)
    assert metrics["psnr"] == pytest.approx(20, abs=0.05), "the error is 0.1 wherever it counts"
    assert metrics["photos_scored"] == 4 and metrics["ssim"] is not None


def test_the_fraction_scored_is_what_there_is_time_for(make: Make, tmp_path: Path, progress: Any):
    pixels = 4 * 320 * 240
    inputs = make(scale=10, speed=pixels // 10)  # all take ten seconds

    def fraction(**asked: Any) -> float | None:
        return evaluate.plan(evaluate.Config(**asked), inputs, progress).fraction

    assert fraction() == pytest.approx(seconds.MIN_RENDERING / 10 / 1.25, abs=0.03)
    assert progress.names("evaluate.some-pixels", " 4 test photos is")
    assert fraction(seconds=20.0) == 1 and len(progress.notes) == 1
    assert 0.08 < fraction(seconds=4.0) < 0.2  # type: ignore[operator]
    assert 0.03 < fraction(seconds=0.1) < 0.045  # type: ignore[operator] # half a second in any case
    assert fraction(seconds=0.1, fraction=1.0) == 1, "as asked"


@pytest.mark.parametrize(
    ("affordable", "fraction"), [(1.2, 1), (0.99, 0.79), (0.125, 0.1), (0.0626, 0.05), (1e-4, 8e-5)]
)
def test_a_fraction_is_rounded_down(affordable: float, fraction: float):
    assert planning._rounded_down(affordable, 1.25) == pytest.approx(fraction)


def test_plan_answers_every_open_question_once(make: Make, progress: Any):
    inputs = make(downscale=1.5, speed=1)
    planned = evaluate.plan(evaluate.Config(), inputs, progress)
    assert planned.fraction and planned.downscale is None
    assert evaluate.plan(planned, inputs, progress) == planned
    assert len(progress.notes) == 1


def test_a_scene_without_test_photos_has_nothing_to_plan(make: Make, progress: Any):
    assert evaluate.plan(evaluate.Config(), make(tests=0), progress).fraction == 1


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
    words = f"right halves {right:.1f} dB, {fitted:.1f} dB with the exposure fitted on the left half · nearest "
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
    assert "evaluate.small-halves" in codes(metrics)
    assert "right" not in line


def codes(metrics: dict[str, Any]) -> list[str]:
    return [note["code"] for note in metrics["notes"]]


def make_again(folder: Path) -> dict[str, Path]:
    """The folders that were made before."""
    return {stage: folder / stage for stage in evaluate.STAGE.inputs}


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
    metrics, line = _run(inputs, tmp_path / "out", progress, downscale=2)
    assert [image["name"] for image in metrics["images"]] == ["001.jpg", "007.jpg", "010.jpg"]
    assert progress.codes == ["evaluate.masked"] == codes(metrics)[:1] and "1 photo" in progress.notes[0]
    assert line.endswith("· 3 of 4 photos at 16 × 12")


def test_masks_that_leave_nothing_of_any_test_photo_are_named(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(masked(make(), np.ones((HEIGHT, WIDTH), bool)), tmp_path / "out", progress)
    why = "masks leave nothing of the test photos"
    assert metrics["verdict"] == f"Not measured: {why}." and line == f"nothing measured: {why}"
    assert codes(metrics)[:2] == ["evaluate.masked", "evaluate.nothing-measured"]


def test_two_photos_give_no_interval_and_no_trust(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(tests=2), tmp_path / "out", progress)
    assert metrics["psnr_interval"] is None and "±" not in line
    assert codes(metrics)[0] == "evaluate.no-interval"
    assert metrics["verdict"].startswith("Sharp, as far as 2 photos can tell: ")


def test_without_test_photos_nothing_is_measured_and_nothing_fails(make: Make, tmp_path: Path, progress: Any):
    metrics, line = _run(make(tests=0), tmp_path / "out", progress)
    assert all(metrics[key] is None for key in (*FIGURES, "psnr_interval", "ssim_interval"))
    assert metrics["images"] == [] and metrics["verdict"] == "Not measured: no photo was kept for testing."
    assert codes(metrics)[0] == "evaluate.nothing-measured"
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
    assert codes(metrics)[-1] == "evaluate.no-lpips"


def test_poses_need_gradients_of_rays(make: Make, tmp_path: Path, progress: Any) -> None:
    inputs = make()
    with refused("evaluate.no-pose-fit", "sky"):
        _run(inputs, tmp_path / "on", progress, fit_poses="on")
    metrics, _ = _run(inputs, tmp_path / "auto", progress)
    assert metrics["psnr_pose_fitted"] is None and not metrics["poses_fitted"]
