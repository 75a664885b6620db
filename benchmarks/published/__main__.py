"""One command for each published table: ours in so many seconds of training, beside the figures of others.

    python -m benchmarks.published blender nerf_synthetic/lego nerf_synthetic/ship --workspaces /tmp/published \
        --out benchmarks/results/published.json [--seconds 60 300 900] [--plots docs/images]
    python -m benchmarks.published llff nerf_llff_data/fern --workspaces /tmp/published --out …
    python -m benchmarks.published mip360 360_v2/bonsai 360_v2/garden --workspaces /tmp/published --out …

protocols.py has the protocols: test photos, sizes, background. A folder is called as its scene, or begins with its name
and an underscore, as lego_400; "deviates" says in what such a folder, or a run on it, is not what the table asks for.
Every run is `pipeline train WORKSPACE --train.seconds S` and `pipeline evaluate` of all test photos, whole. Seconds are
those of training steps, as in the papers. A scene and seconds that --out has are not run again, and a killed run is
resumed; to run one anew, delete its row. Run it on an idle machine. `--field vanilla` trains the original NeRF.

literature.json has the figures of others with their sources. LPIPS (VGG) is computed where the package lpips is
installed and torch's cache holds VGG16; nothing is downloaded.
"""

import argparse
import json
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.nerfacto import pipeline, stage_folder
from benchmarks.published.lpips_distance import load_lpips, mean_lpips
from benchmarks.published.plot import draw
from benchmarks.published.protocols import SCENES, Case, deviations, find_case
from benchmarks.record import Figures, Record, add_out, provenance
from stages.io.files import read_json, read_scene

SECONDS = (60.0, 300.0, 900.0)
KEY = ("table", "scene", "method", "seconds")


def run(case: Case, workspace: Path, seconds: float, field: str, seed: int) -> Figures:
    """Train and score one scene; its row."""
    cameras = () if case.cameras is None else ("--cameras", case.cameras)
    exactly = "--sfm.no-adjust-poses"  # the table's cameras are what others had
    pipeline("run", case.photos, "-o", workspace, "--until", "normalise", *cameras, exactly)
    pipeline("train", workspace, f"--train.seconds={seconds:g}", f"--train.field={field}", f"--train.seed={seed}")
    over = ("--evaluate.background", "white") if case.table == "blender" else ()
    pipeline("evaluate", workspace, "--evaluate.fraction=1", f"--evaluate.downscale={case.downscale}", *over)
    folder, metrics = stage_folder(workspace, "metrics.json"), read_json(workspace / "output" / "metrics.json")
    train = stage_folder(workspace, "curve.json")
    facts = read_json(train / "manifest.json")["facts"]
    scene = read_scene(stage_folder(workspace, "scene.json"))
    made, (width, height) = provenance(), metrics["scored_size"]
    return {
        "table": case.table,
        "scene": case.scene,
        "method": field,
        "seconds": seconds,
        "psnr": round(metrics["psnr"], 2),
        "ssim": round(metrics["ssim"], 3),
        "lpips": mean_lpips(folder, stage_folder(workspace, "photos.json"), scene, load_lpips()),
        "steps": facts["steps"],
        "trained_size": "{} × {}".format(*metrics["trained_size"]),
        "deviates": "; ".join(deviations(case, scene, (width, height))) or None,
        **{name: made[name] for name in ("machine", "commit")},
        "date": str(date.today()),
    }


def earlier(out: Path | None) -> list[dict[str, Any]]:
    """The rows that a file has."""
    return json.loads(out.read_text("utf-8"))["figures"] if out and out.exists() else []


def main() -> None:
    """Run what is missing, print the table and draw the plots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=SCENES)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--seconds", type=float, nargs="+", default=SECONDS)
    parser.add_argument("--field", choices=("grid", "vanilla"), default="grid")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workspaces", type=Path, required=True, help="folder for a workspace per scene")
    parser.add_argument("--plots", type=Path, help="folder for published_TABLE.png")
    add_out(parser)
    given = parser.parse_args()
    cases = [find_case(given.table, folder) for folder in given.folders]
    record = Record(given.out)
    rows = earlier(given.out)
    for row in rows:
        record.add(**row)
    given.workspaces.mkdir(parents=True, exist_ok=True)
    for case in cases:
        for seconds in given.seconds:
            key = (case.table, case.scene, given.field, seconds)
            if key not in [tuple(row[name] for name in KEY) for row in rows]:
                workspace = (given.workspaces / f"{case.table}_{case.scene}.nerf").absolute()
                record.add(**run(case, workspace, seconds, given.field, given.seed))
    if given.plots:
        draw(given.table, record.figures, given.plots)


if __name__ == "__main__":
    main()
