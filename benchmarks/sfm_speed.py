"""How long ingest and sfm take beside COLMAP's own defaults, and whether the cameras are as good.

    python -m benchmarks.sfm_speed DATA [--sets fox fountain_p11]

DATA holds a folder per set with its photos in ``images``. COLMAP's defaults are pycolmap's: extract_features (full
resolution, 8192 features), match_exhaustive and incremental_mapping with no option given, all cores. Both run in turn
on the same machine. Printed are seconds of the wall clock, in all and for each part, and of the processors, which say
more where the machine does other work; what was registered, the mean reprojection error, and, where
``reference_cameras.json`` has measured cameras, the mean distance of the camera centres after the similarity that fits
them best and the mean angle between the rotations.

"""

import argparse
import json
import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from benchmarks.record import Record, add_out
from benchmarks.sfm_accuracy import errors
from stages import ingest, sfm
from stages.contract import run_stage
from stages.io.sparse_model import SparseModel
from stages.sfm.colmap.models import read_model


class Timed:
    """A Progress that prints what stays and remembers how long each kind of live line stood."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.last = ("starting", time.perf_counter())

    def update(self, message: str, done: float | None = None) -> None:
        """Account for the time since the last line."""
        kind, now = " ".join(re.sub(r"[\d,]+|of", "", message).split()), time.perf_counter()
        before, since = self.last
        self.seconds[before] = self.seconds.get(before, 0.0) + now - since
        self.last = (kind, now)

    def note(self, code: str, text: str) -> None:
        """Print the note."""
        print(f"    {text}", flush=True)

    def parts(self) -> str:
        """Seconds of each kind of line, rounded; they change twice a second."""
        return ", ".join(f"{kind} {seconds:.1f}" for kind, seconds in self.seconds.items() if seconds >= 0.05)


def colmaps_defaults(photos: Path, folder: Path) -> tuple[Path, dict[str, float]]:
    """The best model's folder, and seconds of each part."""
    database, parts, clock = folder / "database.db", {}, time.perf_counter
    begin = clock()
    pycolmap.extract_features(database, photos)
    parts["features"] = clock() - begin
    pycolmap.match_exhaustive(database)
    parts["matching"] = clock() - begin - sum(parts.values())
    models = pycolmap.incremental_mapping(database, photos, folder)
    parts["mapping"] = clock() - begin - sum(parts.values())
    best = folder / "best"
    best.mkdir()
    max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D())).write_binary(best)
    return best, parts


def ours(photos: Path, folder: Path) -> tuple[Path, dict[str, float], str]:
    """The model's folder, seconds of ingest and sfm, and how sfm's divide."""
    folders = {name: folder / name for name in ("ingest", "sfm")}
    folders["ingest"].mkdir()
    progress, begin = Timed(), time.perf_counter()
    ingest.run(ingest.Config(photos=photos), {}, folders["ingest"], progress)
    parts = {"ingest": time.perf_counter() - begin}
    progress = Timed()
    run_stage(sfm.STAGE, sfm.Config(), folders, folders["sfm"], progress)
    parts["sfm"] = time.perf_counter() - begin - parts["ingest"]
    return folders["sfm"] / "sparse", parts, progress.parts()


def quality(model: SparseModel, reference: Path) -> dict[str, Any]:
    """Registered photos, points and errors."""
    found = {"registered": len(model.images), "points": len(model.xyz), "reprojection_px": model.error_px.mean()}
    if not reference.exists():
        return found | {"centres_mm": None, "rotations_deg": None}
    millimetres, degrees = errors(model, json.loads(reference.read_text()), {})
    return found | {"centres_mm": millimetres.mean(), "rotations_deg": np.mean(degrees)}


def compare(data: Path, record: Record) -> None:
    """Run both on one set and record what came out."""
    for name in ("COLMAP's defaults", "ingest and sfm"):
        spent = sum(os.times()[:4])
        with tempfile.TemporaryDirectory() as scratch:
            if name == "ingest and sfm":
                sparse, parts, more = ours(data / "images", Path(scratch))
            else:
                sparse, parts, more = *colmaps_defaults(data / "images", Path(scratch)), ""
            found = quality(read_model(sparse), data / "reference_cameras.json")
        seconds, cpu_seconds = round(sum(parts.values()), 1), round(sum(os.times()[:4]) - spent, 1)
        line = ", ".join(f"{part} {each:.1f}" for part, each in parts.items())
        record.add(set=data.name, program=name, seconds=seconds, cpu_seconds=cpu_seconds, **found, parts=line)
        if more:
            print(f"    {more}")


def main() -> None:
    """Compare on every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="+", default=["fox", "fountain_p11"])
    add_out(parser)
    arguments = parser.parse_args()
    record = Record(arguments.out)
    pycolmap.logging.minloglevel = 2
    for name in arguments.sets:
        compare(arguments.data / name, record)


if __name__ == "__main__":
    main()
