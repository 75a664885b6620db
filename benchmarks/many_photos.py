"""How the seconds of every stage and the memory grow with the number of photos.

    python -m benchmarks.many_photos FOLDER [--photos 50 100 200 400 1000] [--steps 300] [--plot FILE.png]

Draws streets of photos of 320 × 240 (see benchmarks/retrieval) into FOLDER/N/photos, their names in random order, and
runs ``pipeline run`` with so many steps on each. A set that FOLDER holds already is not drawn or run again: to kill and
resume a run is to call this again. A row: registered photos, the largest distance of a camera from the truth in percent
of the street's length, seconds of each stage, and the largest resident memory of all processes together.

The last row has the exponents: seconds ∝ photos^exponent between the two largest sets.
"""

import argparse
import json
import math
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.record import Record, add_out
from benchmarks.retrieval import draw
from nerf.geometry.alignment import align
from pipeline.engine.stage_list import STAGES
from stages.io.files import read_json
from stages.io.photos import read_photos
from stages.sfm.colmap.models import read_model

SAMPLE_SECONDS = 0.5


def resident_gb(parent: int) -> float:
    """Memory that a process and all below it hold; pages that they share count once for each of them."""
    rows = [line.split() for line in subprocess.check_output(["ps", "-eo", "pid=,ppid=,rss="], text=True).splitlines()]
    family, size = {parent}, -1
    while len(family) > size:
        size = len(family)
        family |= {int(pid) for pid, above, _ in rows if int(above) in family}
    return sum(int(rss) for pid, _, rss in rows if int(pid) in family) * 1024 / 1e9


def run(photos: Path, workspace: Path, steps: int) -> float:
    """Run the pipeline; the largest memory, which a file beside the workspace keeps over several tries."""
    kept = workspace.with_suffix(".gb.json")
    peak = json.loads(kept.read_text()) if kept.exists() else 0.0
    words = ["run", photos, "-o", workspace, "--train.steps", steps]
    with subprocess.Popen([sys.executable, "-m", "pipeline", *map(str, words)]) as process:
        over = threading.Event()
        while process.poll() is None:
            peak = max(peak, resident_gb(process.pid))
            kept.write_text(json.dumps(peak))
            over.wait(SAMPLE_SECONDS)
    if process.returncode not in (0, STAGES["mesh"].exit_code):  # so few steps may make no surface
        raise SystemExit(f"pipeline run ended with {process.returncode}")
    return peak


def figures(workspace: Path, truth: dict[str, np.ndarray], peak_gb: float) -> dict[str, Any]:
    """The row of a finished run."""
    keys = read_json(workspace / "run.json")["keys"]
    folders = {stage: workspace / stage / key[:16] for stage, key in keys.items() if key}
    names = {photo.image_name: photo.name for photo in read_photos(folders["ingest"])}
    images = read_model(folders["sfm"] / "sparse").images
    found = np.stack([image.sfm_from_camera[:, 3] for image in images])
    true = np.stack([truth[names[image.file]][:, 3] for image in images])
    off = np.linalg.norm(align(found, true).points(found) - true, axis=1) / np.ptp(true[:, 0])
    manifests = {stage: folder / "manifest.json" for stage, folder in folders.items()}
    seconds = {stage: read_json(file)["seconds"] for stage, file in manifests.items() if file.exists()}
    return {
        "photos": len(truth),
        "registered": len(images),
        "centres_max_percent": round(100 * float(off.max()), 3),
        **{f"{stage}_seconds": round(value, 1) for stage, value in seconds.items()},
        "memory_gb": round(peak_gb, 2),
    }


def exponents(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of photos, between the last two rows, for every figure that is measured in seconds or bytes; a row as well."""
    below, above = rows[-2:]
    steps = math.log(above["photos"] / below["photos"])
    grows = [key for key in above if key.endswith(("_seconds", "_gb")) and below.get(key)]
    powers = {key: round(math.log(above[key] / below[key]) / steps, 2) for key in grows}
    return {"photos": f"exponent, {below['photos']} to {above['photos']}"} | powers


def plot(rows: list[dict[str, Any]], file: Path) -> None:
    """Seconds of every stage against photos, both axes logarithmic, beside what grows in proportion."""
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    photos = [row["photos"] for row in rows]
    for key in (f"{stage}_seconds" for stage in STAGES):
        if key in rows[-1]:
            axes.loglog(photos, [row.get(key) for row in rows], marker="o", label=key.removesuffix("_seconds"))
    each = rows[0]["sfm_seconds"] / rows[0]["photos"]
    axes.loglog(photos, [each * count for count in photos], "k:", label="∝ photos")
    axes.set(xlabel="photos", ylabel="seconds")
    figure.legend(loc="outside right upper", fontsize=8)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Draw, run and record every size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 100, 200, 400, 1000])
    parser.add_argument("--steps", type=int, default=300, help="of training, the same for every size")
    parser.add_argument("--plot", type=Path)
    add_out(parser)
    given = parser.parse_args()
    record, rows = Record(given.out), list[dict[str, Any]]()
    for count in sorted(given.photos):
        folder = given.folder / str(count)
        folder.mkdir(parents=True, exist_ok=True)
        truth = draw(folder / "photos", count)
        workspace = folder / "photos.nerf"
        rows.append(figures(workspace, truth, run(folder / "photos", workspace, given.steps)))
        record.add(**rows[-1])
    if len(rows) > 1:
        record.add(**exponents(rows))
    if given.plot:
        plot(rows, given.plot)


if __name__ == "__main__":
    main()
