import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from nerf.geometry.scene import Camera
from stages.sfm.colmap.adjustment import final_bundle_adjustment, intrinsics
from stages.sfm.colmap.adjustment.camera_model_selection import CameraModels, best_covered, choose, hold_out, paired
from stages.sfm.colmap.adjustment.intrinsics import (
    CAMERA_MODELS,
    CameraModelCandidate,
    set_camera_models,
    why_degenerate,
)
from stages.sfm.colmap.adjustment.observations import noise_px, observations, residuals
from stages.sfm.colmap.cameras import native
from tests.refusals import codes
from tests.stages.sfm.colmap.adjustment.lens_scene import HEIGHT, WIDTH, adjust, lens, mapped, photographed

if TYPE_CHECKING:
    import pycolmap

CENTRE = (WIDTH / 2, HEIGHT / 2)
PINHOLE = lens("SIMPLE_PINHOLE", 900, *CENTRE)
BARREL = lens("SIMPLE_RADIAL", 800, *CENTRE, -0.2)


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        (PINHOLE, CameraModelCandidate("SIMPLE_PINHOLE", False)),
        (BARREL, CameraModelCandidate("SIMPLE_RADIAL", False)),
        (lens("RADIAL", 800, *CENTRE, -0.3, 0.3), CameraModelCandidate("RADIAL", False)),
        (lens("OPENCV", 800, 820, *CENTRE, -0.2, 0.1, 0.004, -0.003), CameraModelCandidate("OPENCV", False)),
        (lens("SIMPLE_PINHOLE", 900, 475, 285), CameraModelCandidate("SIMPLE_PINHOLE", True)),
    ],
    ids=lambda case: case.model if isinstance(case, Camera) else None,
)
def test_the_lens_is_the_simplest_that_describes_the_truth(camera: Camera, expected: CameraModelCandidate) -> None:
    model = mapped(photographed(camera))
    choice = choose(model, seed=0)
    assert choice.chosen == {1: expected}
    assert [row["model"] for row in choice.table if row["chosen"]] == [expected.model]
    assert 0.4 < choice.noise_px < 0.6  # half a pixel
    set_camera_models(model, {1: expected.model})
    adjust(model, expected.principal_point)
    assert model.camera(1).mean_focal_length() == pytest.approx(native(camera).mean_focal_length(), rel=0.005)


def test_a_150_degree_fisheye_is_told_by_mapping() -> None:
    camera = lens("OPENCV_FISHEYE", 344, 344, *CENTRE, 0.02, -0.01, 0, 0)
    choice = choose(mapped(photographed(camera, points=1200, room=True), widest=60), seed=0)
    assert choice.chosen[1].model.endswith("FISHEYE")
    assert "its distortion has no inverse" in str([row["reason"] for row in choice.table])


def test_the_choice_repeats_and_says_why() -> None:
    model = mapped(photographed(BARREL, points=200))
    choice = choose(model, seed=3)
    assert choose(model, seed=3) == choice
    assert choose(model, seed=4).table != choice.table
    assert [(row["model"], row["principal_point"]) for row in choice.table] == [
        (name, place) for name in CAMERA_MODELS for place in ("fixed", "refined")
    ]
    best = min(choice.table, key=lambda row: row["held_out_px"] or 9)
    assert (best["worse_px"], best["noise_px"]) == (0, 0)
    assert choice.notes[0].code == "sfm.camera-model" and "SIMPLE_RADIAL" in choice.notes[0].text


def test_many_photos_are_judged_by_the_best_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mapped(photographed(BARREL, points=200))
    everyone = set(model.reg_image_ids())
    some = best_covered(model, 5)
    assert len(some) == 5 and some < everyone and best_covered(model, 5) == some
    assert best_covered(model, 1000) == everyone
    monkeypatch.setattr("stages.sfm.colmap.adjustment.camera_model_selection.MAX_PHOTOS", 5)
    choice = choose(model, seed=0)
    assert {row["photos"] for row in choice.table} == {len(everyone)}, "of all these photos the camera is chosen"
    assert len(set(model.reg_image_ids())) == len(everyone), "the model itself stays"
    assert choice.chosen[1].model == "SIMPLE_RADIAL"


