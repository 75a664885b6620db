"""What the simulation of a cluster is driven by (benchmarks/cluster_simulation.py), measured on this machine.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.cluster_costs [--photos PHOTOS] [--costs PHOTOS …]
        [--workspaces WORKSPACE …] [--graphs 500 1000 …] [--waits] [--out FILE]

``--photos`` has its features extracted and all its pairs matched without a cluster, and by Ray clusters of 1 and of 2
workers (rows "run"); before that, rows say what giving work away takes. ``--costs``: some photos of each set, by a
process on one core, and by two such processes at a time. ``--workspaces``: the phases of a finished stage sfm, by its
log. ``--graphs``: choosing the pairs of a round for so many photos.
``--waits``: pieces that only wait, by 1 to 4 workers. ``what`` tells the rows apart.
Needs Ray.
"""

import argparse
import multiprocessing
import os
import pickle
import re
import shutil
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from datetime import datetime, timedelta
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports] -- not part of what tests install

from benchmarks.cluster_simulation import RESULT_BYTES, WAITS
from benchmarks.nerfacto import pipeline
from benchmarks.record import Record, add_out
from pipeline.engine.workspace import Workspace
from stages.hardware import cluster
from stages.io.files import read_json
from stages.io.photos import Photo, read_photos, spread
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.features import Features, image_similarity, read_vocabulary
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import BLOCK_SIZE, STRICT_RATIO, match_pairs
from stages.sfm.pairs import MAX_EXHAUSTIVE
from stages.sfm.pairs.image_retrieval import CELLS, WORDS
from stages.sfm.pairs.match_graph import UNTESTED, next_pairs
from stages.sfm.pairs.pair_selection import exhaustive
from stages.sfm.pairs.quality_level import QUALITY_LEVELS

MEASURED_PHOTOS = 16
WORKERS = (1, 2)
PIECES, RESULTS = 300, 60
WAITING_PIECES, WAITING_WORKERS = 60, (1, 2, 4)
NEIGHBOURS = 30  # of a photo, as sfm has it
LOOKING_ALIKE = 10  # photos before and after each whose pairs are verified in the graphs that are measured
OPTIONS = ExtractionOptions(*QUALITY_LEVELS[0])
LOG_TIME = re.compile(r"^I(\d{8} \d\d:\d\d:\d\d\.\d+) ")


def seconds(work: Callable[[], object]) -> float:
    """Of the wall clock."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def core_seconds(work: Callable[[], object]) -> float:
    """Of a core, by all threads of this process: what else runs on the machine counts for little."""
    began = time.process_time()
    work()
    return time.process_time() - began


# --- what parts cost on one core


def ingested(photos: Path, folder: Path) -> tuple[Path, list[Photo]]:
    """Stage ingest's folder in a workspace below ``folder``, and its photos in the order of their files."""
    workspace = folder / "w.nerf"
    pipeline("run", photos, "-o", workspace, "--until", "ingest")
    ingest = Workspace(workspace).folder("ingest", Workspace(workspace).read_run().keys["ingest"])
    return ingest, sorted(read_photos(ingest), key=lambda photo: photo.file)


def sample(photos: list[Photo]) -> list[Photo]:
    """Photos to measure with: of a small set, whose pairs are all matched, from all over it; else neighbours."""
    count = min(MEASURED_PHOTOS, len(photos))
    chosen = spread(len(photos), count) if len(photos) <= MAX_EXHAUSTIVE else range(count)
    return [photos[number] for number in chosen]


