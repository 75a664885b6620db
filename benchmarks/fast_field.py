"""What the hash-grid field reaches on real sets in so many seconds of training: held-out quality, speed, memory.

    python -m benchmarks.fast_field ../shared/data --workspaces /tmp/fast_field [--only lego_400 fox/2.4/60]

Every line is `pipeline train WORKSPACE --train.seconds S --train.downscale D` and `pipeline evaluate` on all held-out
photos, from cameras that are found once for each set. Samples are points whose colour was computed. Frame: one held-out
view at the size in the table, drawn on all cores. Run it on an idle machine. The cases of 900 s tell what 15 minutes
reach, and train for 45 minutes in all.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.nerfacto import HERE, pipeline, stage_folder
from benchmarks.record import Record, add_out
from stages.io.files import read_json, read_scene
from stages.render.path import CameraPath, path_rays
from stages.render.renderer import load_renderer


class Case(NamedTuple):
    """A set, photo width / trained width, seconds of training, and the width of the timed frame."""

    name: str
    downscale: float
    seconds: float
    frame_width: int

    @property
    def words(self) -> tuple[str, str, str]:
        """What `--only` knows it by, from the set on."""
        return self.name, f"{self.downscale:g}", f"{self.seconds:g}"


CASES = (
    Case("lego_400", 1, 60, 800),
    Case("lego_400", 1, 300, 800),
    Case("lego_400", 2, 60, 800),
    Case("fox", 2.4, 60, 648),
    Case("fox", 2.4, 180, 648),
    Case("fern", 2, 180, 504),
    Case("fern", 2, 900, 504),
    Case("fountain_p11", 4, 180, 384),
    Case("fountain_p11", 4, 900, 384),
    Case("sceaux_castle", 4, 180, 384),
    Case("sceaux_castle", 4, 900, 384),
)


def train(workspace: Path, case: Case) -> float:
    """Train and score anew; the peak memory of training in GB."""
    budget = ("--train.seconds", str(case.seconds), "--train.downscale", str(case.downscale))
    command = [sys.executable, "-m", "pipeline", "train", str(workspace), *budget, "--force", "--replan"]
    process = subprocess.Popen(command, cwd=HERE.parent, stdout=sys.stderr)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with status {status}")
    pipeline("evaluate", workspace, "--evaluate.fraction", "1")
    return usage.ru_maxrss / 1e6


def frame_seconds(workspace: Path, width: int) -> tuple[float, str]:
    """How long a held-out view takes to draw at a width, and its size; the best of two."""
    scene = read_scene(stage_folder(workspace, "scene.json"))
    view = scene.of_split("test")[0]
    path = CameraPath((scene.cameras[view.camera],), np.asarray(view.scene_from_camera)[None]).resized(width)
    renderer, rays = load_renderer(stage_folder(workspace, "curve.json")), next(iter(path_rays(path, scene)))
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        renderer.render(rays)
        seconds.append(time.perf_counter() - started)
    return min(seconds), "×".join(map(str, reversed(rays.near.shape)))


def figures(workspace: Path, case: Case, memory_gb: float) -> dict[str, Any]:
    """The row of the table."""
    folder = stage_folder(workspace, "curve.json")
    facts: dict[str, Any] = read_json(folder / "manifest.json")["facts"]
    field, metrics = read_json(folder / "field.json")["settings"], read_json(workspace / "output" / "metrics.json")
    frame, size = frame_seconds(workspace, case.frame_width)
    return {
        "set": case.name,
        "downscale": case.downscale,
        "seconds": case.seconds,
        "grids": f"{field['num_levels']} × 2^{field['log2_hashmap_size']} to {field['max_res']}",
        **{name: facts[name] for name in ("steps", "rays_per_second", "colours_per_second")},
        "psnr": metrics["psnr"],
        "ssim": metrics["ssim"],
        "frame_seconds": frame,
        "frame": size,
        "memory_gb": round(memory_gb, 1),
    }


def chosen(only: list[str]) -> tuple[Case, ...]:
    """The cases that these words name, in the order of the table: "fox" all of a set, "fox/2.4/60" one; without words
    all. Raises SystemExit for a word that names none."""
    found: set[Case] = set()
    for word in only:
        parts = tuple(word.split("/"))
        if not (named := {case for case in CASES if case.words[: len(parts)] == parts}):
            raise SystemExit(f"there is no case {word}; there are {' '.join('/'.join(case.words) for case in CASES)}")
        found |= named
    return tuple(case for case in CASES if case in found or not only)


def main() -> None:
    """Run all cases whose set is there; those that are not are skipped by name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--workspaces", type=Path, required=True, help="folder for one workspace per set")
    parser.add_argument("--only", nargs="+", default=[], help="sets, or cases as set/downscale/seconds")
    add_out(parser)
    given = parser.parse_args()
    cases, record = chosen(given.only), Record(given.out)
    given.workspaces.mkdir(parents=True, exist_ok=True)
    for case in cases:
        if not (photos := (given.data / case.name).absolute()).is_dir():
            print(f"{case.name} is skipped: {photos} is not there", file=sys.stderr)
            continue
        workspace = (given.workspaces / f"{case.name}.nerf").absolute()
        pipeline("run", photos, "-o", workspace, "--until", "normalise")
        record.add(**figures(workspace, case, train(workspace, case)))


if __name__ == "__main__":
    main()
