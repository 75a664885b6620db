"""What a stage takes on a Ray cluster that is this machine alone, and without one, and whether its outputs agree.

    ray start --head; python -m benchmarks.cluster PHOTOS [--stage sfm] [--repeats 3] [--kills 10] [--cluster auto]

The photos are ingested once; then the stage runs from the start by turns without the cluster and with it, and in the
end with it until so many of its processes were killed at random moments. ``seconds`` are the stage's own,
``command_seconds`` leave out nothing; ``load`` is the machine's mean over the last five minutes; ``same``: whether the
digest of the outputs is that of the first run.
"""

import argparse
import json
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import psutil

from benchmarks.nerfacto import pipeline
from benchmarks.record import Record, add_out
from stages.hardware.cluster import MAX_RETRIES

WORKING = "ray::_do"  # the title of a process at a piece of work


@contextmanager
def killing(shortest: float = 1.0, longest: float = 8.0) -> Iterator[list[int]]:
    """Meanwhile a process at work for the cluster is killed after each random pause of so many seconds, at most as
    often as one piece of work is begun again; their ids."""
    killed, over, pauses = list[int](), threading.Event(), random.Random(0)

    def kill() -> None:
        while len(killed) < MAX_RETRIES and not over.wait(pauses.uniform(shortest, longest)):
            found = psutil.process_iter(["cmdline"])
            working = [each.pid for each in found if WORKING in " ".join(each.info["cmdline"] or [])]
            if working:
                with suppress(ProcessLookupError):
                    os.kill(process := pauses.choice(working), signal.SIGKILL)
                    killed.append(process)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


def run(stage: str, workspace: Path, *options: str) -> tuple[str, dict[str, Any]]:
    """The digest of the stage's outputs, and what it took."""
    began = time.monotonic()
    pipeline(stage, workspace, "--force", *options)
    took, key = time.monotonic() - began, json.loads((workspace / "run.json").read_text("utf-8"))["keys"][stage]
    manifest = json.loads((workspace / stage / key[:16] / "manifest.json").read_text("utf-8"))
    seconds = {"seconds": round(manifest["seconds"], 1), "command_seconds": round(took, 1)}
    return manifest["outputs_digest"], seconds | {"load": round(os.getloadavg()[1], 1)}


def main() -> None:
    """By turns without and with the cluster, then with kills."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--stage", default="sfm")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--cluster", default="auto")
    add_out(parser)
    given = parser.parse_args()
    record, digests = Record(given.out), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder, "w.nerf")
        pipeline("run", given.photos, "-o", workspace, "--until", "ingest")

        def add(*options: str, kill: bool = False) -> int:
            with killing() if kill else nullcontext(list[int]()) as killed:
                digest, figures = run(given.stage, workspace, *options)
            digests.append(digest)
            names = {
                "set": (given.photos.parent if given.photos.name == "images" else given.photos).name,
                "stage": given.stage,
                "where": "cluster" if options else "this machine",
            }
            record.add(**names, killed=len(killed), **figures, same="yes" if digest == digests[0] else "no")
            return len(killed)

        for _ in range(given.repeats):
            add()
            add("--cluster", given.cluster)
        kills = 0
        while kills < given.kills:
            kills += add("--cluster", given.cluster, kill=True)


if __name__ == "__main__":
    main()
