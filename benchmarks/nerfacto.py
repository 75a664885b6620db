"""Nerfstudio's nerfacto against our grid field: held-out PSNR by training seconds, and the ratio of times.

    python -m venv /tmp/nerfstudio && /tmp/nerfstudio/bin/pip install nerfstudio==1.1.5
    python -m benchmarks.nerfacto ../shared/data/fox --workspace /tmp/fox.nerf \
        --nerfstudio-python /tmp/nerfstudio/bin/python

Run it on an idle machine: on two cores it takes an hour, for evaluating nerfacto is slow too. What is not
installed is skipped by name; nothing is installed.

The same for both: the photos at the trained size (ours, 8 bits), the cameras that our structure from motion found with
their lens distortion, the held-out photos, all cores. PSNR is the mean over held-out photos of each one's own, drawn
whole at the trained size. Training seconds are those of the training steps, with the wait for their data; start-up and
evaluation are not counted.

Ours is `pipeline train --train.seconds S`, one run with its own schedule for every S, before nerfacto and again after.

Nerfacto is nerfstudio's `nerfacto` configuration with `--machine.device-type cpu --pipeline.model.implementation
torch`: 4096 rays a step, its camera optimizer on (SO3xR3), its own data worker, schedules meant for 30,000 steps. Its
own evaluation scores it on its test split, 1024 rays at a time to be sooner done, without LPIPS, whose weights would be
a download. What counts is the best PSNR that it reached and the seconds it took, and for ours the shortest S from which
on every run has that PSNR. `--nerfacto-rays` and `--no-camera-optimizer` try what may suit nerfacto better.

`--nerfacto-device cuda --implementation tcnn` runs nerfacto on a GPU; tcnn is tiny-cuda-nn. Its first steps there,
which load kernels, are not counted. A machine that has nerfstudio alone runs it so, on any folder with a
transforms.json and its photos:

    python -c "from benchmarks import nerfacto; nerfacto.run_nerfacto(FOLDER, [10, 30, 60], 4096, True, 'cuda', 'tcnn')"
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.record import Record, add_out

HERE = Path(__file__).parent
LINE_SECONDS = 20.0  # of nerfacto's training, between the lines that tell of it
WARMUP_STEPS = 30  # of nerfacto on a GPU, not counted, as many as benchmarks.gpu_field has


class Point(NamedTuple):
    """What a run has reached. ``psnr`` in dB, over whole held-out photos."""

    seconds: float
    psnr: float
    steps: int
    rays: int


def stage_folder(workspace: Path, output: str) -> Path:
    """The folder of the current result that wrote ``output``."""
    return (workspace / "output" / output).resolve().parent


def pipeline(*words: str | Path) -> None:
    """Run a command of ours. Raises CalledProcessError where it fails; it has said why."""
    subprocess.run([sys.executable, "-m", "pipeline", *map(str, words)], check=True, cwd=HERE.parent, stdout=sys.stderr)


def train_ours(workspace: Path, downscale: float, seconds: float) -> Point:
    """Train anew for ``seconds`` and score every held-out photo."""
    budget = ("--train.seconds", str(seconds), "--train.downscale", str(downscale))
    pipeline("train", workspace, *budget, "--force", "--replan")
    folder = stage_folder(workspace, "curve.json")
    facts = json.loads((folder / "manifest.json").read_text())["facts"]
    info = json.loads((folder / "field.json").read_text())
    return Point(facts["train_seconds"], score_ours(workspace), info["steps"], info["rays"])


def score_ours(workspace: Path) -> float:
    """Mean PSNR over the held-out photos at the trained size, as stage evaluate scores them."""
    from nerf.training.psnr import mean_squared_error, psnr
    from stages.effects.image_effects import photo_effects
    from stages.io.files import read_json, read_scene
    from stages.render.renderer import load_renderer
    from stages.train.config import WHITE
    from stages.train.data import PhotoReader, view_rays

    scene, train = read_scene(stage_folder(workspace, "scene.json")), stage_folder(workspace, "curve.json")
    renderer, info = load_renderer(train), read_json(train / "field.json")
    ingest, values = stage_folder(workspace, "photos.json"), []
    reader = PhotoReader(ingest, scene, info["downscale"])
    for view in scene.of_split("test"):
        truth = reader.pixels(view, WHITE)
        shown = renderer.through(photo_effects(info, scene, view, renderer.device))
        picture = shown.render(view_rays(scene, view, info["downscale"])).colour.clamp(0, 1)
        values.append(psnr(mean_squared_error(picture, truth)))
    return sum(values) / len(values)


def export(workspace: Path, downscale: float, target: Path) -> tuple[int, int]:
    """Write our photos at the trained size and our cameras as nerfstudio reads them; their (width, height)."""
    import numpy as np
    from PIL import Image

    from stages.io.files import read_json, read_scene, write_json
    from stages.train.config import WHITE
    from stages.train.data import PhotoReader, scaled_size

    ingest, normalise = stage_folder(workspace, "photos.json"), stage_folder(workspace, "scene.json")
    scene = read_scene(normalise)
    (width, height), *others = {scaled_size(camera, downscale) for camera in scene.cameras}
    if scene.has_alpha or others:
        raise SystemExit("this comparison takes opaque photos of one size")
    reader = PhotoReader(ingest, scene, downscale)
    for view in scene.views:
        file = target / renamed(view.file)
        file.parent.mkdir(parents=True, exist_ok=True)
        pixels = reader.pixels(view, WHITE).numpy()
        Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(file)
    write_json(target / "transforms.json", shrunk(read_json(normalise / "transforms.json"), width, height))
    return width, height


def renamed(file: str) -> str:
    """The lossless file of a photo, in nerfstudio's folder."""
    return Path(file).with_suffix(".png").as_posix()


