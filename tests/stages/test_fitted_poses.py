"""When test photos are scored at fitted poses, what is scored there, and that it is said."""

from pathlib import Path
from typing import Any

import pytest
import torch

from nerf.effects.exposure import ExposedModel
from nerf.grid_field import GridField, GridSettings
from nerf.model import Rendering
from nerf.rays import Rays
from stages import evaluate
from stages.backend import chosen_backend, load_backend
from stages.drawing import Painter
from stages.evaluate import Examiner
from stages.right_halves import right_half_psnr
from stages.training_data import PhotoReader, view_rays
from tests.stages.photo_scene import photographed
from tests.synthetic_photos import Quiet


def test_poses_are_fitted_to_the_field_as_it_is_and_scored_as_the_photo_was_exposed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs, scene = photographed(tmp_path)
    kernels = load_backend(chosen_backend("cpu"), "cpu")
    field = GridField(GridSettings(levels=2, log2_rows=8, coarsest=4, finest=16, cache_cells=8), 5, kernels)
    plain, gain = Painter(field, torch.zeros(3)), torch.full((3,), 0.7)
    view, given = scene.of_split("test")[0], []

    def fit(model: GridField, rays: Rays, rendering: Rendering, *_: object) -> Rays:
        given.append((model, rendering.colour))
        return rays._replace(near=rays.near + 0.5)  # seen from elsewhere

    monkeypatch.setattr("stages.right_halves.from_fitted_pose", fit)
    neutral = Painter(ExposedModel(field, torch.full((3,), 0.3)), torch.zeros(3))
    examiner = Examiner(scene, inputs["ingest"], tmp_path, neutral, {view.name: gain}, True, 1.0)
    (scored,) = examiner.score([view], Quiet())
    rays = view_rays(scene, view, 1.0)
    assert given[0][0] is field and torch.equal(given[0][1], plain.draw(rays).colour)
    truth = PhotoReader(inputs["ingest"], scene, 1.0).pixels(view, (0.0,) * 3)
    exposed = neutral.at_gain(gain)
    right, fitted = right_half_psnr(exposed.draw(rays), torch.zeros(3), truth)
    _, posed = right_half_psnr(exposed.draw(rays._replace(near=rays.near + 0.5)), torch.zeros(3), truth)
    assert scored["psnr_right"] == pytest.approx(right) and scored["psnr_fitted_right"] == pytest.approx(fitted)
    assert scored["psnr_posed_right"] == pytest.approx(posed)


@pytest.mark.parametrize(
    ("asked", "refined", "fitted"),
    [("auto", True, True), ("auto", False, False), ("on", False, True), ("off", True, False)],
)
def test_poses_are_fitted_where_training_refined_them_or_as_asked(asked: Any, refined: bool, fitted: bool) -> None:
    field = {"kind": "grid"} | ({"poses": {"a.jpg": [0.0] * 6}} if refined else {})
    assert evaluate.fits_poses(evaluate.Config(fit_poses=asked), field) is fitted


@pytest.mark.parametrize(
    ("scores", "words"),
    [
        ((20.0, 20.3, None), ""),
        ((20.0, 20.6, None), " · right halves 20.0 dB, 20.6 dB with its exposure fitted on the left half"),
        ((20.0, 20.3, 20.4), ""),
        (
            (20.0, 20.3, 24.0),
            " · right halves 20.0 dB, 20.3 dB with its exposure fitted on the left half, 24.0 dB with its pose, too",
        ),
        ((None, None, None), ""),
    ],
)
def test_the_line_names_what_was_fitted_where_that_makes_a_difference(
    scores: tuple[float | None, ...], words: str
) -> None:
    assert evaluate._right_halves(dict(zip(evaluate.RIGHT_HALVES, scores, strict=True))) == words
