"""When test photos are scored at fitted poses, what is scored there, and that it is said."""

from pathlib import Path
from typing import Any

import pytest
import torch

from nerf.effects.appearance import AppearanceModel
from nerf.effects.exposure import ExposureModel
from nerf.effects.pose_refinement import PoseRefinement
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from pipeline.engine.display import SilentDisplay
from stages import evaluate
from stages.effects.decisions import Decisions
from stages.effects.image_effects import image_effects, learnt_effects, photo_effects
from stages.evaluate import scoring
from stages.evaluate.half_images import from_fitted_pose, right_half_psnr
from stages.evaluate.summary import RIGHT_HALVES, line_of
from stages.hardware.backend import chosen_backend, load_backend
from stages.render.renderer import Renderer
from stages.train.data import PhotoReader, training_dataset, view_rays
from tests.stages.photo_scene import photographed

METRICS: dict[str, Any] = {"psnr": 20.5, "psnr_interval": None, "ssim": 0.6, "psnr_nearest_view": 15.0} | {
    "psnr_mean_image": 12.0,
    "photos_scored": 2,
    "photos_test": 2,
    "fraction": 1,
    "scored_size": (64, 48),
    "trained_size": (64, 48),
}


def test_fitted_poses_are_scored_at_the_photos_exposure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, scene = photographed(tmp_path)
    kernels = load_backend(chosen_backend("cpu"), "cpu")
    field = HashGridField(
        HashGridSettings(num_levels=2, log2_hashmap_size=8, base_res=4, max_res=16, occupancy_resolution=8), 5, kernels
    )
    photos = {view.name: [0.7] * 3 for view in scene.of_split("train")}
    info = {"effects": {"exposure": photos}}
    view, given = scene.of_split("test")[0], []

    def fit(model: HashGridField, rays: Rays, rendering: Rendering, *others: Any) -> Rays:
        given.append((model, rendering.colour, others[-1]))
        return rays._replace(near=rays.near + 0.5)  # seen from elsewhere

    monkeypatch.setattr(scoring, "from_fitted_pose", fit)
    neutral = Renderer(AppearanceModel(field, (ExposureModel(torch.full((1, 3), 0.3)),)), torch.zeros(3))
    reader = PhotoReader(inputs["ingest"], scene, 1.0)
    scorer = scoring.Scorer(scene, inputs["ingest"], neutral, info, True, None, 1.0, reader, reader)
    scored = scoring.score(scorer, tmp_path, SilentDisplay(), lambda: scorer).images[0]
    rays = view_rays(scene, view, 1.0)
    exposed = neutral.through(photo_effects(info, scene, view))
    assert given[0][0] is field and torch.equal(given[0][1], exposed.render(rays).colour)
    assert [effect.rows.tolist() for effect in given[0][2]] == [[pytest.approx([0.7] * 3)]]
    truth = PhotoReader(inputs["ingest"], scene, 1.0).pixels(view, (0.0,) * 3)
    right, fitted = right_half_psnr(exposed.render(rays), torch.zeros(3), truth)
    _, posed = right_half_psnr(exposed.render(rays._replace(near=rays.near + 0.5)), torch.zeros(3), truth)
    assert scored["psnr_right_half"] == pytest.approx(right) and scored["psnr_exposure_fitted"] == pytest.approx(fitted)
    assert scored["psnr_pose_fitted"] == pytest.approx(posed)


def test_refined_poses_are_written_in_scene_units(tmp_path: Path) -> None:
    inputs, scene = photographed(tmp_path)
    views = scene.of_split("train")
    dataset = training_dataset(inputs["ingest"], scene, "train", 1.0, SilentDisplay())
    near = dataset._replace(sparse_pixels=dataset.first_pixel[:-1] + 5, sparse_depths=torch.full((len(views),), 0.25))
    effects = image_effects(Decisions({"pose_refinement": {}}), scene, views, near)
    effects.rays[0].parameters["offset"][1] = torch.tensor([1.0, 0.0, -2.0])
    learnt = learnt_effects(effects, views)["pose_refinement"]
    assert learnt[views[1].name] == [0.0, 0.0, 0.0, 0.25, 0.0, -0.5] and learnt[views[0].name] == [0.0] * 6


def test_a_test_pose_is_fitted_in_viewing_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def fit(*given: Any) -> PoseRefinement:
        asked.append(given[-1])
        return PoseRefinement(torch.zeros(1, 3))

    monkeypatch.setattr("stages.evaluate.half_images.fit_pose", fit)
    some, whole = torch.rand(8, 40, 3), torch.ones(8, 40)
    rays = Rays(some, some, whole, whole)
    field: Any = None
    from_fitted_pose(field, rays, Rendering(some, 0.25 * whole, whole), torch.zeros(3), some, None)
    assert asked == [0.25]


@pytest.mark.parametrize(
    ("asked", "refined", "fitted"),
    [("auto", True, True), ("auto", False, False), ("on", False, True), ("off", True, False)],
)
def test_poses_are_fitted_where_training_refined_them_or_as_asked(asked: Any, refined: bool, fitted: bool) -> None:
    field = {"kind": "grid", "effects": {"pose_refinement": {"a.jpg": [0.0] * 6}} if refined else {}}
    assert scoring.fits_poses(evaluate.Config(fit_poses=asked), field) is fitted


@pytest.mark.parametrize(
    ("scores", "words"),
    [
        ((20.0, 20.3, None), ""),
        ((20.0, 20.6, None), " · right halves 20.0 dB, 20.6 dB with the exposure fitted on the left half"),
        ((20.0, 20.3, 20.4), ""),
        (
            (20.0, 20.3, 24.0),
            " · right halves 20.0 dB, 20.3 dB with the exposure fitted on the left half, 24.0 dB with the pose, too",
        ),
        ((None, None, None), ""),
    ],
)
def test_the_line_names_what_was_fitted(scores: tuple[float | None, ...], words: str) -> None:
    fitted = dict(zip(RIGHT_HALVES, scores, strict=True))
    assert f"20.5 dB, SSIM 0.60{words} · nearest training view" in line_of(METRICS | fitted)
