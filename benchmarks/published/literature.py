"""The figures of others, and the page's table of theirs beside ours."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.record import Figures
from stages.io.amounts import duration

FILE = Path(__file__).with_suffix(".json")
TABLES = ("blender", "llff", "mip360")
METHODS = ("NeRF", "TensoRF", "instant-ngp", "nerfacto", "K-Planes", "3DGS", "Zip-NeRF")
OURS = {"grid": "ours", "vanilla": "ours, original NeRF"}


def published(table: str, scene: str) -> list[dict[str, Any]]:
    """What literature.json has of a scene."""
    figures = json.loads(FILE.read_text("utf-8"))["figures"]
    return [row for row in figures if (row["table"], row["scene"]) == (table, scene)]


def comparison(rows: Iterable[Figures]) -> str:
    """A row per scene: ours by seconds of training, then what others have."""
    rows = sorted(rows, key=lambda row: TABLES.index(row["table"]))
    ours = sorted({(row["method"], row["seconds"]) for row in rows})
    scenes = {(row["table"], row["scene"]): row["deviates"] for row in rows}
    others = {case: {row["method"]: row for row in published(*case)} for case in scenes}
    methods = [method for method in METHODS if any(method in found for found in others.values())]
    heads = ["scene", *(f"{OURS[method]}, {duration(seconds)}" for method, seconds in ours), *methods]
    lines = [heads, ["---"] * len(heads)]
    for case, deviates in scenes.items():
        runs = {(row["method"], row["seconds"]): row for row in rows if (row["table"], row["scene"]) == case}
        name = f"{case[1]}: {deviates}" if deviates else case[1]
        lines.append([name, *(_ours(runs.get(run)) for run in ours), *(_theirs(others[case].get(m)) for m in methods)])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _ours(row: Figures | None) -> str:
    """33.5 / 0.97."""
    return f"{row['psnr']:.2f} / {row['ssim']:.2f}" if row else ""


def _theirs(row: Mapping[str, Any] | None) -> str:
    """36.46 (36.49 in 10 min): the paper's figure, and that of the rerun; whichever is known."""
    if row is None:
        return ""
    rerun = f"{row['psnr']:.2f} in {duration(row['seconds'])}" if row["psnr"] is not None else ""
    paper = f"{row['paper_psnr']:.2f}" if row["paper_psnr"] is not None else ""
    return f"{paper} ({rerun})" if paper and rerun else paper or f"({rerun})"
