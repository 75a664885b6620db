"""Train one run of a study, and score any field as stage evaluate does: in tiles of all test photos.

Every field is scored on the same pixels at the same size, whatever size it was trained at. Tiles stand for whole photos
because the published networks would take longer to render those than to train.
"""

import gc
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import psutil
import torch
from torch import Tensor

from nerf.geometry.rays import Rays
from nerf.geometry.scene import Scene, View
from nerf.training.psnr import psnr
from stages import train
from stages.contract import Inputs, Progress, StageError, run_stage
from stages.effects.image_effects import photo_effects
from stages.evaluate.image_metrics import ssim
from stages.evaluate.tiles import TILE_SIZE, tiles_of
from stages.io.files import read_json, sync_file, write_json_durably, write_png
from stages.io.photos import spread
from stages.io.stopwatch import periodically
from stages.render.renderer import TIMED_SECONDS, load_renderer
from stages.tradeoff.schedule import SCORING_STRIDE, SMALL_SIDE, Run, scoring_stride
from stages.train.config import BLACK, WHITE
from stages.train.data import ALL_MASKED, PhotoReader, scaled_size, view_mask, view_rays

NUM_SHOWN = 3  # test photos kept as pictures
TIMED_SIDES = 64  # up to so many equal parts of a photo are rendered to see how fast a field renders
MEMORY_INTERVAL_SECONDS = 0.05
RUN_FAILURES = ("train.diverged", "train.collapsed", ALL_MASKED)
"""The errors of stage train where the run itself is at fault: it would fail again."""

Colour = tuple[float, float, float]


class Crop(NamedTuple):
    """A test photo, or some of its tiles, one below the other, of ``tile_rows`` each: rays and colours (h, w, …), and
    which pixels count (None: all)."""

    photo: str
    rays: Rays
    truth: Tensor
    mask: Tensor | None
    tile_rows: int | None = None

    def part(self, place: tuple[slice, slice]) -> "Crop":
        """Some of its rows and columns."""
        mask = None if self.mask is None else self.mask[place]
        return Crop(self.photo, self.rays.each(lambda v: v[place].clone()), self.truth[place].clone(), mask)

    def tiled(self, count: int, number: int) -> "Crop | None":
        """About ``count`` tiles of the ``number``-th photo; None where masks leave nothing of it."""
        height, width = self.truth.shape[:2]
        tiles = tiles_of(height, width, min(1.0, count * TILE_SIZE**2 / (height * width)), number, self.mask)
        if not len(tiles.corners):
            return None

        def column(picture: Tensor) -> Tensor:
            return tiles.cut(picture).flatten(0, 1)

        mask = None if self.mask is None else column(self.mask)
        return Crop(self.photo, self.rays.each(column), column(self.truth), mask, tiles.size[0])

    def ssim(self, image: Tensor) -> float | None:
        """Of a render, by windows inside of tiles."""
        parts = (image, self.truth) if self.mask is None else (image, self.truth, self.mask)
        return ssim(*(part.unflatten(0, (-1, self.tile_rows or len(part))) for part in parts))


@dataclass(frozen=True)
class Benchmark:
    """What every run of a study is scored on, and whole photos for pictures; make it with :func:`make_benchmark`.
    ``size`` is width and height of a whole photo at the size scored at; ``background`` is what photos and fields
    are shown over, whatever a field was trained over."""

    scene: Scene
    crops: tuple[Crop, ...]
    photos: tuple[Crop, ...]
    size: tuple[int, int]
    background: Colour


def make_benchmark(ingest: Path, scene: Scene, downscale: float | None, count: int, small: float) -> Benchmark:
    """About ``count`` tiles of all test photos at 1/``downscale`` of their size (None: the usual one of scores), and
    NUM_SHOWN of these photos at 1/``small``, large ones still smaller: at most SMALL_SIDE pixels, which the study has
    time to render."""
    test, background = scene.of_split("test"), WHITE if scene.has_alpha else scene.backdrop or BLACK
    reader = PhotoReader(ingest, scene, downscale)
    whole = (_photo(reader, view, background) for view in test)
    parts = (photo.tiled(math.ceil(count / len(test)), number) for number, photo in enumerate(whole))
    crops = tuple(part for part in parts if part is not None)
    _check_masks(crops)
    shown = [test[i] for i in spread(len(test), min(NUM_SHOWN, len(test)))]
    sides = [max(camera.width, camera.height) for camera in (scene.cameras[view.camera] for view in shown)]
    sizes = [max(small, side / SMALL_SIDE) for side in sides]
    readers = (PhotoReader(ingest, scene, size) for size in sizes)
    photos = tuple(_photo(*each, background) for each in zip(readers, shown, strict=True))
    return Benchmark(scene, crops, photos, scaled_size(scene.cameras[test[0].camera], downscale), background)