def test_without_evidence_it_stays_simple() -> None:
    faint = lens("SIMPLE_RADIAL", 900, *CENTRE, -0.002)
    choice = choose(mapped(photographed(faint, points=80)), seed=0)
    assert choice.chosen == {1: CameraModelCandidate("SIMPLE_PINHOLE", False)}
    assert codes(choice.notes) == ["sfm.camera-model"] and "SIMPLE_PINHOLE" in choice.notes[0].text


def test_with_too_few_points_nothing_is_compared() -> None:
    choice = choose(mapped(photographed(PINHOLE, photos=4, points=40)), seed=0)
    assert choice.chosen == {1: CameraModelCandidate("SIMPLE_RADIAL", False)}
    assert choice.table == []
    assert codes(choice.notes) == ["sfm.camera-model"] and "SIMPLE_RADIAL" in choice.notes[0].text


def test_a_single_photo_of_another_camera_has_enough_points() -> None:
    model = mapped(photographed(PINHOLE, BARREL, points=250))
    for image_id in sorted(i for i in model.reg_image_ids() if model.image(i).camera_id == 2)[1:]:
        model.deregister_frame(model.image(image_id).frame_id)
    alone = choose(model, 0).notes[1]
    assert alone.code == "sfm.camera-model" and "1 photo" in alone.text and "SIMPLE_RADIAL" in alone.text


def test_of_a_given_model_only_the_principal_point_is_chosen() -> None:
    choice = choose(mapped(photographed(PINHOLE, points=150)), 0, ("OPENCV",))
    assert [(row["model"], row["free_parameters"]) for row in choice.table] == [("OPENCV", 6), ("OPENCV", 8)]
    assert "OPENCV as given" in choice.notes[0].text


def test_every_camera_is_judged_by_its_own_photos() -> None:
    choice = choose(mapped(photographed(PINHOLE, BARREL, points=250)), 0)
    assert choice.chosen == {
        1: CameraModelCandidate("SIMPLE_PINHOLE", False),
        2: CameraModelCandidate("SIMPLE_RADIAL", False),
    }
    assert [(row["group"], row["photos"]) for row in choice.table if row["chosen"]] == [(0, 5), (1, 5)]
    assert "5 photos" in choice.notes[1].text and "SIMPLE_RADIAL" in choice.notes[1].text


def test_cameras_that_come_out_alike_are_judged_once_more_together() -> None:
    choice = choose(mapped(photographed(BARREL, BARREL, points=150)), 0)
    assert choice.chosen == dict.fromkeys((1, 2), CameraModelCandidate("SIMPLE_RADIAL", False))
    assert {(row["group"], row["photos"]) for row in choice.table} == {(0, 10)}
    assert len(choice.notes) == 1


def test_cameras_with_few_photos_are_judged_together() -> None:
    choice = choose(mapped(photographed(*5 * [BARREL], points=100)), 0)  # two photos each
    assert choice.chosen == dict.fromkeys(range(1, 6), CameraModelCandidate("SIMPLE_RADIAL", False))
    assert {(row["group"], row["photos"]) for row in choice.table} == {(0, 10)}
    assert len(choice.notes) == 1


def test_where_every_candidate_is_degenerate_the_camera_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intrinsics, "why_degenerate", lambda camera: "it is wrong")
    choice = choose(mapped(photographed(PINHOLE, photos=6, points=80)), 0)
    assert choice.chosen == {1: CameraModelCandidate("SIMPLE_RADIAL", False)}
    assert {row["reason"] for row in choice.table} == {"it is wrong"}
    assert codes(choice.notes) == ["sfm.camera-model"] and "SIMPLE_RADIAL" in choice.notes[0].text


def test_few_degenerate_cameras_do_not_decide_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        intrinsics,
        "why_degenerate",
        lambda camera: "it is wrong" if camera.camera_id == 5 else why_degenerate(camera),
    )
    choice = choose(mapped(photographed(*5 * [PINHOLE], points=100)), 0)  # two photos each
    assert choice.chosen == dict.fromkeys(range(1, 6), CameraModelCandidate("SIMPLE_PINHOLE", False))
    monkeypatch.setattr(
        intrinsics,
        "why_degenerate",
        lambda camera: "it is wrong" if camera.camera_id > 3 else why_degenerate(camera),
    )
    choice = choose(mapped(photographed(*5 * [PINHOLE], points=100)), 0)
    assert choice.chosen == dict.fromkeys(range(1, 6), CameraModelCandidate("SIMPLE_RADIAL", False)), (
        "as mapping had them"
    )