def parts(ingest: Path, photos: list[Photo], core: int) -> dict[str, float]:
    """Seconds of this ``core`` for a photo: extracting features, writing, reading and indexing them, retrieval; for a
    pair: matching exactly and indexed, writing; for a vocabulary. Bytes of a photo's features as they are shared."""
    os.sched_setaffinity(0, {core})
    count, pairs = len(photos), exhaustive(len(photos))
    took = dict[str, float]()
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch, "a.db")
        fill_database(database, photos, MAPPING_MODEL)
        took["features"] = core_seconds(lambda: extract_features(database, ingest / "images", photos, OPTIONS)) / count
        words = read_vocabulary(database, count, 0, CELLS)
        took["vocabulary"] = core_seconds(lambda: read_vocabulary(database, count, 0, WORDS))
        similarity = core_seconds(lambda: image_similarity(database, count, 0))
        took["retrieval"] = max(0.0, similarity - took["vocabulary"]) / count
        copy = Path(scratch, "b.db")
        fill_database(copy, photos, MAPPING_MODEL)
        took["write features"] = core_seconds(lambda: copy_features(database, copy, count)) / count
        with pycolmap.Database.open(database) as db:
            for name, features in (("read", Features()), ("index", Features(words))):
                took[name] = core_seconds(lambda of=features: [of.read(db, number) for number in range(count)]) / count
                took[f"{name} bytes"] = len(pickle.dumps(features.read(db, 0)(), 5))
        shutil.copyfile(database, indexed := Path(scratch, "c.db"))
        for name, file, features in (("match", database, None), ("match indexed", indexed, Features(words))):
            took[name] = core_seconds(
                lambda of=features, to=file: match_pairs(to, pairs, 0, STRICT_RATIO, features=of)
            ) / len(pairs)
        took["write pair"] = core_seconds(lambda: copy_matches(database, copy)) / len(pairs)
    took["features"] -= took["write features"]
    took["match"] -= took["write pair"] + took["read"] * count / len(pairs)
    took["match indexed"] -= took["write pair"] + took["index"] * count / len(pairs)
    return took


def copy_features(source: Path, target: Path, count: int) -> None:
    """As the machine with the command writes them."""
    with pycolmap.Database.open(source) as read, pycolmap.Database.open(target) as written:
        for number in range(1, count + 1):
            with pycolmap.DatabaseTransaction(written):
                written.write_keypoints(number, np.array(read.read_keypoints(number)))
                written.write_descriptors(number, read.read_descriptors(number))


def copy_matches(source: Path, target: Path) -> None:
    """As the machine with the command writes them, a transaction for each block."""
    with pycolmap.Database.open(source) as read, pycolmap.Database.open(target) as written:
        every = [pycolmap.pair_id_to_image_pair(pair) for pair in read.read_all_matches()[0]]
        for begin in range(0, len(every), BLOCK_SIZE):
            with pycolmap.DatabaseTransaction(written):
                for pair in every[begin : begin + BLOCK_SIZE]:
                    written.write_matches(*pair, read.read_matches(*pair))
                    written.write_two_view_geometry(*pair, read.read_two_view_geometry(*pair))


def add_costs(record: Record, sets: Sequence[Path]) -> None:
    """A row for each set and for one and two cores that are busy with it."""
    for of in sets:
        with tempfile.TemporaryDirectory() as scratch:
            ingest, photos = ingested(of, Path(scratch))
            some = sample(photos)
            size = {"pixels": some[0].width * some[0].height}
            size["file_bytes"] = round(float(np.mean([(ingest / photo.file).stat().st_size for photo in some])))
            for busy in WORKERS:
                with ProcessPoolExecutor(busy, multiprocessing.get_context("spawn")) as pool:
                    each = list(pool.map(parts, [ingest] * busy, [some] * busy, range(busy)))
                mean = {f"{key}_seconds": round(float(np.mean([one[key] for one in each])), 5) for key in each[0]}
                mean = {key.replace(" bytes_seconds", "_bytes").replace(" ", "_"): x for key, x in mean.items()}
                record.add(what="costs", set=name_of(of), photos=len(some), busy_cores=busy, **size, **mean)


def name_of(photos: Path) -> str:
    """What the set is called."""
    return photos.parent.name if photos.name == "images" else photos.name


# --- giving work away


