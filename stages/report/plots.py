"""The report's plots as inline SVG: text and axes take the page's colour, and equal data is equal bytes."""

import math
import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Rectangle

from nerf import REGION_HALF_SIZE
from nerf.effects.statistics.exposure import EV
from nerf.effects.statistics.vignetting import log_falloff
from nerf.geometry.scene import Scene, View
from nerf.training.learning_curve import PredictedGain, diminishing_returns_seconds, quality_at
from stages.io.amounts import duration
from stages.io.figures import INK, svg_element, svg_figure
from stages.sfm.pairs.match_graph import natural_order
from stages.train.curve import probe_curve

BLUE, ORANGE, GREY = "#3b82f6", "#f2711c", "#8a8f98"
ORDER_COLOURS = (BLUE, "#9b5de5", "#e0457b", ORANGE, "#e0a800")  # from first to last, legible on light and dark pages

MAX_POINTS = 20_000
ROOM_BELOW = 0.08  # of the curve's height, so that the name of the lowest line stands clear of the times


class Score(NamedTuple):
    """PSNR of the finished field (dB), and the interval of that."""

    psnr: float
    interval: Sequence[float] | None


def curve_svg(
    points: Sequence[dict[str, Any]],
    baselines: dict[str, float | None],
    coming: PredictedGain | None = None,
    score: Score | None = None,
) -> str | None:
    """PSNR against training seconds, one grid line per doubling of the time, with the start of diminishing returns and
    the ``coming`` gain that the next doubling is predicted to bring; None for fewer than two points. ``baselines`` are
    drawn as horizontal lines under their names, the ``score`` of the finished field at the end of the curve.
    """
    rows = [row for row in points if row["seconds"] > 0]
    if len(rows) < 2:
        return None
    with svg_figure((8.2, 3.8), "curve") as figure:
        axes = figure.add_subplot()
        for key, label, colour in (("train_psnr", "training rays", GREY), ("probe_psnr", "test pixels", BLUE)):
            seen = [(row["seconds"], row[key]) for row in rows if row[key] is not None]
            if seen:
                axes.plot(*zip(*seen, strict=True), color=colour, lw=2, marker="o", ms=3, label=label)
        if coming is not None:
            _draw_prediction(axes, rows, coming)
        last = rows[-1]["seconds"] * (1 if coming is None else 2)
        _draw_diminishing_returns(axes, probe_curve(rows))
        if score is not None:
            _draw_score(axes, rows[-1]["seconds"], score)
        # Last, for they fix the limits, beyond which nothing is seen.
        _draw_baselines(axes, {name: psnr for name, psnr in baselines.items() if psnr is not None})
        _doubling_axis(axes, rows[0]["seconds"], rows[-1]["seconds"], last)
        axes.set(xlabel="training time", ylabel="PSNR (dB)")
        axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0)
        return svg_element(figure)


def _draw_prediction(axes: Axes, rows: Sequence[dict[str, Any]], coming: PredictedGain) -> None:
    """A dotted line on to twice the time, with its interval."""
    (seconds, psnr), style = probe_curve(rows)[-1], {"color": BLUE, "lw": 1.5, "ls": (0, (1, 1.5))}
    axes.plot([seconds, 2 * seconds], [psnr, psnr + coming.db], label="predicted", **style)
    axes.errorbar(2 * seconds, psnr + coming.db, coming.half_width, color=BLUE, capsize=4, lw=1.5)


def _draw_score(axes: Axes, seconds: float, score: Score) -> None:
    """What stage evaluate found, with its interval: of all test photos, where the curve knows some of their pixels."""
    low, high = score.interval or (score.psnr, score.psnr)
    style = {"color": INK, "fmt": "D", "ms": 6, "capsize": 4, "lw": 1.5, "zorder": 4}
    axes.errorbar(seconds, score.psnr, [[score.psnr - low], [high - score.psnr]], label="score, test photos", **style)


def _draw_diminishing_returns(axes: Axes, curve: Sequence[tuple[float, float]]) -> None:
    if (seconds := diminishing_returns_seconds(curve)) is not None:
        ring = {"color": "none", "mec": ORANGE, "ms": 11, "mew": 2}
        axes.plot(seconds, quality_at(curve, seconds), "o", label=f"diminishing returns, {duration(seconds)}", **ring)


def _draw_baselines(axes: Axes, baselines: dict[str, float]) -> None:
    """Horizontal lines named beside the plot, the highest above its line and the others below, so as not to collide."""
    for name, psnr in baselines.items():
        above = psnr == max(baselines.values())
        axes.axhline(psnr, color=ORANGE, lw=1, ls=(0, (4, 3)))
        place = {"transform": axes.get_yaxis_transform(), "va": "bottom" if above else "top", "size": 9.5}
        axes.text(1.01, psnr, f"{name}\n{psnr:.1f} dB", linespacing=1.1, **place)
    low, high = axes.get_ylim()
    axes.set_ylim(low - ROOM_BELOW * (high - low), high)


def falloff_svg(rows: Sequence[Sequence[float]]) -> str:
    """By how much light falls from the optical axis to the corner (EV), a line for each camera. ``rows``: those of
    effect vignetting in field.json."""
    distance = np.linspace(0, 1, 51)
    with svg_figure((5, 2.4), "falloff") as figure:
        axes = figure.add_subplot()
        for row in np.unique(np.array(rows), axis=0):
            axes.plot(distance, -log_falloff(distance**2, row[1:]) / EV, color=BLUE, lw=2)
        axes.set(xlabel="distance from the optical axis (1: the corner)", ylabel="gain (EV)", xlim=(0, 1))
        axes.grid(color=INK, alpha=0.15, lw=0.8)
        return svg_element(figure)