def test_one_observation_a_point_is_held_out() -> None:
    whole = photographed(PINHOLE, points=300)
    model = photographed(PINHOLE, points=300)
    out = hold_out(model, 0, 10_000)
    assert len(out.point) == len(set(out.point.tolist())) > 250
    assert len(out.point) + model.compute_num_observations() == whole.compute_num_observations()
    assert min(model.point3D(i).track.length() for i in model.point3D_ids()) >= 2
    assert set(out.image.tolist()) == set(model.reg_image_ids())
    kept = observations(model)
    places = {tuple(xy) for xy in np.concatenate([out.xy, kept.xy]).tolist()}
    assert places == {tuple(xy) for xy in observations(whole).xy.tolist()}
    assert set(hold_out(photographed(PINHOLE, points=300), 1, 10_000).point.tolist()) <= set(whole.point3D_ids())
    assert not np.array_equal(hold_out(photographed(PINHOLE, points=300), 1, 10_000).image, out.image)


def test_of_many_points_some_are_drawn() -> None:
    model = photographed(PINHOLE, points=300)
    out = hold_out(model, 0, most=500)
    assert 500 <= len(out.point) + model.compute_num_observations() < 510
    assert len(out.point) == model.num_points3D()


def test_noise_of_differences_is_that_of_independent_cells() -> None:
    random = np.random.default_rng(0)
    values = random.normal(0.3, 2, 400)
    mean, error = paired(values, np.arange(400))
    assert (mean, error) == (pytest.approx(values.mean()), pytest.approx(values.std(ddof=1) / 20))
    again = paired(np.repeat(values, 5), np.repeat(np.arange(400), 5))  # five that err alike say no more than one
    assert again == (pytest.approx(mean), pytest.approx(error))


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_a_camera_of_another_model_draws_the_same(name: str) -> None:
    model = photographed(lens("SIMPLE_RADIAL", 900, *CENTRE, -0.05), noise=0, points=200, photos=4)
    before = model.camera(1).mean_focal_length()
    set_camera_models(model, {1: name})
    camera = model.camera(1)
    assert camera.model_name == name
    assert (camera.principal_point_x, camera.principal_point_y) == CENTRE
    assert camera.mean_focal_length() == pytest.approx(before, rel=0.05)
    worst = np.abs(residuals(model, observations(model))).max()
    exact = name in ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
    assert worst < 1e-4 if exact else 1e-4 < worst < 8


@pytest.mark.parametrize(
    ("camera", "why"),
    [
        (PINHOLE, None),
        (BARREL, None),
        (lens("SIMPLE_PINHOLE", np.nan, *CENTRE), "its parameters are not finite"),
        (lens("OPENCV", 9500, 9000, *CENTRE, 0, 0, 0, 0), "its focal length is 10 to 11 times the longer side"),
        (lens("SIMPLE_PINHOLE", 80, *CENTRE), "its focal length is 0.089 to 0.089 times the longer side"),
        (lens("SIMPLE_PINHOLE", 900, 600, 300), "its principal point is off the centre by 17% of the image"),
        (lens("SIMPLE_RADIAL", 450, *CENTRE, -0.5), r"its distortion has no inverse at \d+\.\d% of the pixels"),
    ],
)
def test_degenerate_cameras_are_out(camera: Camera, why: str | None) -> None:
    found = why_degenerate(native(camera))
    assert found is None if why is None else found is not None
    if why is not None:
        assert re.fullmatch(why, str(found))


def test_fisheye_counts_as_less_simple_than_any_other() -> None:
    lenses = [CameraModelCandidate(name, refined) for name in CAMERA_MODELS for refined in (False, True)]
    ordered = sorted(lenses, key=lambda one: one.complexity)
    assert [one.free_parameters for one in ordered] == [1, 2, 3, 3, 4, 5, 6, 8, 2, 3, 4, 5, 6, 8]
    assert [one.model.endswith("FISHEYE") for one in ordered] == 8 * [False] + 6 * [True]


