"""The pictures of a study: quality against training time with the front that nothing beats, and the method's ablation.

Equal data gives equal bytes.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.live_line import duration
from stages.report_plots import INK, drawing, svg_element
from stages.tradeoff_arms import VARIANTS, resolution_words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Marker, colour and name of each family; colours of Okabe and Ito, which the colour-blind tell apart, too.
FAMILIES = {
    "grid": ("o", "#0072b2", "feature grid"),
    "grid samples": ("s", "#56b4e9", "feature grid, other samples per ray"),
    "paper": ("D", "#d55e00", "paper's networks, reduced"),
    "ablation": ("v", "#cc79a7", "reduced, a part left out"),
    "published": ("P", "#e69f00", "paper's networks, published"),
}
SIZE = (10.5, 6.2)  # inches
LETTER = 8.5  # points, of labels
GAP = 1.25  # lines between labels of the front
DPI = 160
SHOT = 192  # pixels of a window in the sheet


class Row(NamedTuple):
    """A row of the ablation's sheet: what it shows, its PSNR, a picture with the windows side by side."""

    name: str
    psnr: float | None
    strip: Path


def write_plot(study: dict[str, Any], folder: Path) -> None:
    """tradeoff.svg and tradeoff.png, on white."""
    with drawing(SIZE, "tradeoff") as figure:
        draw(figure, study)
        ink, paper = "#1d2025", "#ffffff"
        figure.savefig(folder / "tradeoff.png", dpi=DPI, facecolor=paper, metadata={"Software": None})
        svg = svg_element(figure).replace("currentColor", ink)
    text = svg.replace("<svg ", f'<svg style="background: {paper}; font-family: sans-serif" ', 1)
    (folder / "tradeoff.svg").write_text(text, "utf-8")


def plot_svg(study: dict[str, Any]) -> str:
    """The same plot as an element of a page, in the page's own colours."""
    with drawing(SIZE, "tradeoff") as figure:
        draw(figure, study)
        return svg_element(figure)


def draw(figure: "Figure", study: dict[str, Any]) -> None:
    """PSNR against training time; the front as a line with names, other points with their number in the table."""
    axes = figure.add_subplot()
    rows = study["points"]
    front = [row for row in rows if row["front"]]
    axes.set_xscale("log", base=2)
    for family, (marker, colour, name) in FAMILIES.items():
        own = [row for row in rows if VARIANTS[row["variant"]].family == family]
        if own:
            place = ([row["train_seconds"] for row in own], [row["psnr"] for row in own])
            spread = [row["deviation"] or 0.0 for row in own]
            axes.errorbar(*place, yerr=spread, fmt=marker, color=colour, ms=6.5, lw=1, zorder=3, label=name)
    axes.step(
        *([row[key] for row in front] for key in ("train_seconds", "psnr")), where="post", color=INK, lw=1.3, alpha=0.6
    )
    best = rows[study["recommended"] - 1]
    ring = {"s": 190, "facecolors": "none", "edgecolors": INK, "linewidths": 1.6, "zorder": 4}
    axes.scatter([best["train_seconds"]], [best["psnr"]], label="recommended", **ring)
    _frame(axes, rows)
    _number_the_others(axes, rows)
    _name_the_front(axes, front)
    axes.legend(frameon=False, loc="lower right", fontsize=LETTER + 0.5)


def _frame(axes: "Axes", rows: Sequence[dict[str, Any]]) -> None:
    """Axes with a line for each doubling of the time, and room at the left of the front for its names."""
    times, scores = [row["train_seconds"] for row in rows], [row["psnr"] for row in rows]
    low, high = math.floor(math.log2(min(times))), math.ceil(math.log2(max(times)))
    ticks = [2.0**power for power in range(low, high + 1)]
    axes.set_xticks(ticks, [duration(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    room = 0.06 * (max(scores) - min(scores)) + 0.1
    octaves = math.log2(max(times) / min(times)) + 1
    axes.set_xlim(min(times) / 2 ** (0.42 * octaves), max(times) * 1.25)
    axes.set_ylim(min(scores) - room, max(scores) + 2 * room)
    axes.set_xlabel("training time on this machine")
    axes.set_ylabel("PSNR on held-out photos (dB)")
    axes.grid(color=INK, alpha=0.12, lw=0.8)


def _number_the_others(axes: "Axes", rows: Sequence[dict[str, Any]]) -> None:
    style = {"textcoords": "offset points", "size": LETTER - 1.5, "alpha": 0.75, "ha": "left", "va": "top"}
    for row in rows:
        if not row["front"]:
            axes.annotate(str(row["number"]), (row["train_seconds"], row["psnr"]), (4, -2), **style)


def _name_the_front(axes: "Axes", front: Sequence[dict[str, Any]]) -> None:
    """Names at the upper left of the front's points, where nothing lies, from the best down, none on another."""
    low, high = axes.get_ylim()
    line = (high - low) * GAP * LETTER / (72 * 0.86 * SIZE[1])
    left, right = (math.log2(edge) for edge in axes.get_xlim())
    ceiling = high
    for row in reversed(front):
        name = f"{row['number']}  {row['variant']}, {resolution_words(row['downscale'])}"
        y = min(row["psnr"] + 0.5 * line, ceiling - line)
        ceiling = y
        x = 2 ** (math.log2(row["train_seconds"]) - 0.02 * (right - left))
        axes.annotate(
            name,
            (row["train_seconds"], row["psnr"]),
            (x, y),
            size=LETTER,
            ha="right",
            va="center",
            arrowprops={"arrowstyle": "-", "color": INK, "alpha": 0.35, "lw": 0.6, "shrinkA": 0, "shrinkB": 3},
        )


def write_sheet(rows: Sequence[Row], path: Path) -> None:
    """The rows one below the other, each under its name and PSNR at the left, windows enlarged without smoothing."""
    from PIL import Image

    strips = [Image.open(row.strip).convert("RGB") for row in rows]
    aspect = strips[0].width / strips[0].height
    tall = SHOT / DPI  # inches a row
    with drawing((aspect * tall + 2.1, len(rows) * tall), "ablation") as figure:
        figure.set_layout_engine("none")  # names stand in the margin
        grid = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
        share = 2.1 / (aspect * tall + 2.1)
        figure.subplots_adjust(left=share, right=1, bottom=0, top=1, hspace=0.03)
        for axes, row, strip in zip(grid, rows, strips, strict=True):
            axes.imshow(strip, interpolation="nearest", aspect="auto")
            axes.set_axis_off()
            score = "" if row.psnr is None else f"\n{row.psnr:.1f} dB"
            axes.text(-0.02, 0.5, row.name + score, transform=axes.transAxes, ha="right", va="center", size=9.5)
        figure.savefig(path, dpi=DPI, facecolor="#ffffff", metadata={"Software": None})