def _photo(reader: PhotoReader, view: View, background: Colour) -> Crop:
    ingest, scene, downscale = reader.ingest, reader.scene, reader.downscale
    truth, mask = reader.pixels(view, background), view_mask(ingest, scene, view, downscale)
    return Crop(view.name, view_rays(scene, view, downscale), truth, mask)


def _check_masks(crops: tuple[Crop, ...]) -> None:
    """Raise StageError unless some of the pixels that every run is scored on count."""
    scored = slice(None, None, SCORING_STRIDE)
    if not any(crop.mask is None or crop.mask[scored, scored].any() for crop in crops):
        why = "masks leave almost nothing of the test photos at this size"
        hint = "Lower --normalise.test-every, or mask less."
        raise StageError("tradeoff.no-pixels-to-score", "nothing to score the study on", why, hint)


# --- one run


def train_and_score(run: Run, benchmark: Benchmark, inputs: Inputs, folder: Path, progress: Progress) -> dict[str, Any]:
    """Train and score one run, or read what an earlier attempt found; its figures, with ``failed`` (why) where the
    field did not learn. A killed training goes on from its checkpoint.

    Raises:
        StageError: where the machine is at fault: the run is tried again when the study goes on.
    """
    if (found := read_figures(figures_file(run, folder))) is not None:
        return found
    started, work = time.perf_counter(), folder / run.name
    work.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"failed": None}
    with peak_memory() as peak:
        try:
            result = run_stage(train.STAGE, train.Config(**run.options), inputs, work, progress)
        except StageError as error:
            if error.code not in RUN_FAILURES:
                what = f"the study stopped at {run.label}: {error.what}"
                hint = f"{error.hint} The same command then continues with this training."
                raise StageError("tradeoff.stopped", what, error.why, hint) from error
            figures["failed"] = f"{error.what}: {error.why}"
        else:
            figures |= {name: result.facts[name] for name in ("train_seconds", "restarts")}
            figures |= score(work, benchmark, progress, run.stride)
            if run.stride == 1:
                write_strip(strip_file(run, folder), render_photos(work, benchmark))
                sync_file(strip_file(run, folder))  # before the figures, with which the run counts as done
    figures |= {"peak_memory_mb": round(peak() / 1e6), "wall_seconds": round(time.perf_counter() - started, 3)}
    write_json_durably(figures_file(run, folder), figures)
    shutil.rmtree(work)
    return figures


def read_figures(file: Path) -> dict[str, Any] | None:
    """What an earlier attempt at a study found; None where it did not, or where the file is damaged: the run is then
    done again."""
    try:
        return read_json(file)
    except StageError:
        return None


def figures_file(run: Run, folder: Path) -> Path:
    """The file with the figures of a run that is done."""
    return folder / f"{run.name}.json"


def strip_file(run: Run, folder: Path) -> Path:
    """The file with the pictures of a run that was scored on all pixels."""
    return folder / f"{run.name}.png"


def score(field: Path, benchmark: Benchmark, progress: Progress, stride: int = 1) -> dict[str, Any]:
    """Of the field that stage train left in a folder: PSNR and SSIM, means over the photos, and seconds a frame. With a
    ``stride`` only every so many pixels are rendered, along both axes, and there is no SSIM."""
    every = slice(None, None, stride)
    crops = [crop.part((every, every)) for crop in benchmark.crops]
    render = _renderer(field, benchmark)
    render(crops[0])  # the first picture pays for memory and kernels
    scores, similarities, seconds = [], [], 0.0
    for number, crop in enumerate(crops):
        progress.update(f"scoring, photo {number + 1} of {len(crops)}", number / len(crops))
        started = time.perf_counter()
        image = render(crop)
        seconds += time.perf_counter() - started
        error = (image - crop.truth).square().mean(-1)
        if crop.mask is None or crop.mask.any():
            scores.append(psnr(float((error if crop.mask is None else error[crop.mask]).mean())))
        similarities.append(benchmark.crops[number].ssim(image) if stride == 1 else None)
    known = [similarity for similarity in similarities if similarity is not None]
    rays = sum(crop.rays.near.numel() for crop in crops)
    return {
        "psnr": round(sum(scores) / len(scores), 4),
        "ssim": round(sum(known) / len(known), 5) if known else None,
        "model_mb": round((field / "field.safetensors").stat().st_size / 1e6, 3),
        "frame_seconds": round(seconds * math.prod(benchmark.size) / rays, 4),
    }


