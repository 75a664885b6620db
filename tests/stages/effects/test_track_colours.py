"""Colours at sparse points, read off photos whose every pixel is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import stages.effects.track_colours
from nerf.effects.statistics.exposure import EV, fit_exposure
from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.effects.scene_statistics import training_residuals
from stages.effects.study import scene_statistics
from stages.effects.track_colours import (
    BRIGHTEST,
    CLIPPED_SHARE,
    DARKEST,
    MAX_OBSERVATIONS,
    _expected,
    _window_means,
    _windows,
    sample_photos,
    training_tracks,
)
from stages.io.files import write_png
from stages.io.photos import Photo, write_photos
from stages.sfm.colmap.cameras import mean_focal_and_centre
from tests.conftest import RecordedProgress
from tests.stages.photo_scene import pose_towards_origin

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
VIEWS, POINTS = 8, 60
TEST_VIEWS = (0, 4)


def value(seed: int) -> np.ndarray:
    """The colour of each point, (POINTS, 3) in [60, 160] of 255, every one another."""
    return np.random.default_rng(seed).integers(60, 160, (POINTS, 3))


def photographed_points(
    folder: Path, gain: np.ndarray | None = None, **settings: object
) -> tuple[Scene, dict[str, np.ndarray]]:
    """Photos of squares of one colour each around every point, and what normalise would say of them.

    Test photos are white: whoever looks at them is found out. ``gain`` (VIEWS,) multiplies the sRGB values.
    """
    factor = np.ones(VIEWS) if gain is None else gain
    xyz = np.random.default_rng(1).uniform(-0.7, 0.7, (POINTS, 3))
    views, seen, photos = [], [], []
    for number in range(VIEWS):
        pose = pose_towards_origin(2 * np.pi * number / VIEWS / 6, 3.0)
        inside = (xyz - pose[:, 3]) @ pose[:, :3]
        xy = FOCAL * inside[:, :2] / inside[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        pixels = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
        kept = []
        for point, (x, y) in enumerate(np.floor(xy).astype(int)):
            apart = np.abs(xy - xy[point]).max(axis=1)
            if 6 <= x < WIDTH - 6 and 6 <= y < HEIGHT - 6 and np.sort(apart)[1] > 11:
                pixels[y - 5 : y + 6, x - 5 : x + 6] = np.rint(value(0)[point] * factor[number])
                kept.append(point)
        split = "test" if number in TEST_VIEWS else "train"
        if split == "test":
            pixels[:] = 255
        file = f"images/{number}.png"
        write_png(folder / file, pixels)
        views.append(View(f"{number}.png", file, 0, pose, 2.0, 4.0, split))
        photos.append(Photo(f"{number}.png", file, WIDTH, HEIGHT, 0, None, None, False, 1.0))
        seen.extend((number, point, *xy[point]) for point in kept)
    write_photos(folder, photos, [], {})
    table = np.array(seen)
    points = {
        "xyz": xyz.astype(np.float32),
        "rgb": value(0).astype(np.uint8),
        "error_px": np.zeros(POINTS, np.float32),
        "view": table[:, 0].astype(np.int32),
        "point": table[:, 1].astype(np.int32),
        "xy": table[:, 2:].astype(np.float32),
    }
    return _scene(views), points


def _scene(views: list[View]) -> Scene:
    return Scene((CAMERA,), tuple(views), Similarity(1.0, np.eye(3), np.zeros(3)), False, False, "object-centric", True)


def without_points(points: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: array[:0] for name, array in points.items()}


def test_colours_are_those_of_the_photos(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    tracks = sample_photos(tmp_path, scene, points, progress).tracks
    assert len(tracks) > 60 and tracks.views == VIEWS - len(TEST_VIEWS)
    np.testing.assert_allclose(tracks.colour, value(0)[tracks.point] / 255, atol=1e-9)
    assert not tracks.saturated.any()
    assert tracks.texture is not None and tracks.texture.max() < 1e-6
    assert progress.updates[-1][1] == 1.0 and "6 of 6" in progress.updates[-1][0]


def test_geometry_is_that_of_the_cameras(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    tracks, xy = training_tracks(scene, points, MAX_OBSERVATIONS)
    view = scene.of_split("train")[tracks.view[7]]
    offset = view.scene_from_camera[:, 3] - points["xyz"][tracks.point[7]]
    np.testing.assert_allclose(tracks.distance[7], np.linalg.norm(offset))
    np.testing.assert_allclose(tracks.towards[7], offset / np.linalg.norm(offset))
    np.testing.assert_allclose(tracks.footprint, tracks.distance / FOCAL)
    np.testing.assert_allclose(tracks.radius[7], np.hypot(*(xy[7] - [320, 240])) / np.hypot(320, 240))
    residual = training_residuals(scene, points)[3]
    assert 0 < np.abs(residual).max() < 1e-3


def test_test_photos_are_not_opened(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    for number in TEST_VIEWS:
        (tmp_path / f"images/{number}.png").unlink()
    assert len(sample_photos(tmp_path, scene, points, progress).tracks) > 60


@pytest.mark.parametrize("background", [True, False], ids=["alpha is the background", "alpha cuts out"])
def test_masked_and_transparent_windows_are_left_out(
    tmp_path: Path, progress: RecordedProgress, background: bool
) -> None:
    scene, points = photographed_points(tmp_path)
    whole = sample_photos(tmp_path, scene, points, progress).tracks
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, 320:] = 0
    write_png(tmp_path / "masks/1.png.png", mask)
    with Image.open(tmp_path / "images/2.png") as image:
        pixels = np.dstack([np.asarray(image), mask if background else np.maximum(mask, 1) - 1])  # 254 is not 255
    write_png(tmp_path / "images/2.png", pixels)
    masks = {"1.png": "masks/1.png.png"} | ({} if background else {"2.png": "masks/1.png.png"})
    views = [replace(view, mask=masks.get(view.name)) for view in scene.views]
    scene = replace(scene, views=tuple(views), has_alpha=background)
    cut = sample_photos(tmp_path, scene, points, progress).tracks
    for number in range(6):
        of_view = points["view"] == 1 + number + (number > 2)
        reaching = np.count_nonzero(np.floor(points["xy"][of_view, 0]) + 2 >= 320)  # windows of five pixels
        lost = np.count_nonzero(whole.view == number) - np.count_nonzero(cut.view == number)
        assert lost == (reaching if number < 2 else 0) and reaching > 5
    assert len(cut) < len(whole)


def test_clipped_windows_are_saturated(tmp_path: Path, progress: RecordedProgress) -> None:
    gain = np.ones(VIEWS)
    gain[3] = 2.2
    scene, points = photographed_points(tmp_path, np.minimum(gain, 255 / 159))
    tracks = sample_photos(tmp_path, scene, points, progress).tracks
    bright = (tracks.view == 2) & (value(0)[tracks.point].max(axis=1) >= 157)
    assert np.array_equal(tracks.saturated, bright)


def test_a_dark_channel_leaves_the_others_their_gains(tmp_path: Path, progress: RecordedProgress) -> None:
    """Photos by lamplight: their blue is cut off nearly everywhere."""
    scene, points = photographed_points(tmp_path, np.linspace(0.8, 1.4, VIEWS))
    by_day = fit_exposure(sample_photos(tmp_path, scene, points, progress).tracks)
    for number, file in enumerate(sorted((tmp_path / "images").iterdir())):
        with Image.open(file) as image:
            pixels = np.asarray(image).copy()
        pixels[..., 2] = np.random.default_rng(number).integers(0, 3, pixels.shape[:2])
        write_png(file, pixels)
    tracks = sample_photos(tmp_path, scene, points, progress).tracks
    by_night = fit_exposure(tracks)
    assert not tracks.saturated.any() and by_night.known.all()
    np.testing.assert_allclose(by_night.log_gain[:, :2], by_day.log_gain[:, :2], atol=0.02)
    assert np.ptp(by_night.log_gain[:, 0]) > 0.5


def test_windows_are_summed_as_if_each_were_looked_at() -> None:
    draw = np.random.default_rng(0)
    pixels = draw.integers(0, 256, (300, 400, 4), dtype=np.uint8)
    pixels[:150] = pixels[:150] // 2 + 60  # none clipped, where the rest is in half of its windows
    used = draw.random((300, 400)) > 1e-3
    side = draw.choice([5, 7, 21, 61], 500)
    side[:2] = 61
    corner = (draw.random((500, 2)) * ([401, 301] - side[:, None])).astype(int)
    corner[:2] = [[0, 0], [400 - 61, 300 - 61]]
    found = _window_means(pixels, used, corner, side)
    direct = []
    for (x, y), width in zip(corner, side, strict=True):
        window = pixels[y : y + width, x : x + width, :3].reshape(-1, 3)
        lightest = window.max(axis=1)
        clipped = ((lightest <= DARKEST) | (lightest >= BRIGHTEST)).mean() > CLIPPED_SHARE
        whole = used[y : y + width, x : x + width].all()
        row = [*window.mean(axis=0) / 255, clipped, window.mean(axis=1).std() / 255]
        direct.append(row if whole else [np.nan] * 5)
    np.testing.assert_allclose(found, direct, rtol=1e-12)
    there = found[np.isfinite(found[:, 0])]
    assert 100 < len(there) < 450 and 0.01 < there[:, 3].mean() < 0.9


def test_fewer_observations_are_whole_tracks(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    all_of_them, some = training_tracks(scene, points, MAX_OBSERVATIONS)[0], training_tracks(scene, points, 60)[0]
    assert 30 < len(some) < 75 < len(all_of_them)
    lengths = np.bincount(all_of_them.point, minlength=POINTS)
    kept = np.bincount(some.point, minlength=POINTS)
    np.testing.assert_array_equal(kept[kept > 0], lengths[kept > 0])


def test_near_photos_have_larger_windows(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    tracks = training_tracks(scene, points, MAX_OBSERVATIONS)[0]
    near = replace(tracks, footprint=np.where(tracks.view == 0, 0.5, 1.0) * 0.03)
    window = _windows(scene, near)
    paired = np.isin(near.point, near.point[near.view > 0])
    assert set(window[(near.view == 0) & paired]) == {11} and set(window[near.view > 0]) == {5}


def test_places_where_a_point_should_be_seen(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    point = int(np.bincount(points["point"][points["view"] == 2]).argmax())
    removed = (points["view"] == 2) & (points["point"] == point)
    others = (points["point"] == point) & ~removed
    assert removed.sum() == 1 and others.sum() > 3
    fewer = {name: array[~removed] if name in ("view", "point", "xy") else array for name, array in points.items()}
    expected = sample_photos(tmp_path, scene, fewer, progress).expected
    found = (expected.view == 1) & (expected.point == point)
    assert found.sum() == 1
    np.testing.assert_allclose(expected.colour[found][0], value(0)[point] / 255, atol=1e-9)


def test_only_photos_nearby_are_asked_what_should_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    count, each = 60, 400  # photos all around; each point is seen by every second one of ten
    poses = [pose_towards_origin(2 * np.pi * number / count) for number in range(count)]
    scene = _scene([View(f"{n}.png", f"images/{n}.png", 0, pose, 2.0, 4.0, "train") for n, pose in enumerate(poses)])
    draw = np.random.default_rng(0)
    view = (draw.integers(0, count, (each, 1)) + np.arange(0, 10, 2)) % count
    points = {
        "xyz": draw.uniform(-0.5, 0.5, (each, 3)),
        "view": view.ravel(),
        "point": np.repeat(np.arange(each), 5),
        "xy": np.zeros((5 * each, 2)),
    }
    tracks = training_tracks(scene, points, MAX_OBSERVATIONS)[0]
    tracks = replace(tracks, point=2 * tracks.point)  # as where every second point was drawn
    points["xyz"] = points["xyz"].repeat(2, axis=0)

    def pairs() -> set[tuple[int, int]]:
        expected = _expected(scene, points, tracks)[0]
        return set(zip(expected.view.tolist(), expected.point.tolist(), strict=True))

    near = pairs()
    monkeypatch.setattr(stages.effects.track_colours, "NEAR_APART", 100.0)
    assert pairs() == near and len(near) > 1000
    monkeypatch.setattr(stages.effects.track_colours, "MAX_LOOKED_AT", 300 * count)
    some = pairs()
    # whole points are drawn, other ones for every photo
    assert some < near and 0.05 < len(some) / len(near) < 0.3
    assert {view for view, _ in some} == set(range(count))
    assert len({point for _, point in some}) > 0.5 * len({point for _, point in near})


def test_without_points_only_the_photos_are_looked_at(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    looked = sample_photos(tmp_path, scene, without_points(points), progress)
    assert len(looked.tracks) == len(looked.expected) == 0 and looked.tracks.views == 6


def test_all_evidence_of_a_scene(tmp_path: Path, progress: RecordedProgress) -> None:
    gain = np.where(np.arange(VIEWS) % 2, 1.0, 0.7)
    scene, points = photographed_points(tmp_path, gain)
    found = scene_statistics(tmp_path, scene, points, {"images/1.png": None, "images/2.png": 0.1}, progress)
    assert set(found.of) == {
        *("exposure", "tone", "view_dependence", "vignetting", "transients", "scale_variation", "participating_media"),
        *("background", "pose_refinement", "rolling_shutter"),
    }
    assert found.of["exposure"].called_for is True
    bright, dark = found.measured["exposure"][[0, 2, 3, 5]], found.measured["exposure"][[1, 4]]
    assert abs((bright.mean() - dark.mean()) / EV - 1.1) < 0.25  # 0.7 of an sRGB value is about half of the light
    # the last digits of a logarithm depend on the processor, and what is trained begins with these
    assert np.array_equal(found.measured["exposure"], np.round(found.measured["exposure"], 4))
    assert found.of["pose_refinement"].called_for is False
    assert found.of["rolling_shutter"].words == "not measured: no video, or hardly any motion"
    for name, evidence in found.of.items():
        assert np.isfinite(evidence.value) and evidence.words, name
    assert set(found.seconds) == set(found.of) and min(found.seconds.values()) > 0


def test_no_evidence_without_points(tmp_path: Path, progress: RecordedProgress) -> None:
    scene, points = photographed_points(tmp_path)
    found = scene_statistics(tmp_path, scene, without_points(points), {}, progress).of
    unsure = {name for name, evidence in found.items() if evidence.called_for is None}
    assert unsure == {"exposure", "view_dependence", "pose_refinement"}
    assert [name for name, evidence in found.items() if evidence.called_for] == ["background"]


def test_focal_length_and_principal_point() -> None:
    camera = Camera("OPENCV", 100, 80, (50.0, 52.0, 49.0, 41.0, 0.1, 0.0, 0.0, 0.0))
    assert mean_focal_and_centre(camera) == (51.0, (49.0, 41.0))
