"""What a study shows, from the content of tradeoff.json: the plot of quality against training time with its Pareto
front, the table, and the sheet of the ablation. Equal data gives equal bytes."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from stages.io.amounts import duration, resolution_name
from stages.io.figures import INK, svg_element, svg_figure
from stages.io.files import check_png_encoder

COLUMNS = ("", "field", "photos", "steps", "training", "a frame", "peak memory", "model", "PSNR (dB)", "SSIM", "seeds")
# Marker, colour and name of each family; colours of Okabe and Ito, which the colour-blind tell apart, too.
FAMILIES = {
    "grid": ("o", "#0072b2", "feature grid (small, middle, large)"),
    "grid samples": ("s", "#56b4e9", "feature grid, other samples per ray"),
    "vanilla": ("D", "#d55e00", "vanilla NeRF, reduced"),
    "ablation": ("v", "#cc79a7", "reduced, a part left out"),
    "published": ("P", "#e69f00", "vanilla NeRF, published"),
    "workspace": ("*", "#009e73", "this workspace's field"),
}
SIZE = (10.5, 6.2)  # inches
MARKER = 6.5  # points
MARKER_SCALES = {"small grid": 0.7, "large grid": 1.4, "this workspace's field": 1.8}
NAMES_WIDTH = 0.32  # of the axis of the times: room at the left for the first name
TICKS = [*(k * 10.0**e for e in (-2, -1, 0) for k in (1, 2, 5)), 10.0, 20.0, 30.0]
TICKS += [*(60.0 * k for k in (1, 2, 5, 10, 20, 30)), *(3600.0 * k for k in (1, 2, 5, 10, 20))]
FONT_SIZE = 8.5  # points, of labels
NUMBER_SIZE = FONT_SIZE - 1.5  # points, of other points' numbers
CHARACTER_WIDTH = 0.6  # of its size
LINE_SPACING = 1.25  # lines between labels of the front
DPI = 160
STRIP_HEIGHT = 192  # pixels of a photo's height in the sheet
CHARACTERS_PER_INCH = 14  # of FONT_SIZE points, about


class Row(NamedTuple):
    """A row of the ablation's sheet: what it shows, lines of words below that, a picture with photos side by side."""

    name: str
    words: tuple[str, ...]
    strip: Path


class Label(NamedTuple):
    """Where the label of some points stands, in points of 1/72 inch, and their numbers."""

    x: float
    y: float
    numbers: tuple[int, ...]


def write_plot(study: dict[str, Any], folder: Path) -> None:
    """tradeoff.svg and tradeoff.png, on white."""
    check_png_encoder()
    with svg_figure(SIZE, "tradeoff") as figure:
        draw(figure, study)
        figure.suptitle(study["headline"], x=0.02, ha="left", size=12)
        ink, paper = "#1d2025", "#ffffff"
        figure.savefig(folder / "tradeoff.png", dpi=DPI, facecolor=paper, metadata={"Software": None})
        svg = svg_element(figure).replace("currentColor", ink)
    text = svg.replace("<svg ", f'<svg style="background: {paper}; font-family: sans-serif" ', 1)
    (folder / "tradeoff.svg").write_text(text, "utf-8")


def plot_svg(study: dict[str, Any]) -> str:
    """The same plot as an element of a page, in the page's own colours."""
    with svg_figure(SIZE, "tradeoff") as figure:
        draw(figure, study)
        return svg_element(figure)