def rendering_seconds(field: Path, benchmark: Benchmark) -> float:
    """What rendering all crops by the field in a folder takes here, estimated from parts of one of them."""

    def sample(side: int) -> Rays:
        rows = math.ceil(len(benchmark.crops[0].truth) * side / TIMED_SIDES)
        return benchmark.crops[0].part((slice(rows), slice(None))).rays

    rays = sum(crop.rays.near.numel() for crop in benchmark.crops)
    return rays / load_renderer(field, benchmark.background).rays_per_second(sample, TIMED_SIDES, TIMED_SECONDS)


def render_photos(field: Path, benchmark: Benchmark) -> list[Tensor]:
    """The photos of ``benchmark`` as the field in a folder renders them."""
    return list(map(_renderer(field, benchmark), benchmark.photos))


def _renderer(field: Path, benchmark: Benchmark) -> Callable[[Crop], Tensor]:
    """What renders a crop by the field in a folder, in [0, 1], over the benchmark's background, as its photo is
    expected to show it."""
    renderer, info = load_renderer(field, benchmark.background), read_json(field / "field.json")
    views = {view.name: view for view in benchmark.scene.of_split("test")}

    def render(crop: Crop) -> Tensor:
        effects = photo_effects(info, benchmark.scene, views[crop.photo], renderer.device)
        return renderer.through(effects).render(crop.rays).colour.clamp(0, 1)

    return render


def write_strip(path: Path, pictures: list[Tensor]) -> None:
    """Pictures (h, w, 3) in [0, 1] side by side as a PNG, as high as the lowest."""
    height = min(picture.shape[0] for picture in pictures)
    sizes = [(max(1, round(picture.shape[1] * height / picture.shape[0])), height) for picture in pictures]
    pairs = zip(pictures, sizes, strict=True)
    resized = [cv2.resize(picture.numpy(), size, interpolation=cv2.INTER_AREA) for picture, size in pairs]
    write_png(path, np.rint(np.concatenate(resized, axis=1) * 255).astype(np.uint8))


@contextmanager
def peak_memory() -> Iterator[Callable[[], int]]:
    """Yields a function that tells, once the block is left, the most bytes in use within it: a GPU's, or the whole
    program's, sampled twenty times a second."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
        yield torch.cuda.max_memory_allocated
        return
    process, most = psutil.Process(), [0]

    def sample() -> None:
        most[0] = max(most[0], process.memory_info().rss)

    sample()
    with periodically(MEMORY_INTERVAL_SECONDS, sample):
        yield lambda: most[0]


# --- the field that the workspace has already


class WorkspaceField(NamedTuple):
    """The field that the workspace has already, scored like every other and trained for nothing: it answers whether it
    could have been had for less. ``facts`` of its training (its seconds are of this machine only if it was trained
    here), its ``figures``, the ``stride`` it was scored with, and ``key``, the name of its training's folder."""

    facts: dict[str, Any]
    figures: dict[str, Any]
    stride: int
    key: str


def score_workspace_field(
    benchmark: Benchmark, inputs: Inputs, folder: Path, seconds: float, progress: Progress
) -> WorkspaceField | None:
    """Score what stage train left, or read the score of an earlier attempt; None where it has left nothing. It may be
    the published networks, which render slowly: a timing decides how many pixels a study of ``seconds`` can score."""
    folder_of_field = inputs.get("train")
    if folder_of_field is None:
        return None
    key, facts = folder_of_field.resolve().name, read_json(folder_of_field / "manifest.json")["facts"]
    file = folder / f"workspace_{key}.json"
    if (found := read_figures(file)) is None:
        progress.update("timing its rendering")
        stride = scoring_stride(rendering_seconds(folder_of_field, benchmark), seconds)
        found = {"stride": stride, "figures": score(folder_of_field, benchmark, progress, stride)}
        write_json_durably(file, found)
    return WorkspaceField(facts, found["figures"], found["stride"], key)
