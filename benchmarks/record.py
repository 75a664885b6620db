"""Figures of a benchmark: printed as a table while they come, kept as JSON with ``--out``.

The JSON says how the figures were made: command, date, machine, commit. ``python -m benchmarks.results`` makes
docs/results.md of the files in benchmarks/results. A figure is a number, a text, None, or [value, ± deviation].
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

from pipeline.engine import machine

Figures = Mapping[str, Any]

COLUMNS = {  # key: heading, format
    "psnr": ("PSNR (dB)", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "seconds": ("s", ","),
    "frame_seconds": ("frame (s)", ",.2f"),
    "rays_per_second": ("rays/s", ",.0f"),
    "reprojection_px": ("reprojection (px)", ".2f"),
    "width_share": ("width", ".0%"),
}
UNITS = {  # last word of a key: unit, format
    "seconds": ("s", ","),
    "px": ("px", ","),
    "mm": ("mm", ".2f"),
    "deg": ("°", ".3f"),
    "db": ("dB", ","),
    "gb": ("GB", ","),
    "ms": ("ms", ","),
    "percent": ("%", ","),
}


SETS = ("fountain_p11", "herzjesu_p8", "lego_400", "sceaux_castle")  # not two words


def column(key: str) -> tuple[str, str]:
    """Heading and format of a figure: ``train_seconds`` is "train (s)"."""
    if key in COLUMNS:
        return COLUMNS[key]
    words, _, last = key.rpartition("_")
    unit, form = UNITS.get(last, ("", ","))
    name = words if words and unit else key
    name = name if name in SETS else name.replace("_", " ")
    return (f"{name} ({unit})" if words and unit else name), form


def cell(key: str, value: Any) -> str:
    """A figure as a table shows it."""
    if value is None or value is False:
        return ""
    if isinstance(value, list):
        return " ± ".join(cell(key, part) for part in value)
    return format(value, column(key)[1]) if isinstance(value, int | float) else str(value)


def written(figures: Figures) -> dict[str, str]:
    """Figures as a table shows them."""
    return {key: cell(key, value) for key, value in figures.items()}


def table_head(keys: list[str]) -> str:
    """The first two lines of a table."""
    return f"| {' | '.join(column(key)[0] for key in keys)} |\n|{'---|' * len(keys)}"


def table_row(keys: list[str], figures: Figures) -> str:
    """A line of a table."""
    return f"| {' | '.join(cell(key, figures.get(key)) for key in keys)} |"


def add_out(parser: argparse.ArgumentParser) -> None:
    """The option that every benchmark has."""
    parser.add_argument("--out", type=Path, help="JSON file for the figures; docs/results.md reads benchmarks/results")


class Record:
    """Prints figures as they come and keeps them in ``out``, if there is one."""

    def __init__(self, out: Path | None = None) -> None:
        self.out, self.figures = out, list[Figures]()

    def add(self, **figures: Any) -> None:
        """A row of the table. The first one names the columns."""
        if not self.figures:
            print(table_head(list(figures)))
        self.figures.append(figures)
        print(table_row(list(self.figures[0]), figures), flush=True)
        if self.out:
            self.out.write_text(as_json(provenance() | {"figures": self.figures}), "utf-8")


def provenance() -> dict[str, Any]:
    """Command, date, machine and commit of this process."""
    words = ["python", *sys.orig_argv[1:]]
    if "--out" in words:
        del words[words.index("--out") : words.index("--out") + 2]
    describe = ["git", "describe", "--always", "--dirty"]
    facts = machine.facts()
    commit = subprocess.run(describe, cwd=Path(__file__).parent, capture_output=True, text=True)
    return {
        "command": shlex.join(words),
        "date": str(date.today()),
        "machine": f"{cpu_name()}, {facts['cores']} cores, {facts['gpu'] or 'no GPU'}, torch {facts['torch']}",
        "commit": commit.stdout.strip() or "unknown",
    }


def cpu_name() -> str:
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown processor")


def as_json(record: Mapping[str, Any]) -> str:
    """JSON with a line for each row of figures."""
    head = [f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in record.items()][:-1]
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in record["figures"])
    return "{\n" + ",\n".join([*head, f' "figures": [\n{rows}\n ]']) + "\n}\n"
