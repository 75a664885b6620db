"""Pilots on a synthetic scene: what they compare, and that they compare nothing else."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf.effects.exposure import expose
from nerf.effects.pose_refinement import PoseRefinement, fit_pose
from nerf.rendering.images import render_image
from pipeline.engine.display import SilentDisplay
from stages.effects import ab_runs
from stages.effects.ab_runs import Pilot, PilotScene, pilot_scene, run_pilot
from stages.effects.decisions import Decisions
from stages.effects.image_effects import held_out_images, photo_effects
from stages.io.files import read_scene
from stages.io.pixels import load_pixels
from tests.effect_scenes import Effects, effect_scene
from tests.stages.photo_scene import HEIGHT, WIDTH, photographed

PLAIN = Decisions({"view_dependence": {}})
REFINED = PLAIN.having("pose_refinement")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return effect_scene(tmp_path_factory.mktemp("scene"), Effects(alpha=True), views=14)


@pytest.fixture(scope="module")
def trial(inputs: dict[str, Path]) -> Iterator[PilotScene]:
    """A pilot's scene in photos of 60 × 45 pixels, for pilots of few samples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ab_runs, "LONG_SIDE", 60)
        patch.setattr(ab_runs, "TARGET_SAMPLES", 1 << 11)
        made = pilot_scene(inputs, read_scene(inputs["normalise"]), SilentDisplay())
        assert not isinstance(made, str), made
        yield made


def test_validation_photos_are_taken_from_the_training_photos_alone(trial: PilotScene, inputs: dict[str, Path]) -> None:
    given = read_scene(inputs["normalise"])
    trained, validation = ({view.name for view in trial.scene.of_split(split)} for split in ("train", "validation"))
    assert (
        validation
        and trained | validation == {view.name for view in given.of_split("train")}
        and not trained & validation
    )
    assert len(trial.validation) == len(validation) and len(trial.dataset.near) == len(trained)


def test_equal_arms_gain_exactly_nothing(trial: PilotScene) -> None:
    pilot = run_pilot(trial, PLAIN, PLAIN, 3, 0, SilentDisplay())
    assert (pilot.gain_db, pilot.noise_db, pilot.pays) == (0.0, 0.0, False)


def test_a_wrong_exposure_loses(trial: PilotScene) -> None:
    names = [view.name for view in trial.scene.of_split("train")]
    wrong = PLAIN.having("exposure", {name: [3.0 * (i % 2)] * 3 for i, name in enumerate(names)})
    pilot = run_pilot(trial, wrong, PLAIN, 40, 0, SilentDisplay())
    assert 0.5 < pilot.gain_db < 30 and pilot.pays


@pytest.mark.parametrize(
    ("off", "on", "fitted"),
    [
        (PLAIN, REFINED, True),
        (REFINED.without("view_dependence"), REFINED, True),
        (PLAIN.without("view_dependence"), PLAIN, False),
    ],
)
def test_validation_poses_are_fitted_wherever_poses_are_refined(
    trial: PilotScene, monkeypatch: pytest.MonkeyPatch, off: Decisions, on: Decisions, fitted: bool
) -> None:
    asked: list[bool] = []

    def score(_trained: object, _scene: object, _photo: object, poses: bool, _seed: int) -> float:
        asked.append(poses)
        return 20.0

    monkeypatch.setattr(ab_runs, "_trained", lambda *_: None)
    monkeypatch.setattr(ab_runs, "_score", score)
    run_pilot(trial, off, on, 1, 0, SilentDisplay())
    assert asked == [fitted] * (2 * ab_runs.SEEDS * len(trial.validation))


