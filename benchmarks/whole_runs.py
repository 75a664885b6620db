"""What `pipeline run` takes and gives on whole sets, photos to report.

    python -m benchmarks.whole_runs ../shared/data demo fox fountain_p11 --workspaces /tmp/whole [-- --train.seconds 30]

Each set is run in a fresh workspace; "demo" is `pipeline demo`. What stands after ``--`` goes to the command. A run
that FOLDER holds already is not made again. Run it on an idle machine.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from benchmarks.nerfacto import pipeline
from benchmarks.record import Record, add_out
from stages.io.files import read_json

SECONDS = ("sfm", "train", "evaluate", "render", "mesh")


def whole_seconds(name: str, data: Path, root: Path, options: list[str]) -> float:
    """Of the command, the start of Python included; from the last time where it was run before."""
    record = root.with_suffix(".seconds.json")
    if not record.exists():
        command = ["demo"] if name == "demo" else ["run", data / name]
        began = time.monotonic()
        pipeline(*command, "-o", root, *options)
        record.write_text(json.dumps(time.monotonic() - began))
    return json.loads(record.read_text())


def figures(name: str, root: Path, seconds: float) -> dict[str, Any]:
    """The row of a finished run."""
    keys = read_json(root / "run.json")["keys"]
    manifests = {stage: read_json(root / stage / key[:16] / "manifest.json") for stage, key in keys.items() if key}
    sfm = manifests["sfm"]["facts"]
    found = {key: sfm[key] for key in ("camera_model", "reprojection_px", "points")}
    row = {"set": name, "registered": f"{sfm['registered']}/{sfm['photos']}", **found, "whole_seconds": round(seconds)}
    row |= {f"{stage}_seconds": round(manifests[stage]["seconds"]) for stage in SECONDS if stage in manifests}
    if "train" in manifests:
        row |= {key: manifests["train"]["facts"][key] for key in ("steps", "rays_per_second")}
    if "evaluate" in manifests:
        metrics = read_json(root / "output" / "metrics.json")
        row |= {key: metrics[key] for key in ("psnr", "ssim", "fraction")}
        row["width_share"] = metrics["trained_size"][0] / metrics["scored_size"][0]
        row["above_nearest_db"] = round(metrics["psnr"] - metrics["psnr_nearest_view"], 1)
    return row


def main() -> None:
    """Run every set and record it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the folder of the sets")
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--workspaces", type=Path, required=True)
    add_out(parser)
    given, options = parser.parse_known_args()
    given.workspaces.mkdir(parents=True, exist_ok=True)
    record = Record(given.out)
    for name in given.sets:
        folder = (given.workspaces / name).absolute()
        seconds = whole_seconds(name, given.data.absolute(), folder, [word for word in options if word != "--"])
        record.add(**figures(name, folder / "demo.nerf" if name == "demo" else folder, seconds))


if __name__ == "__main__":
    main()