def shrunk(cameras: dict[str, Any], width: int, height: int) -> dict[str, Any]:
    """The transforms for photos of that size: focal lengths and centre in its pixels, and the files' new names."""

    def intrinsics(of: dict[str, Any]) -> dict[str, Any]:
        across = {key: of[key] * width / of["w"] for key in ("fl_x", "cx", "w") if key in of}
        return across | {key: of[key] * height / of["h"] for key in ("fl_y", "cy", "h") if key in of}

    frames = [f | intrinsics(f) | {"file_path": renamed(f["file_path"])} for f in cameras["frames"]]
    splits = {key: list(map(renamed, cameras[key])) for key in cameras if key.endswith("_filenames")}
    return cameras | intrinsics(cameras) | splits | {"frames": frames}


def lacks(python: Path) -> str | None:
    """What ``python`` lacks to run nerfacto, None if nothing."""
    command = [python, "-c", "import nerfstudio.configs.method_configs"]
    try:
        probe = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        return f"{python}: {error.strerror}"
    said = probe.stderr.strip().splitlines() or [f"{python} ended with status {probe.returncode} and without a word"]
    return said[-1] if probe.returncode else None


def train_nerfacto(python: Path, *arguments: Any) -> Iterator[Point]:
    """:func:`run_nerfacto` in its own environment; a point at each evaluation. What nerfstudio says goes to a file."""
    log_file = Path(arguments[0]) / "nerfacto.log"
    command = [python, "-c", f"from benchmarks import nerfacto; nerfacto.run_nerfacto{arguments!r}"]
    with (
        log_file.open("w") as log,
        subprocess.Popen(command, cwd=HERE.parent, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        for line in process.stdout or ():
            if line.startswith("POINT "):
                yield Point(*json.loads(line.removeprefix("POINT ")))
            else:
                print(line, end="", file=sys.stderr if line.startswith("nerfacto ") else log, flush=True)
    if process.returncode:
        raise SystemExit(f"nerfacto failed with exit code {process.returncode}; see {log_file}")


def run_nerfacto(
    data: str, due: list[float], rays: int, camera_optimizer: bool, device: str = "cpu", implementation: str = "torch"
) -> None:
    """Inside nerfstudio's environment: its Trainer's loop without viewer and checkpoints, scored at ``due`` seconds."""
    import torch

    torch.manual_seed(42)  # as ns-train does
    trainer = nerfacto_trainer(Path(data), rays, camera_optimizer, device, implementation)
    where = f"{torch.get_num_threads()} threads" if device == "cpu" else torch.cuda.get_device_name()
    warmup = 0 if device == "cpu" else WARMUP_STEPS
    for step in range(warmup):
        train_step(trainer, step)
    wait_for(device)
    spent, step, last = 0.0, warmup, 0.0
    while due:
        started = time.perf_counter()
        metrics = train_step(trainer, step)
        if spent + time.perf_counter() - started >= due[0]:
            wait_for(device)
        spent, step = spent + time.perf_counter() - started, step + 1
        counted = step - warmup
        if spent - last >= LINE_SECONDS:
            last, speed = spent, f"{counted * rays / spent:,.0f} rays/s on {where}"
            print(f"nerfacto {spent:.0f} s, step {step}, batch {metrics['psnr'].item():.2f} dB, {speed}", flush=True)
        if spent >= due[0]:
            scores = trainer.pipeline.get_average_eval_image_metrics(step)
            wait_for(device)
            print("POINT", json.dumps([spent, scores["psnr"], counted, counted * rays]), flush=True)
            due = [seconds for seconds in due if seconds > spent]


def wait_for(device: str) -> None:
    """Until all that a GPU was asked for is computed."""
    import torch

    if device != "cpu":
        torch.cuda.synchronize()


def train_step(trainer: Any, step: int) -> dict[str, Any]:
    """A step as in the loop of nerfstudio's Trainer; the metrics of its batch."""
    location = import_module("nerfstudio.engine.callbacks").TrainingCallbackLocation
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=location.BEFORE_TRAIN_ITERATION)
    _, _, metrics = trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=location.AFTER_TRAIN_ITERATION)
    return metrics


