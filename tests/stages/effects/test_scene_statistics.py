"""What registration.json and the places of observations say, without a photo."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nerf.effects.statistics.statistic import Statistic
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.effects.scene_statistics import (
    camera_model_statistic,
    classify_background,
    classify_poses,
    classify_rolling_shutter,
    observed_places,
    unless_pixels_differ,
)
from stages.effects.study import Clock
from stages.io.photos import Photo, write_photos
from tests.stages.photo_scene import photographed, pose_towards_origin, seen_points

VIEWS, POINTS = 10, 120


def geometric(
    folder: Path, width: int, shift: float, readout: float = 0.0, turned: bool = False
) -> dict[str, Statistic]:
    """Frames of a video, 3:4, or 4:3 of a camera that was ``turned``, whose points are off by ``shift`` of the width,
    each frame in another direction, and by the motion that a readout of this part of a frame makes; poses are stated to
    be uncertain by half a thousandth."""
    height, focal = width * 4 // 3 if turned else width * 3 // 4, 1.1 * width
    draw = np.random.default_rng(0)
    xyz = draw.uniform(-0.7, 0.7, (POINTS, 3))
    places, views, photos = [], [], []
    for number in range(VIEWS):
        pose = pose_towards_origin(0.0)
        pose[:, 3] += 0.03 * number * pose[:, 0]  # sideways, by eleven thousandths of the width
        inside = (xyz - pose[:, 3]) @ pose[:, :3]
        places.append(focal * inside[:, :2] / inside[:, 2:] + [width / 2, height / 2])
        file = f"images/{number}.png"
        views.append(View(f"{number}.png", file, 0, pose, 2.0, 4.0, "train"))
        photos.append(Photo(f"{number}.png", file, width, height, 0, None, None, False, 1.0, time_s=number / 10))
    folder.mkdir()
    write_photos(folder, photos, [], {})
    xy = np.array(places)
    motion = np.median(np.diff(xy, axis=0), axis=1)
    motion = np.concatenate([motion, motion[-1:]])[:, None]
    row = xy[..., :1] / width if turned else xy[..., 1:] / height
    rows = readout * (row - 0.5) * motion
    angle = draw.uniform(0, 2 * np.pi, VIEWS)
    xy = xy + shift * width * np.stack([np.cos(angle), np.sin(angle)], 1)[:, None] + rows
    points = {
        "xyz": xyz.astype(np.float32),
        "view": np.repeat(np.arange(VIEWS, dtype=np.int32), POINTS),
        "point": np.tile(np.arange(POINTS, dtype=np.int32), VIEWS),
        "xy": xy.reshape(-1, 2).astype(np.float32),
    }
    camera = Camera("PINHOLE", width, height, (focal, focal, width / 2, height / 2))
    scene = Scene(
        (camera,), tuple(views), Similarity(1.0, np.eye(3), np.zeros(3)), False, False, "object-centric", True
    )
    places = observed_places(folder, scene, points, {view.file: width / 2000 for view in views})
    return {"pose_refinement": classify_poses(places), "rolling_shutter": classify_rolling_shutter(places)}


def test_what_serves_several_effects_is_shared_out_among_them(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("stages.effects.study.time", SimpleNamespace(perf_counter=lambda: now[0]))

    def works(seconds: float, said: Any = None) -> Any:
        now[0] += seconds
        return said

    clock = Clock()
    with clock.runs_for("a", "b"):
        works(3.0)
    assert clock.timed({"b": lambda: works(2.0, "of b"), "c": lambda: works(0.5, "of c")}) == {"b": "of b", "c": "of c"}
    assert clock.seconds == {"a": 1.5, "b": 3.5, "c": 0.5}


@pytest.mark.parametrize(("shift", "called_for"), [(0.0002, None), (0.001, True)])
def test_pose_errors_are_scaled_to_a_thousand_pixels(tmp_path: Path, shift: float, called_for: bool | None) -> None:
    found = [geometric(tmp_path / str(width), width, shift)["pose_refinement"] for width in (800, 4000)]
    for one in found:
        assert one.value == pytest.approx(max(1000 * shift, 0.5), rel=0.05) and one.called_for is called_for
        assert one.unit == "px at 1000" and one.words.startswith("upper quartile of the photos, at 1000 pixels: ")
        assert one.words.endswith(", pose uncertainty 0.5 px")


def test_row_delays_are_scaled_to_a_thousand_pixels(tmp_path: Path) -> None:
    small, large = (geometric(tmp_path / str(width), width, 0.0, 0.5)["rolling_shutter"] for width in (800, 4000))
    assert small.called_for is large.called_for is True and small.unit == "px at 1000"
    assert large.value == pytest.approx(small.value, rel=0.05)
    assert large.words.startswith("readout takes ") and large.words.endswith(", at 1000 pixels")
    assert geometric(tmp_path / "upright", 800, 0.0, 0.5, turned=True)["rolling_shutter"].called_for is True
    # eleven thousandths of the width are motion enough, however small the photo is: here they are 1.8 of its pixels
    assert geometric(tmp_path / "icon", 160, 0.0, 0.5)["rolling_shutter"].called_for is True


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("called_for", [True, None, False])
def test_gains_across_distances_are_left_to_a_pilot(called_for: bool | None, seen: bool) -> None:
    exposure = Statistic(0.2, "EV", 0.1, 0.01, called_for, "gains span 0.4 EV")
    scale = Statistic(5.0 if seen else 2.0, "×", 4.0, 0.01, seen, "pixels differ")
    found = unless_pixels_differ(exposure, scale)
    if called_for and seen:
        assert found.called_for is None and found.words.startswith("gains span 0.4 EV; very different distances")
    else:
        assert found == exposure


def candidate(group: int, model: str, error: float | None, chosen: bool = False) -> dict[str, Any]:
    """A row of camera_models."""
    noise = None if error is None else 0.001
    return {"group": group, "model": model, "held_out_px": error, "noise_px": noise, "chosen": chosen}


def test_lenses_compare_with_their_groups_simplest_sound_one() -> None:
    rows = [
        candidate(0, "SIMPLE_PINHOLE", None),
        candidate(0, "PINHOLE", 0.9),
        candidate(0, "OPENCV", 0.6, chosen=True),
        candidate(1, "SIMPLE_PINHOLE", 0.65),
        candidate(1, "SIMPLE_RADIAL", 0.55, chosen=True),
        candidate(1, "OPENCV", 0.54),
    ]
    found = camera_model_statistic({"source": "sfm", "camera_models": rows})
    assert found.value == pytest.approx(0.3) and found.called_for is True
    assert found.words == ("OPENCV: held-out error 0.3 px below that of the simplest candidate, SIMPLE_RADIAL: 0.1 px")
    alone = camera_model_statistic({"source": "sfm", "camera_models": rows[3:]})
    assert alone.words == "SIMPLE_RADIAL: held-out error 0.1 px below that of the simplest candidate"


def test_a_pinhole_is_no_lens() -> None:
    found = camera_model_statistic({"source": "sfm", "camera_models": [candidate(0, "PINHOLE", 0.5, chosen=True)]})
    assert found.called_for is False and found.value == 0


@pytest.mark.parametrize(
    ("source", "rows", "why"),
    [
        ("import", [], "the cameras were imported"),
        ("sfm", [], "too few points to compare camera models"),
        ("sfm", [candidate(0, "PINHOLE", None)], "no candidate makes a sound camera"),
    ],
)
def test_why_nothing_is_known_of_the_lens(source: str, rows: list[dict[str, Any]], why: str) -> None:
    found = camera_model_statistic({"source": source, "camera_models": rows})
    assert found.words == f"not measured: {why}" and found.called_for is False
    assert np.isinf(found.noise) and np.isinf(found.threshold)


@pytest.mark.parametrize(("has_alpha", "backdrop"), [(True, None), (False, (1.0, 1.0, 1.0)), (False, None)])
def test_alpha_and_backdrops_leave_the_background_out(
    tmp_path: Path, has_alpha: bool, backdrop: tuple[float, float, float] | None
) -> None:
    inputs, scene = photographed(tmp_path)
    scene = replace(scene, has_alpha=has_alpha, backdrop=backdrop)
    write_photos(inputs["ingest"], [], [], {})
    places = observed_places(inputs["ingest"], scene, seen_points(scene), {})
    assert classify_background(places).called_for is not (has_alpha or backdrop is not None)