def draw(figure: Figure, study: dict[str, Any]) -> None:
    """PSNR against training time; the front as a line with names, other points with their number in the table."""
    axes = figure.add_subplot()
    rows = study["points"]
    front = [row for row in rows if row["pareto_front"]]
    axes.set_xscale("log")
    for family, (marker, colour, name) in FAMILIES.items():
        members = [row for row in rows if row["family"] == family]
        for row in members:
            spread, size = row["psnr_std"] or 0.0, MARKER * MARKER_SCALES.get(row["variant"], 1.0)
            axes.errorbar(row["train_seconds"], row["psnr"], spread, fmt=marker, color=colour, ms=size, lw=1, zorder=3)
        if members:
            axes.plot([], [], marker, color=colour, ms=MARKER, label=name)
    axes.step(
        *([row[key] for row in front] for key in ("train_seconds", "psnr")), where="post", color=INK, lw=1.3, alpha=0.6
    )
    recommended = rows[study["recommended"] - 1]
    ring = {"s": 190, "facecolors": "none", "edgecolors": INK, "linewidths": 1.6, "zorder": 4}
    axes.scatter([recommended["train_seconds"]], [recommended["psnr"]], label="recommended", **ring)
    _set_axes(axes, rows)
    _label_front(axes, front)
    _label_others(axes, rows)
    axes.legend(
        frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2, fontsize=FONT_SIZE + 0.5
    )


