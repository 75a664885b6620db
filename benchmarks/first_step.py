"""Seconds from the start of Python to the end of the first step of training: with kernels to compile, and without.

    python -m benchmarks.first_step [WORKSPACE] [--downscale 1] [--repeats 3]

Every line is `pipeline train` of a copy of the workspace, ended right after its first step. Photos are read anew each
time; the field's sizes are given, so no steps are timed to choose them. Kernels go to a fresh cache (WARP_CACHE_PATH),
from which the later runs take them. The workspace is one that has its stages up to effects; without it, one is made of
100 photos of the demo's still life, 120 × 90, with their cameras given.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.nerfacto import HERE, pipeline
from benchmarks.record import Record, add_out
from nerf.geometry.scene import Camera
from pipeline.cli.terminal import PlainDisplay
from pipeline.demo import demo_truth, write_photos
from stages.io.files import write_json
from stages.io.transforms_export import intrinsics, opengl_matrix

LENS, PHOTOS = Camera("PINHOLE", 120, 90, (125.0, 125.0, 60.0, 45.0)), 100
SIZES = (
    "--train.steps",
    "1000",
    "--train.grid.num-levels",
    "5",
    "--train.grid.log2-hashmap-size",
    "18",
    "--train.grid.max-res",
    "512",
)
UNTIL_FIRST_STEP = """
import os, time
from pipeline.cli.commands import main
from stages.train import loop as training_loop

def first(take, *_):
    take()
    print("first step done at", time.time(), flush=True)
    os._exit(0)

training_loop.profiled_step = first
main()
"""


def made(folder: Path) -> Path:
    """A workspace of a small scene, finished up to stage effects."""
    truth, photos = demo_truth(LENS, PHOTOS, seed=0), folder / "photos"
    write_photos(photos, truth, PlainDisplay())
    frames = [{"file_path": name, "transform_matrix": opengl_matrix(pose)} for name, pose in truth.poses.items()]
    write_json(photos / "transforms.json", intrinsics(LENS) | {"frames": frames})
    workspace, cameras = folder / "made.nerf", photos / "transforms.json"
    pipeline("run", photos, "--cameras", cameras, "-o", workspace, "--until", "effects", "--effects.pilots", "0")
    return workspace


def first_step_seconds(workspace: Path, downscale: float, kernels: Path) -> float:
    """From the start of Python on; nothing but the compiled kernels is there from earlier runs."""
    for earlier in (workspace / "train", *(workspace / "ingest").glob("*.pixels")):
        shutil.rmtree(earlier, ignore_errors=True)
    words = ("train", str(workspace), *SIZES, "--train.downscale", str(downscale))
    command, environment = [sys.executable, "-c", UNTIL_FIRST_STEP, *words], os.environ | {"WARP_CACHE_PATH": kernels}
    started = time.time()
    done = subprocess.run(command, cwd=HERE.parent, env=environment, stdout=subprocess.PIPE, text=True)
    if not (said := re.search(r"first step done at ([\d.]+)", done.stdout)):
        raise SystemExit(f"{' '.join(words)} ended with status {done.returncode}, before its first step")
    return float(said[1]) - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path, nargs="?")
    parser.add_argument("--downscale", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=3, help="with a warm cache")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        workspace, kernels = given.workspace or made(folder), folder / "kernels"
        copy = Path(shutil.copytree(workspace, folder / "copy.nerf", symlinks=True))
        for run in range(1 + given.repeats):
            seconds = first_step_seconds(copy, given.downscale, kernels)
            kernels_are = "compiled before" if run else "to compile"
            record.add(set=workspace.stem, kernels=kernels_are, to_first_step=f"{seconds:.1f} s")


if __name__ == "__main__":
    main()
