"""Matplotlib figures whose SVG takes the page's colours: equal data gives equal bytes."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK = "#010203"  # drawn with this and then replaced by the page's own text colour


@contextmanager
def svg_figure(size: tuple[float, float], salt: str) -> Iterator[Figure]:
    """A figure to draw on, without pyplot's global state, whose identifiers depend on ``salt`` alone."""
    style: dict[Any, Any] = {"svg.hashsalt": salt, "svg.fonttype": "none", "font.size": 10.5}
    style |= {f"axes.spines.{side}": False for side in ("top", "right")}
    style |= dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK)
    with rc_context(style):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def svg_element(figure: Figure) -> str:
    """The figure as an element to be put into a page, transparent, scaling with its column."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, dpi=160, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # Matplotlib numbers its groups afresh in every figure; nothing refers to them and a page may hold each id once.
    text = re.sub(r' id="[\w.]+_\d+"', "", text)
    return re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", re.sub(r'(<svg [^>]*?)height="[^"]*"', r"\1", text))