def _set_axes(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Axes with lines at round times, and room at the left of the front for its names."""
    times, scores = [row["train_seconds"] for row in rows], [row["psnr"] for row in rows]
    first, last = min(times) / 2, max(times) * 1.25
    ticks = [tick for tick in TICKS if first <= tick <= last]
    axes.set_xticks(ticks, [duration(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    room = 0.06 * (max(scores) - min(scores)) + 0.1
    axes.set_xlim(min(times) / (max(times) / min(times) * 2) ** NAMES_WIDTH, last)
    axes.set_ylim(min(scores) - room, max(scores) + 2 * room)
    axes.set_xlabel("training time on this machine")
    axes.set_ylabel("PSNR on test photos (dB)")
    axes.grid(color=INK, alpha=0.12, lw=0.8)


def _label_others(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Numbers at the lower right of the other points, those of points that lie together side by side: ``17, 18``."""
    style = {"textcoords": "offset points", "size": NUMBER_SIZE, "alpha": 0.75, "ha": "left", "va": "top"}
    (low, high), (left, right) = axes.get_ylim(), axes.get_xlim()
    width, height = (72 * 0.8 * inches for inches in SIZE)

    def place(row: dict[str, Any]) -> tuple[float, float]:
        """In points, about."""
        across = math.log(row["train_seconds"] / left) / math.log(right / left)
        return width * across, height * (row["psnr"] - low) / (high - low)

    labels = [Label(*place(row), (row["number"],)) for row in rows if not row["pareto_front"]]
    for x, y, numbers in merge_labels(labels):
        at = left * (right / left) ** (x / width), low + (high - low) * y / height
        axes.annotate(", ".join(map(str, numbers)), at, (4, -2), **style)


def merge_labels(labels: Sequence[Label]) -> list[Label]:
    """``labels`` with overlapping ones merged into one with all their numbers, at the rightmost place of theirs."""
    merged: list[Label] = []
    for label in sorted(labels):
        while near := next((other for other in merged if _overlap(label, other)), None):
            merged.remove(near)
            x, y = max(near, label)[:2]
            label = Label(x, y, tuple(sorted(near.numbers + label.numbers)))
        merged.append(label)
    return merged


def _overlap(label: Label, other: Label) -> bool:
    first, second = sorted((label, other))
    wide = CHARACTER_WIDTH * NUMBER_SIZE * len(", ".join(map(str, first.numbers)))
    return second.x - first.x < wide and abs(second.y - first.y) < LINE_SPACING * NUMBER_SIZE


def _label_front(axes: Axes, front: Sequence[dict[str, Any]]) -> None:
    """Names at the upper left of the front's points, where nothing lies, from the fastest on, none on another."""
    (low, high), (left, right) = axes.get_ylim(), axes.get_xlim()
    line, y = (high - low) * LINE_SPACING * FONT_SIZE / (72 * 0.8 * SIZE[1]), low
    for row in front:
        name = f"{row['number']}  {row['label']}"
        x, y = row["train_seconds"] / (right / left) ** 0.02, max(row["psnr"] + 0.5 * line, y + line)
        axes.annotate(
            name,
            (row["train_seconds"], row["psnr"]),
            (x, y),
            size=FONT_SIZE,
            ha="right",
            va="center",
            arrowprops={"arrowstyle": "-", "color": INK, "alpha": 0.35, "lw": 0.6, "shrinkA": 0, "shrinkB": 3},
        )
    axes.set_ylim(low, max(high, y + line))


def write_sheet(rows: Sequence[Row], line: str, path: Path) -> None:
    """The rows one below the other, each with its words at the left, photos enlarged without smoothing; below them
    the ``line``."""
    strips = [Image.open(row.strip).convert("RGB") for row in rows]
    tall, names = STRIP_HEIGHT / DPI, 2.1  # inches of a row and of the margin for names
    width = names + tall * strips[0].width / strips[0].height
    lines = textwrap.wrap(line, int(CHARACTERS_PER_INCH * width))
    foot = (len(lines) + 1) * LINE_SPACING * FONT_SIZE / 72
    height = len(rows) * tall + foot
    with svg_figure((width, height), "ablation") as figure:
        figure.set_layout_engine("none")  # every axes has its place below
        for number, (row, strip) in enumerate(zip(rows, strips, strict=True)):
            bottom = 1 - (number + 1) * tall / height
            axes = figure.add_axes((names / width, bottom, 1 - names / width, 0.97 * tall / height))
            axes.imshow(strip, interpolation="nearest", aspect="auto")
            axes.set_axis_off()
            words = "\n".join([row.name, *row.words])
            axes.text(-0.02, 0.5, words, transform=axes.transAxes, ha="right", va="center", size=9.5)
        figure.text(0.5, 0.5 * foot / height, "\n".join(lines), ha="center", va="center", size=FONT_SIZE)
        figure.savefig(path, dpi=DPI, facecolor="#ffffff", metadata={"Software": None})


def markdown(study: dict[str, Any]) -> str:
    """tradeoff.md: the recommendation and the table. Bold rows are on the Pareto front."""
    lines = [study["recommendation"], "", f"Train it: `{study['command']}`", "", f"Scored on {study['scored']}.", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for row in study["points"]:
        shown = [f"**{cell}**" if row["pareto_front"] else cell for cell in table_cells(row)]
        lines.append("| " + " | ".join(shown) + " |")
    lines += ["", rendering_sentence(study["points"]), "", f"Fields: {study['descriptions']}."]
    if study["ablation"]:
        lines += ["", study["ablation"]]
    if study["left_out"]:
        lines += ["", f"Left out, for lack of time unless a reason is given: {'; '.join(study['left_out'])}."]
    return "\n".join(lines) + "\n"


def rendering_sentence(rows: Sequence[dict[str, Any]]) -> str:
    """What the Pareto front does not tell."""
    row = next(row for row in rows if row["fastest_to_render"])
    return (
        "The Pareto front is of training time and quality only. "
        f"Of its points number {row['number']} renders fastest, {row['frame_seconds']:.2f} s a frame (◂)."
    )


def table_cells(row: dict[str, Any]) -> list[str]:
    """A point's row of the table, as COLUMNS has it."""
    psnr_std = "" if row["psnr_std"] is None else f" ± {row['psnr_std']:.2f}"
    ssim_std = "" if row["ssim_std"] is None else f" ± {row['ssim_std']:.3f}"
    return [
        str(row["number"]),
        row["variant"] + " ★" * (row["family"] == "workspace"),
        resolution_name(row["downscale"]),
        f"{row['steps']:,}",
        f"{row['train_seconds']:.1f} s",
        f"{row['frame_seconds']:.2f} s" + " ◂" * row["fastest_to_render"],
        "–" if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:,.0f} MB",
        f"{row['model_mb']:.1f} MB",
        f"{row['psnr']:.2f}{psnr_std}",
        "–" if row["ssim"] is None else f"{row['ssim']:.3f}{ssim_std}",
        str(row["seeds"]),
    ]
