"""How long ingest and sfm take beside COLMAP's own defaults, and whether the cameras are as good.

    python -m benchmarks.sfm_speed DATA [--sets fox fountain_p11]

DATA holds a folder per set with its photos in ``images``. COLMAP's defaults are pycolmap's: extract_features (full
resolution, 8192 features), match_exhaustive and incremental_mapping with no option given, all cores. Both run in turn
on the same machine. Printed are seconds of the wall clock, in all and for each part, and of the processors, which say
more where the machine does other work; what was registered, the mean reprojection error, and, where
``reference_cameras.json`` has measured cameras, the mean distance of the camera centres after the similarity that fits
them best and the mean angle between the rotations.

Figures are in docs/results.md.
"""

import argparse
import json
import os
import re
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks.sfm_accuracy import errors
from stages import ingest, sfm
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

    def note(self, message: str) -> None:
        """Print the note."""
        print(f"    {message}", flush=True)

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
    sfm.run(sfm.Config(), folders, folders["sfm"], progress)
    parts["sfm"] = time.perf_counter() - begin - parts["ingest"]
    return folders["sfm"] / "sparse", parts, progress.parts()


def quality(model: SparseModel, reference: Path) -> str:
    """Registered photos, points and errors in words."""
    words = f"{len(model.images)} registered, {len(model.xyz)} points, {model.error_px.mean():.2f} px"
    if not reference.exists():
        return words
    millimetres, degrees = errors(model, json.loads(reference.read_text()))
    return f"{words}, centres {millimetres.mean():.2f} mm, rotations {np.mean(degrees):.3f}°"


def compare(data: Path) -> None:
    """Run both on one set and print what came out."""
    totals = []
    for name in ("COLMAP's defaults", "ingest + sfm"):
        spent = sum(os.times()[:4])
        with tempfile.TemporaryDirectory() as scratch:
            if name == "ingest + sfm":
                sparse, parts, more = ours(data / "images", Path(scratch))
            else:
                sparse, parts, more = *colmaps_defaults(data / "images", Path(scratch)), ""
            words = quality(read_model(sparse), data / "reference_cameras.json")
        totals.append(np.array([sum(parts.values()), sum(os.times()[:4]) - spent]))
        line = ", ".join(f"{part} {seconds:.1f}" for part, seconds in parts.items())
        print(
            f"{data.name:14s} {name:18s} {totals[-1][0]:7.1f} s, processors {totals[-1][1]:.1f} s  ({line})  {words}",
            flush=True,
        )
        if more:
            print(f"    {more}")
    wall, processors = totals[1] / totals[0]
    print(f"{data.name:14s} ratio {wall:.2f}, of processor time {processors:.2f}", flush=True)


def main() -> None:
    """Compare on every set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="+", default=["fox", "fountain_p11"])
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    for name in arguments.sets:
        compare(arguments.data / name)


if __name__ == "__main__":
    main()