def some_bytes(item: int) -> np.ndarray:
    """A result of the size of two photos' features."""
    return np.zeros(RESULT_BYTES, np.uint8)


def with_shared(of: Callable[[], np.ndarray]) -> int:
    """Work with a value that was shared."""
    return len(of())


def wait(seconds: float) -> np.ndarray:
    """Work that leaves the cores to others, so that it takes as long by many workers of this machine."""
    time.sleep(seconds)
    return np.zeros(RESULT_BYTES, np.uint8)


@contextmanager
def ray_cluster(workers: int) -> Iterator[str]:
    """The address of a cluster of so many machines with a core each, all of them this one."""
    machine: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 10**9}
    made = Cluster(initialize_head=True, head_node_args=machine | {"include_dashboard": False})
    for _ in range(workers - 1):
        made.add_node(**machine)
    try:
        yield str(made.address)
    finally:
        made.shutdown()


def giving_away() -> dict[str, float]:
    """Seconds until a first piece is done in a new process, of a further one, of these the driver's own CPU time, of a
    result's megabyte and of sharing a megabyte. In a block of :func:`cluster.joined`."""
    nothing = partial(ExtractionOptions, OPTIONS.max_image_size)  # of a module that loads what matching loads
    first = seconds(lambda: list(cluster.fan_out(nothing, range(1))))
    began = time.process_time()
    each = seconds(lambda: list(cluster.fan_out(nothing, range(PIECES)))) / PIECES
    own = (time.process_time() - began) / PIECES
    megabytes = RESULTS * RESULT_BYTES / 1e6
    results = (seconds(lambda: list(cluster.fan_out(some_bytes, range(RESULTS)))) - RESULTS * each) / megabytes
    values = (cluster.share(np.zeros(RESULT_BYTES, np.uint8)) for _ in range(RESULTS))
    shared = (seconds(lambda: list(cluster.fan_out(with_shared, values))) - RESULTS * each) / megabytes
    return {
        "first_seconds": round(first, 3),
        "piece_seconds": round(each, 5),
        "driver_piece_seconds": round(own, 5),
        "result_megabyte_seconds": round(max(results, 0.0), 5),
        "share_megabyte_seconds": round(max(shared, 0.0), 5),
    }


def add_runs(record: Record, of: Path) -> None:
    """Features and matches of all pairs, exact and indexed, without a cluster and by 1 and 2 workers."""
    with tempfile.TemporaryDirectory() as scratch:
        ingest, photos = ingested(of, Path(scratch))
        for workers in WORKERS:
            with ray_cluster(workers) as address, cluster.joined(address):
                record.add(what="giving away", workers=workers, **giving_away())
        record.add(what="run", set=name_of(of), photos=len(photos), workers=0, **run(ingest, photos))
        for workers in WORKERS:
            with ray_cluster(workers) as address, cluster.joined(address):
                record.add(what="run", set=name_of(of), photos=len(photos), workers=workers, **run(ingest, photos))


def add_waits(record: Record) -> None:
    """Pieces that wait, by more workers than this machine has cores."""
    pieces = [WAITS[number % len(WAITS)] for number in range(WAITING_PIECES)]
    for workers in WAITING_WORKERS:
        with ray_cluster(workers) as address, cluster.joined(address):
            list(cluster.fan_out(wait, [1.0] * 3 * workers))  # all processes have begun
            took = seconds(lambda: list(cluster.fan_out(wait, pieces)))
        record.add(what="waits", workers=workers, pieces=len(pieces), piece_seconds=sum(pieces), seconds=round(took, 2))