@pytest.mark.parametrize(
    ("default", "gains", "pairs"),
    [
        (False, (0.05, 0.5, 0.5), 1),
        (False, (0.5, -0.2, 0.5), 2),
        (False, (0.5, 0.4, 0.5), 3),
        (True, (0.5, -0.5, -0.5), 1),
        (True, (-0.5, -0.4, -0.5), 3),
        (None, (0.0, 0.0, 0.0), 3),
    ],
)
def test_a_pilot_ends_when_no_change_is_to_come(
    trial: PilotScene, monkeypatch: pytest.MonkeyPatch, default: bool | None, gains: tuple[float, ...], pairs: int
) -> None:
    runs = list[tuple[str, int]]()

    def trained(_trial: object, decisions: Decisions, steps: int, seed: int) -> tuple[str, int]:
        if steps > 1:  # not the warm-up
            runs.append(("on" if "exposure" in decisions.on else "off", seed))
        return ("on" if "exposure" in decisions.on else "off", seed)

    monkeypatch.setattr(ab_runs, "_trained", trained)
    monkeypatch.setattr(ab_runs, "_score", lambda run, *_: 20 + (gains[run[1]] if run[0] == "on" else 0))
    pilot = run_pilot(trial, PLAIN, PLAIN.having("exposure"), 2, 0, SilentDisplay(), default)
    assert sorted(runs) == sorted((run, seed) for run in ("on", "off") for seed in range(pairs))
    assert pilot.gain_db == pytest.approx(np.mean(gains[:pairs])) and pilot.seeds == pairs
    assert (pilot.pays, pilot.hurts) == (pairs == 3 and default is False, pairs == 3 and default is True)


def test_an_ended_pilot_would_have_proved_little() -> None:
    """Whatever the other seeds gain: of those that ended with the first one, none shows 0.2 dB."""
    others = np.arange(-1, 3, 0.01)
    first = np.full((len(others), len(others)), ab_runs.MIN_GAIN_DB)
    seeds = np.stack([first, *np.meshgrid(others, others)])
    mean, noise = seeds.mean(axis=0), 4.303 / 3**0.5 * seeds.std(axis=0, ddof=1)
    assert 0.15 < mean[mean > noise].max() < 0.2


