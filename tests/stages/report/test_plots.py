"""The plots: figures in words, geometry of the camera outlines, deterministic and theme-neutral SVG."""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba

from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.training.learning_curve import PredictedGain
from stages.report import plots
from stages.report.plots import ORDER_COLOURS, _outline, camera_svgs, curve_svg
from stages.train.curve import predicted_gain


def _scene(count: int = 9) -> Scene:
    """Cameras on a ring of radius two, looking inward, z up."""
    views = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        forward = np.array([-math.cos(angle), -math.sin(angle), 0])
        right = np.cross(forward, [0, 0, 1])
        pose = np.stack([right, np.cross(forward, right), forward, -2 * forward], axis=1)
        views.append(View(f"{i}.jpg", f"images/{i}.jpg", 0, pose, 0.5, 4.0, "train" if i % 8 else "test"))
    camera = Camera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    return Scene((camera,), tuple(views), Similarity(1.0, np.eye(3), np.zeros(3)), True, False, "object-centric", True)


def _curve() -> list[dict[str, Any]]:
    return [
        {
            "step": 100 * k,
            "seconds": float(2**k),
            "train_psnr": 10 + 2.0 * k,
            "probe_psnr": 9 + 1.5 * k if k % 2 else None,
        }
        for k in range(1, 8)
    ]


def test_plots_are_well_formed_and_the_same_twice():
    xyz = np.random.default_rng(0).normal(0, 0.4, (500, 3))
    rgb = np.random.default_rng(1).integers(0, 255, (500, 3))
    for draw in (
        lambda: curve_svg(_curve(), {"nearest training view": 14.2}),
        lambda: "".join(camera_svgs(_scene(), _scene().views, xyz, rgb, True).values()),
    ):
        svg = draw()
        assert svg == draw() and svg is not None
        ElementTree.fromstring(f"<p>{svg}</p>")
        assert "currentColor" in svg and "#010203" not in svg
        assert "<metadata" not in svg and "dc:date" not in svg


def test_plots_of_one_page_share_no_identifier():
    cameras = camera_svgs(_scene(), _scene().views, np.zeros((1, 3)), np.zeros((1, 3), np.uint8), True)
    ids = [re.findall(r'id="([^"]+)"', svg) for svg in (curve_svg(_curve(), {}) or "", *cameras.values())]
    assert all(ids)
    together = [name for plot in ids for name in plot]
    assert len(together) == len(set(together))


def test_the_curve_shows_prediction_and_knee():
    steep = curve_svg(_curve(), {}, predicted_gain("grid", True, _curve())) or ""
    assert "predicted" in steep and "diminishing returns" not in steep
    flat = [row | {"probe_psnr": 20 - 8 / row["seconds"]} for row in _curve()]
    assert "diminishing returns, 16 s" in (curve_svg(flat, {}) or "")
    unknown = [row | {"probe_psnr": None} for row in _curve()]
    assert predicted_gain("grid", True, unknown) is None
    assert predicted_gain("vanilla", True, _curve()) is None
    assert predicted_gain("grid", False, _curve()) is None
    assert "predicted" not in (curve_svg(unknown, {}) or "predicted")


def test_curve_names_its_lines_and_needs_two_points():
    svg = curve_svg(_curve(), {"nearest training view": 14.2, "mean image": None}) or ""
    assert "nearest training view" in svg and "14.2 dB" in svg and "mean image" not in svg
    assert curve_svg(_curve()[:1], {}) is None
    assert curve_svg([], {}) is None


def test_neighbouring_times_do_not_run_into_each_other():
    svg = curve_svg(_curve(), {}, predicted_gain("grid", True, _curve())) or ""
    times = [text for text in re.findall(r"<text[^>]*>([^<]+)</text>", svg) if re.fullmatch(r"[\d.]+ (s|min)", text)]
    assert {"2 min", "8 s", "4 min", "16 s"} <= set(times) and "min 8" not in svg


def test_the_prediction_lies_inside_the_plot(monkeypatch: pytest.MonkeyPatch):
    tops: list[float] = []
    monkeypatch.setattr(plots, "svg_element", lambda figure: str(tops.append(figure.axes[0].get_ylim()[1])))
    curve, coming = _curve(), PredictedGain(8.0, 0.5)
    curve_svg(curve, {"nearest training view": 14.2}, coming)
    assert curve[-1]["probe_psnr"] + 8.5 <= tops[0] < 40


def test_the_cameras_plot_says_up_where_known():
    scene = _scene()
    blind = Scene(scene.cameras, scene.views, scene.scene_from_sfm, True, False, "object-centric", False)
    points = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    assert list(camera_svgs(scene, scene.views, *points, True)) == ["from above", "from the side"]
    assert list(camera_svgs(blind, scene.views, *points, True)) == ["along z", "along y"]


def _drawn(views: Sequence[View], joined: bool, monkeypatch: pytest.MonkeyPatch) -> Axes:
    """What is drawn of the views from above."""
    drawn: list[Axes] = []
    monkeypatch.setattr(plots, "svg_element", lambda figure: str(drawn.append(figure.axes[0])))
    camera_svgs(_scene(), views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), joined)
    return drawn[0]


def test_cameras_are_joined_and_coloured_by_order(monkeypatch: pytest.MonkeyPatch):
    by_number = [replace(view, name=f"IMG_{8 + i}.jpg") for i, view in enumerate(_scene().views)]  # 8, 9, 10, …
    centres = np.array([view.scene_from_camera[:2, 3] for view in by_number])
    _, joins, outlines, test = _drawn(by_number[::-1], True, monkeypatch).collections
    assert isinstance(joins, LineCollection) and isinstance(outlines, LineCollection)
    assert np.allclose(joins.get_segments(), np.stack([centres[:-1], centres[1:]], axis=1))
    assert np.allclose([line[0] for line in outlines.get_segments()], centres)
    ends = [to_rgba(ORDER_COLOURS[0]), to_rgba(ORDER_COLOURS[-1])]
    assert np.allclose(np.asarray(outlines.get_colors())[[0, -1]], ends)
    assert np.allclose(np.asarray(test.get_offsets()), centres[[0, 8]]), "test photos have a dot"


def test_no_line_joins_folders_or_unordered_names(monkeypatch: pytest.MonkeyPatch):
    views = [replace(view, name=f"{'ab'[i // 5]}/{i}.jpg") for i, view in enumerate(_scene().views)]
    for joined, count in ((True, 7), (False, 0)):
        joins, outlines = _drawn(views, joined, monkeypatch).collections[1:3]
        assert isinstance(joins, LineCollection) and isinstance(outlines, LineCollection)
        assert (len(joins.get_segments()), len(outlines.get_segments())) == (count, 9)


def test_a_camera_outline_opens_by_its_field_of_view():
    scene = _scene()
    view = scene.views[3]
    outline = _outline(scene, view, 0.5)
    centre, forward = view.scene_from_camera[:, 3], view.scene_from_camera[:, 2]
    assert np.allclose(outline[0], centre)
    corners = outline[[1, 2, 4, 7]] - centre
    assert np.allclose(corners @ forward, 0.5)
    assert np.linalg.norm(outline[1] - outline[2]) == pytest.approx(0.5 * 640 / 500)