def run(ingest: Path, photos: list[Photo]) -> dict[str, float]:
    """Seconds of the wall clock that features and matching of all pairs take, wherever they are done."""
    pairs = exhaustive(len(photos))
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch, "a.db")
        fill_database(database, photos, MAPPING_MODEL)
        features = seconds(lambda: extract_features(database, ingest / "images", photos, OPTIONS))
        shutil.copyfile(database, indexed := Path(scratch, "b.db"))
        exact = seconds(lambda: match_pairs(database, pairs, 0, STRICT_RATIO))
        words = read_vocabulary(indexed, len(photos), 0, CELLS)
        by_index = seconds(lambda: match_pairs(indexed, pairs, 0, STRICT_RATIO, features=Features(words)))
    took = {"features_seconds": features, "match_seconds": exact, "match_indexed_seconds": by_index}
    more = {"pairs": len(pairs), "load": round(os.getloadavg()[0], 1)}
    return {key: round(value, 2) for key, value in took.items()} | more


# --- phases of finished runs, and the choice of pairs


def phases(workspace: Path) -> dict[str, Any]:
    """Seconds of stage sfm's phases, by the times in its log: features, matching with retrieval and the choice of
    pairs, mapping (global mapping at the same time), and from the last mapping on."""
    keys = Workspace(workspace).read_run().keys
    folder, ingest = (Workspace(workspace).folder(stage, keys[stage]) for stage in ("sfm", "ingest"))
    manifest = read_json(folder / "manifest.json")
    began = datetime.fromisoformat(manifest["started"]).replace(tzinfo=None)
    times = dict[str, datetime]()
    for line in (folder / "sfm.log").read_text("utf-8", "replace").splitlines():
        if stamp := LOG_TIME.match(line):
            at = datetime.strptime(stamp[1], "%Y%m%d %H:%M:%S.%f")
            if "Processed file" in line:
                times["features"] = at
            elif "Calibrating view graph" in line:
                times.setdefault("matching", at)
            elif "Keeping successful reconstruction" in line:
                times["mapping"] = at
    edges = [began, *(times[name] for name in ("features", "matching", "mapping"))]
    edges.append(began + timedelta(seconds=manifest["seconds"]))
    took = [round((after - before).total_seconds(), 1) for before, after in pairwise(edges)]
    facts = manifest["facts"]
    names = ("features_seconds", "matching_seconds", "mapping_seconds", "finish_seconds")
    row = {"photos": facts["photos"], "pairs": facts["match_graph"]["tried"], **dict(zip(names, took, strict=True))}
    ingest_seconds = read_json(ingest / "manifest.json")["seconds"]
    return row | {"seconds": round(manifest["seconds"], 1), "ingest_seconds": round(ingest_seconds, 2)}


def graph(photos: int) -> dict[str, float]:
    """Choosing the next pairs where each photo shares matches with those around it: seconds, and memory in bytes."""
    apart = np.abs(np.arange(photos)[:, None] - np.arange(photos)[None])
    inliers = np.where(apart <= LOOKING_ALIKE, 200, UNTESTED)
    similarity = np.exp(-0.1 * apart).astype(np.float32)
    took = core_seconds(lambda: next_pairs(inliers, similarity, NEIGHBOURS))
    tracemalloc.start()
    next_pairs(inliers, similarity, NEIGHBOURS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"seconds": round(took, 3), "bytes": peak + inliers.nbytes + similarity.nbytes}


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--costs", type=Path, nargs="*", default=[])
    parser.add_argument("--workspaces", type=Path, nargs="*", default=[])
    parser.add_argument("--waits", action="store_true")
    parser.add_argument("--graphs", type=int, nargs="*", default=[])
    add_out(parser)
    given = parser.parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # as in the process in which the stage works
        parser.error("set OPENBLAS_NUM_THREADS=1: work is divided by pairs, not inside a product")
    pycolmap.logging.minloglevel = 2
    record = Record(given.out)
    add_costs(record, given.costs)
    if given.photos:
        add_runs(record, given.photos)
    if given.waits:
        add_waits(record)
    for workspace in given.workspaces:
        record.add(what="phases", set=workspace.stem, **phases(workspace))
    for count in given.graphs:
        record.add(what="graph", photos=count, **graph(count))


if __name__ == "__main__":
    main()