def test_a_validation_image_is_rendered_thinly(
    inputs: dict[str, Path], trial: PilotScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert trial.validation[0].colours.shape == (45, 60, 3), "a small one whole"
    monkeypatch.setattr(ab_runs, "LONG_SIDE", 200)
    large = pilot_scene(inputs, read_scene(inputs["normalise"]), SilentDisplay())
    assert isinstance(large, PilotScene)
    photo = large.validation[0]
    assert max(photo.colours.shape[:2]) == ab_runs.SCORED_SIDE and photo.rays.near.shape == photo.colours.shape[:2]


@pytest.mark.parametrize(("device", "fit"), [("cpu", 0.02), ("cuda", 0.5)])
def test_pilots_are_predicted_by_steps_and_fitted_poses(
    inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, device: str, fit: float
) -> None:
    on = {"cpu": fit, "cuda": 0.02}  # seconds of a step
    monkeypatch.setattr(ab_runs, "compute_device", lambda: device)
    monkeypatch.setattr(ab_runs, "cores", lambda: 16)
    monkeypatch.setattr(ab_runs, "chosen_backend", lambda _device: "torch")
    monkeypatch.setattr(ab_runs, "seconds_per_step", lambda *given: on[given[-1]])
    scene = read_scene(inputs["normalise"])
    without, fitting = ab_runs.expected_seconds(scene, 100)
    assert without == pytest.approx(1.4 * 6 * 100 * 0.02)
    of_fits = 6 * 4 * ab_runs.STEPS_PER_FIT * 4 * fit  # of a step's four chunks each on one core
    assert fitting - without == pytest.approx(of_fits)


def test_too_few_photos_make_no_pilot(tmp_path: Path) -> None:
    made = {}
    for views in (5, 8, 10):
        inputs, scene = photographed(tmp_path / str(views), views=views)
        made[len(scene.of_split("train"))] = pilot_scene(inputs, scene, SilentDisplay())
    assert made[3] == made[6] == "too few training photos"
    assert isinstance(made[7], PilotScene) and len(made[7].validation) == 3


@pytest.mark.parametrize(
    ("left", "why"),
    [
        ((4, 4), "masks leave nothing of the training photos at 1/2 of their size"),
        ((slice(4, 8), slice(4, 8)), "too few training photos show enough at 1/2 of their size"),
    ],
    ids=["a dot", "a small square"],
)
def test_heavily_masked_photos_make_no_pilot(
    left: tuple, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ab_runs, "LONG_SIDE", WIDTH // 2)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[left] = 255
    inputs, scene = photographed(tmp_path, views=10, mask=mask)
    assert pilot_scene(inputs, scene, SilentDisplay()) == why


@pytest.mark.parametrize(
    ("gain", "noise", "pays"), [(1.0, 0.9, True), (1.0, 1.1, False), (0.05, 0.0, False), (-1.0, 0.1, False)]
)
def test_what_pays_is_more_than_noise_and_than_nothing(gain: float, noise: float, pays: bool) -> None:
    assert Pilot(gain, noise, 0.0).pays is pays


def test_noise_is_the_larger_of_seeds_and_photos() -> None:
    student = 4.303 / 3**0.5  # 97.5 % for three, over the root of how many
    assert ab_runs._noise([[1.0] * 3, [3.0] * 3, [2.0] * 3]) == pytest.approx(student, rel=1e-3)
    assert ab_runs._noise([[1.0, 5.0, 3.0]] * 3) == pytest.approx(2 * student, rel=1e-3)


def test_an_effect_that_gains_nothing_rarely_pays() -> None:
    draw = np.random.default_rng(0)
    paid = 0
    for _ in range(2000):
        gains = (draw.normal(size=(3, 1)) + 0.1 * draw.normal(size=(3, 3))).tolist()  # of three seeds, of three photos
        paid += Pilot(sum(map(sum, gains)) / 9, ab_runs._noise(gains), 0.0).pays
    assert 0.005 < paid / 2000 < 0.035


def test_a_photos_pose_is_found_against_a_finished_field(trial: PilotScene) -> None:
    field, photo = ab_runs._trained(trial, PLAIN, 150, 0).field, trial.validation[0]
    rays = type(photo.rays)(*(part.flatten(0, 1) for part in photo.rays))
    black, view = torch.zeros(3), torch.zeros(len(rays.near), dtype=torch.int64)
    target = render_image(field, photo.rays, black).colour.flatten(0, 1)
    wrong = PoseRefinement(torch.zeros(1, 3))
    wrong.turn += torch.tensor([[0.02, -0.015, 0.0]])
    found = fit_pose(field, wrong.forward(rays, view), target, black)
    left = (found.forward(wrong.forward(rays, view), view).directions - rays.directions).norm(dim=-1).mean()
    before = (wrong.forward(rays, view).directions - rays.directions).norm(dim=-1).mean()
    assert 0 < left < 0.5 * before


def test_the_exposure_expected_of_an_unseen_photo_is_its_neighbours(inputs: dict[str, Path]) -> None:
    scene = read_scene(inputs["normalise"])
    train, test = scene.of_split("train"), scene.of_split("test")
    photos = {view.name: [0.1 * i, 0.0, -0.1] for i, view in enumerate(train)}
    weights = held_out_images(scene, train, test).weights
    assert weights.shape == (len(test), len(train))
    for row, view in zip(weights, test, strict=True):
        (exposure,) = photo_effects({"effects": {"exposure": photos}}, scene, view)
        expected = [float(row @ (0.1 * torch.arange(len(train)))), 0.0, -0.1]
        assert exposure.rows.tolist() == [pytest.approx(expected, abs=1e-6)]
    (exposure,) = photo_effects({"effects": {"exposure": photos}}, scene, train[2])
    assert exposure.rows.tolist() == [pytest.approx([0.2, 0.0, -0.1])], "of a photo that was trained on: its own"
    assert photo_effects({"effects": {}}, scene, test[0]) == ()


def test_the_scenes_photos_are_as_bright_as_they_say(tmp_path: Path) -> None:
    """The helper itself: an exposure effect changes photos by gains within its range, and nothing else does."""
    plain = effect_scene(tmp_path / "plain", Effects(), views=3)
    exposed = effect_scene(tmp_path / "exposed", Effects(exposure_ev=1.0), views=3)
    for name in ("000.png", "001.png", "002.png"):
        a, b = (torch.tensor(load_pixels(i["ingest"] / "images" / name, 240, 180)) / 255 for i in (plain, exposed))
        middle = (a > 0.1) & (a < 0.6)
        shown = {ev: (expose(a, torch.tensor([ev * 0.6931] * 3)) - b)[middle].abs().mean() for ev in (-1.0, 0.0, 1.0)}
        assert middle.any() and shown[0.0] > 0.003 and min(shown.values()) < 0.35
