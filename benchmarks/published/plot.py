"""PSNR against seconds of training on a log axis: ours as curves, others as points, a panel per scene."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.published.literature import OURS, published
from benchmarks.record import Figures
from stages.io.figures import svg_figure
from stages.io.files import check_png_encoder

PANEL = 6.4, 4.0  # inches
MAX_ACROSS = 2
COLOURS = ("#0b6bcb", "#6b4fbb")  # of ours, by field
OTHER = "#5a6068"
TICKS = {10: "10 s", 60: "1 min", 300: "5 min", 1800: "30 min", 7200: "2 h", 36_000: "10 h"}


def draw(table: str, rows: Sequence[Figures], folder: Path) -> Path | None:
    """Write published_TABLE.png; None where no scene of the table has been run."""
    rows = [row for row in rows if row["table"] == table]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    if not scenes:
        return None
    check_png_encoder()
    across, file = min(len(scenes), MAX_ACROSS), folder / f"published_{table}.png"
    down = -(-len(scenes) // across)
    folder.mkdir(parents=True, exist_ok=True)
    with svg_figure((PANEL[0] * across, PANEL[1] * down), file.stem) as figure:
        panels = figure.subplots(down, across, squeeze=False).flatten()
        for axes, scene in zip(panels, scenes, strict=False):
            _panel(axes, scene, [row for row in rows if row["scene"] == scene], published(table, scene))
        for axes in panels[len(scenes) :]:
            axes.set_visible(False)
        figure.savefig(file, dpi=130, facecolor="#ffffff", metadata={"Software": None})
    return file


def _panel(axes: Any, scene: str, ours: Sequence[Figures], others: Sequence[dict[str, Any]]) -> None:
    """Points of reruns where their seconds are known; else a dashed line at the paper's figure."""
    axes.set_xscale("log")
    for colour, (method, name) in zip(COLOURS, OURS.items(), strict=True):
        curve = sorted((row["seconds"], row["psnr"]) for row in ours if row["method"] == method)
        if curve:
            axes.plot(*zip(*curve, strict=True), "o-", color=colour, lw=2, ms=5.5, zorder=3)
            device = "CPU" if "no GPU" in ours[0]["machine"] else "GPU"
            axes.annotate(f"{name} ({device})", curve[0], (7, -4), textcoords="offset points", va="top", color=colour)
    for index, row in enumerate(others):
        if row["psnr"] is not None:
            at = row["seconds"], row["psnr"]
            axes.plot(*at, "s", color=OTHER, ms=5.5)
            axes.annotate(row["method"], at, (0, 6), textcoords="offset points", ha="center", size=9, color=OTHER)
        elif row["paper_psnr"] is not None:
            axes.axhline(row["paper_psnr"], color=OTHER, lw=1, ls="--")
            place = {"xycoords": axes.get_yaxis_transform(), "textcoords": "offset points"}
            axes.annotate(
                row["method"],
                (0.01 + 0.2 * (index % 5), row["paper_psnr"]),
                (0, 0),
                size=9,
                color=OTHER,
                va="center",
                bbox={"facecolor": "#ffffff", "edgecolor": "none", "pad": 1},  # over the lines of others beside it
                **place,
            )
    _set_axes(axes, [row["seconds"] for row in (*ours, *others) if row["seconds"]])
    axes.set_title("; ".join(filter(None, (scene, ours[0]["deviates"]))), size=9, loc="left", wrap=True)


def _set_axes(axes: Any, seconds: Sequence[float]) -> None:
    """Room for names, ticks at round times."""
    low, high = min(*seconds, 50) / 1.4, max(*seconds, 400) * 2
    axes.set_xlim(low, high)
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom - 0.05 * (top - bottom), top + 0.08 * (top - bottom))
    ticks = {tick: name for tick, name in TICKS.items() if low <= tick <= high}
    axes.set_xticks(list(ticks), list(ticks.values()))
    axes.set_xticks([], minor=True)
    axes.set_xlabel("training time (others: on a GPU)")
    axes.set_ylabel("PSNR of test photos (dB)")
    axes.grid(alpha=0.15, lw=0.8)
