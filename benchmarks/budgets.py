"""Are budgets kept, and does more time never cost quality? ``python -m benchmarks.budgets DATA --workspaces FOLDER``

Runs ``pipeline run SET --budget B`` in a fresh workspace for every set and budget, alone and (``--burner``) beside a
process that keeps one core busy, and scores every field on all test photos at one downscale per set. Prints promised,
spent and dB. What is finished in FOLDER is not run again, so the benchmark can be stopped and started.
"""

import argparse
import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.record import Record, add_out
from pipeline.cli.durations import seconds_from

SETS = ("fox", "fountain_p11", "fern", "banana", "demo")
BUDGETS = ("2m", "5m", "15m")


def main() -> None:
    """Run everything that is asked for and print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("data", type=Path)
    options.add_argument("--workspaces", type=Path, required=True)
    options.add_argument("--sets", nargs="+", default=SETS)
    options.add_argument("--budgets", nargs="+", default=BUDGETS)
    options.add_argument("--burner", action="store_true", help="every run a second time, beside a CPU burner")
    add_out(options)
    given = options.parse_args()
    record = Record(given.out)
    for name in given.sets:
        for budget in given.budgets:
            for burning in (False, True) if given.burner else (False,):
                record.add(**_figures(name, budget, burning, given.data, given.workspaces))


def _figures(name: str, budget: str, burning: bool, data: Path, workspaces: Path) -> dict[str, Any]:
    folder = workspaces / f"{name}-{budget}{'-burner' if burning else ''}"
    promised, spent = seconds_from(budget), _spent(name, budget, burning, data, folder)
    root = folder / "demo.nerf" if name == "demo" else folder
    train, scored = _of(root, "train"), _score(root)
    return {
        "set": name,
        "budget": budget,
        "beside": "burner" if burning else "nothing",
        "spent_seconds": round(spent),
        "off_percent": round(100 * (spent / promised - 1), 1),
        "train_seconds": round(train["facts"]["train_seconds"]),
        "width_share": 1 / train["facts"]["downscale"],
        "psnr": scored,
    }


def _spent(name: str, budget: str, burning: bool, data: Path, folder: Path) -> float:
    """Wall seconds of the whole command, the start of Python included; from the last time where it was run before."""
    record = folder.with_suffix(".seconds.json")
    if record.exists():
        return json.loads(record.read_text())
    what = ["demo"] if name == "demo" else ["run", str(data / name)]
    with _burner(burning):
        began = time.monotonic()
        _pipeline(*what, "-o", str(folder), "--budget", budget)
        spent = time.monotonic() - began
    record.write_text(json.dumps(spent))
    return spent


def _score(root: Path) -> float:
    """PSNR of all pixels of all test photos, at their own size."""
    _pipeline("evaluate", str(root), "--evaluate.fraction", "1")
    return json.loads((root / "output/metrics.json").read_text())["psnr"]


def _pipeline(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "pipeline", *words], check=True, stdout=subprocess.DEVNULL)


def _of(root: Path, stage: str) -> dict[str, Any]:
    """The manifest of the stage's current result."""
    key = json.loads((root / "run.json").read_text())["keys"][stage]
    return json.loads((root / stage / key[:16] / "manifest.json").read_text())


@contextmanager
def _burner(burning: bool) -> Iterator[None]:
    """A process that keeps one core busy meanwhile."""
    process = multiprocessing.Process(target=_burn, daemon=True)
    if burning:
        process.start()
    try:
        yield
    finally:
        if burning:
            process.kill()
            process.join()


def _burn() -> None:
    while True:
        sum(range(10_000))


if __name__ == "__main__":
    main()