def camera_svgs(scene: Scene, views: Sequence[View], xyz: np.ndarray, rgb: np.ndarray, joined: bool) -> dict[str, str]:
    """Some ``views`` of the scene, coloured in the order of their names and ``joined`` in it or not, the sparse points
    (n, 3) in their colours and the region of interest, by the name of the projection.

    Orthographic projections along z and along y: from above and from the side where the scene knows its up.
    """
    ordered = [views[i] for i in natural_order([view.name for view in views])]
    names = ("from above", "from the side") if scene.up_known else ("along z", "along y")
    return {
        name: _layout_svg(name, scene, ordered, (0, axis), (xyz, rgb), joined)
        for name, axis in zip(names, (1, 2), strict=True)
    }


def _layout_svg(
    name: str,
    scene: Scene,
    views: Sequence[View],
    plane: tuple[int, int],
    points: tuple[np.ndarray, np.ndarray],
    joined: bool,
) -> str:
    """One projection, on the two given axes of the scene. Points beyond the cameras and the box are cut off."""
    centres = np.array([view.scene_from_camera[:, 3] for view in views])[:, plane]
    low, high = np.minimum(centres.min(0), -REGION_HALF_SIZE), np.maximum(centres.max(0), REGION_HALF_SIZE)
    middle, half = (low + high) / 2, (high - low) / 2 + 0.06 * (high - low).max()
    xyz, rgb = points
    shown = np.linspace(0, len(xyz) - 1, min(len(xyz), MAX_POINTS)).astype(int)
    with svg_figure((5, min(8.0, max(1.6, 5 * half[1] / half[0]))), name) as figure:
        axes = figure.add_subplot(aspect="equal")
        axes.scatter(*xyz[shown][:, plane].T, c=rgb[shown] / 255, s=2, lw=0, alpha=0.7, rasterized=True)
        axes.add_patch(
            Rectangle(
                (-REGION_HALF_SIZE, -REGION_HALF_SIZE),
                2 * REGION_HALF_SIZE,
                2 * REGION_HALF_SIZE,
                fill=False,
                ec=INK,
                ls="--",
                alpha=0.6,
            )
        )
        _draw_cameras(axes, scene, views, plane, 0.1 * half.max(), joined)
        axes.set(xlim=middle[0] + half[0] * np.array([-1, 1]), ylim=middle[1] + half[1] * np.array([-1, 1]))
        axes.set_axis_off()
        return svg_element(figure)


def _draw_cameras(
    axes: Axes, scene: Scene, views: Sequence[View], plane: tuple[int, int], depth: float, joined: bool
) -> None:
    """Outlines coloured from the first view to the last, test photos with a dot, and thin lines from each view to the
    next in the same folder: a jump between photos that follow each other is seen at once."""
    colours = LinearSegmentedColormap.from_list("order", ORDER_COLOURS)(np.linspace(0, 1, len(views)))
    centres = np.array([view.scene_from_camera[:, 3] for view in views])[:, plane]
    folders = [PurePosixPath(view.name).parent for view in views]
    steps = [i for i in range(1, len(views)) if joined and folders[i - 1] == folders[i]]
    lines = [centres[i - 1 : i + 1] for i in steps]
    axes.add_collection(LineCollection(lines, colors=colours[steps], lw=1, alpha=0.8, zorder=2))
    outlines = [_outline(scene, view, depth)[:, plane] for view in views]
    axes.add_collection(LineCollection(outlines, colors=colours, lw=0.9, zorder=3))
    test = [i for i, view in enumerate(views) if view.split == "test"]
    axes.scatter(*centres[test].T, c=colours[test], s=20, lw=0, zorder=4)


def _outline(scene: Scene, view: View, depth: float) -> np.ndarray:
    """The pyramid from the camera's centre to its image at ``depth``, as one line through all edges: (11, 3)."""
    camera = scene.cameras[view.camera]
    # COLMAP lists the focal length first in every camera model.
    x, y = (np.array([camera.width, camera.height]) / 2 / camera.params[0]) * depth
    corners = np.array([[-x, -y, depth], [x, -y, depth], [x, y, depth], [-x, y, depth], [0, 0, 0]])
    stroke = corners[[4, 0, 1, 4, 2, 1, 2, 3, 4, 3, 0]]
    return stroke @ view.scene_from_camera[:, :3].T + view.scene_from_camera[:, 3]


def _doubling_axis(axes: Axes, first: float, last: float, end: float) -> None:
    """A logarithmic time axis to ``end`` with ticks there, at ``last`` and at its halves, and the last half shaded."""
    ticks = [last / 2**k for k in range(max(1, min(8, math.ceil(math.log2(last / first)) + 1)))]
    ticks = [end, *ticks] if end > last else ticks
    axes.set_xscale("log", base=2)
    axes.set_xlim(min(first, ticks[-1]), end * 1.04)
    # On two lines, for neighbours would run into each other: "2 min" over "31 s".
    axes.set_xticks(ticks, [re.sub("(?<=[a-z]) ", "\n", duration(tick)) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.axvspan(last / 2, last, color=BLUE, alpha=0.08, lw=0)
    axes.grid(color=INK, alpha=0.15, lw=0.8)