def test_noise_is_found_beneath_mismatches() -> None:
    model = mapped(photographed(PINHOLE, points=300, photos=6))
    seen = observations(model)
    assert noise_px(model, seen) == pytest.approx(0.5, rel=0.1)
    wild = seen._replace(xy=seen.xy + np.where(np.arange(len(seen.xy)) % 10, 0.0, 30.0)[:, None])
    assert noise_px(model, wild) == pytest.approx(0.55, rel=0.15)


def test_a_lens_that_gains_observations_is_chosen_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few, many = photographed(PINHOLE, photos=6, points=60), photographed(PINHOLE, photos=6, points=70)
    asked = []

    def adjusted(before: object, database: Path, seed: int, choice: CameraModels, thinned: bool) -> object:
        asked.append(before)
        return many

    monkeypatch.setattr(final_bundle_adjustment, "_adjusted", adjusted)
    finished = final_bundle_adjustment.final_bundle_adjustment(few, Path("matches.db"), 0, None, False)
    assert asked == [few, many]
    assert finished.model is many
    assert sorted(finished.uncertainty_px) == [f"{i:02d}.jpg" for i in range(1, 7)]
    asked.clear()
    final_bundle_adjustment.final_bundle_adjustment(many, Path("matches.db"), 0, None, False)
    assert asked == [many]


def with_a_bad_lens(monkeypatch: pytest.MonkeyPatch, *cameras: Camera) -> "pycolmap.Reconstruction":
    """What the last adjustment would leave: the last camera bends rays so far that the photo's corners have none."""
    model = photographed(*cameras, points=300)
    bad = model.camera(len(cameras))
    bad.model, bad.params = native(lens("SIMPLE_RADIAL", 800, *CENTRE, -0.5)).model, [800, *CENTRE, -0.5]
    monkeypatch.setattr(final_bundle_adjustment, "choose", lambda *_: CameraModels(0.5))
    monkeypatch.setattr(final_bundle_adjustment, "_adjusted", lambda *_: model)
    monkeypatch.setattr(final_bundle_adjustment, "_adjust", lambda model, *_: adjust(model))
    return model


def test_a_camera_that_comes_out_degenerate_becomes_a_pinhole(monkeypatch: pytest.MonkeyPatch) -> None:
    model = with_a_bad_lens(monkeypatch, *5 * [PINHOLE])
    finished = final_bundle_adjustment.final_bundle_adjustment(model, Path("matches.db"), 0, None, False)
    assert finished.model.camera(5).model_name == "SIMPLE_PINHOLE"
    assert finished.model.camera(5).mean_focal_length() == pytest.approx(900, rel=0.005)
    assert finished.left_out == {} and finished.model.num_reg_images() == 10
    assert finished.notes[-1].code == "sfm.camera-replaced" and "2 photos" in finished.notes[-1].text


def test_photos_whose_camera_stays_degenerate_lose_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    model = with_a_bad_lens(monkeypatch, *5 * [PINHOLE])
    monkeypatch.setattr(intrinsics, "why_degenerate", lambda camera: "it is wrong" if camera.camera_id == 5 else None)
    finished = final_bundle_adjustment.final_bundle_adjustment(model, Path("matches.db"), 0, None, False)
    why = [(name, reason.code) for name, reason in finished.left_out.items()]
    assert why == [(name, "sfm.unregistered-degenerate-camera") for name in ("04.jpg", "09.jpg")]
    assert finished.model.num_reg_images() == len(finished.uncertainty_px) == 8
    assert sorted(finished.model.cameras) == [1, 2, 3, 4]


def test_where_most_cameras_are_degenerate_none_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    model = with_a_bad_lens(monkeypatch, PINHOLE)
    monkeypatch.setattr(intrinsics, "why_degenerate", lambda camera: "it is wrong")
    finished = final_bundle_adjustment.final_bundle_adjustment(model, Path("matches.db"), 0, None, False)
    assert finished.left_out == {} and finished.model.num_reg_images() == 10