def nerfacto_trainer(data: Path, rays: int, camera_optimizer: bool, device: str, implementation: str) -> Any:
    """Nerfstudio's Trainer of its `nerfacto` configuration, once its data worker has begun to deliver."""
    if implementation == "tcnn":
        import_module("tinycudann")  # nerfstudio would go on without it, in torch
    lpips = import_module("torchmetrics.image.lpip")
    setattr(lpips, "LearnedPerceptualImagePatchSimilarity", lambda **_: lambda *_: 0.0)  # noqa: B010 for pyright
    config = import_module("nerfstudio.configs.method_configs").method_configs["nerfacto"]
    config.machine.device_type = device
    config.pipeline.model.implementation = implementation
    if device == "cpu":
        config.pipeline.model.eval_num_rays_per_chunk = 1024  # more spend much of their time on fresh memory
    config.pipeline.datamanager.data = data
    config.pipeline.datamanager.train_num_rays_per_batch = rays
    if not camera_optimizer:
        config.pipeline.model.camera_optimizer.mode = "off"
        del config.optimizers["camera_opt"]
    config.vis, config.output_dir = "tensorboard", data / "nerfstudio"  # anything but the viewer
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode="test")
    trainer.pipeline.datamanager.next_train(0)
    return trainer


def verdict(ours: list[Point], budgets: list[float], theirs: list[Point]) -> str:
    """How many times sooner ours has nerfacto's best PSNR; ``ours`` runs through ``budgets`` in every repetition."""
    best = max(theirs, key=lambda point: point.psnr)
    goal = f"nerfacto's {best.psnr:.2f} dB at {best.seconds:.0f} s"
    runs = [ours[i :: len(budgets)] for i in range(len(budgets))]
    for i, same in enumerate(runs):
        if all(point.psnr >= best.psnr for run in runs[i:] for point in run):
            seconds, psnr = max(point.seconds for point in same), min(point.psnr for point in same)
            return f"{goal}: ours has {psnr:.2f} dB at {seconds:.1f} s, {best.seconds / seconds:.0f} times sooner"
    return f"{goal}: not reached by ours within {budgets[-1]:g} s"


def recorded(record: Record, method: str, point: Point) -> Point:
    """The point, after it became a row of the table."""
    seconds, psnr, steps, rays = point
    record.add(method=method, train_seconds=round(seconds, 1), steps=steps, rays_per_second=rays / seconds, psnr=psnr)
    return point


def main() -> None:
    """Run both and print the table and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--workspace", type=Path, required=True, help="of ours; made if it is not there")
    parser.add_argument("--nerfstudio-python", type=Path, default=Path(sys.executable), help="that has nerfstudio")
    parser.add_argument("--minutes", type=float, nargs="+", default=[10, 20], help="of training, for nerfacto")
    parser.add_argument("--seconds", type=float, nargs="+", default=[6, 12, 24, 60], help="of training, for ours")
    parser.add_argument("--downscale", type=float, default=2.4, help="photo width / trained width")
    parser.add_argument("--nerfacto-rays", type=int, default=4096, help="in a step")
    parser.add_argument("--camera-optimizer", action=argparse.BooleanOptionalAction, default=True, help="of nerfacto")
    parser.add_argument("--nerfacto-device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--implementation", choices=("torch", "tcnn"), default="torch", help="of nerfacto")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    workspace, budgets, python = given.workspace.absolute(), sorted(given.seconds), given.nerfstudio_python.absolute()
    pipeline("run", given.photos.absolute(), "-o", workspace, "--until", "normalise")
    folder = workspace.with_name(f"{workspace.name}.nerfacto")
    width, height = export(workspace, given.downscale, folder)
    print(f"photos at {width} x {height}\n", flush=True)
    ours = [recorded(record, "ours", train_ours(workspace, given.downscale, seconds)) for seconds in budgets]
    if lacking := lacks(python):
        print(f"\nnerfacto is skipped: {lacking}")
        return
    arguments = (str(folder), sorted(60 * m for m in given.minutes), given.nerfacto_rays, given.camera_optimizer)
    arguments += (given.nerfacto_device, given.implementation)
    theirs = [recorded(record, "nerfacto", point) for point in train_nerfacto(python, *arguments)]
    ours += [
        recorded(record, "ours, second run", train_ours(workspace, given.downscale, seconds)) for seconds in budgets
    ]
    print(f"\n{verdict(ours, budgets, theirs)}")


if __name__ == "__main__":
    main()
