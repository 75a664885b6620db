"""One training of a study: stage train in a folder of its own, then its score on windows of the held-out photos.

Every field is scored on the same pixels at the same size, whatever size it was trained at. Windows stand for whole
photos because the published networks would take longer to draw those than to be trained.
"""

import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.contract import Inputs, Progress, StageError
from stages.io.files import read_json, sync_file, write_json_durably
from stages.io.periodically import periodically
from stages.tradeoff.runs import SMALL_SIDE, THINNED, Arm
from stages.train.data import ALL_MASKED

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.geometry.rays import Rays
    from nerf.geometry.scene import Scene, View

WINDOW = 64  # pixels along an edge
SHOWN = 3  # held-out photos kept as pictures
# Steps between windows that fill a square evenly, however many there are (Roberts 2018, the R2 sequence).
STEPS_OF_PLACES = (0.7548776662466927, 0.5698402909980532)
ENOUGH = 0.25  # of a window's pixels that masks leave
PLACES = 256  # in a photo that are looked at for a window with ENOUGH
MEMORY_LOOK_SECONDS = 0.05
OWN_FAULTS = ("train.diverged", "train.collapsed", ALL_MASKED)
"""The errors of stage train where the arm itself is at fault: it would say so again."""

Colour = tuple[float, float, float]


class Window(NamedTuple):
    """A held-out photo or a part of one: rays and colours (h, w, …), and which pixels count (None: all)."""

    photo: str
    rays: "Rays"
    truth: "Tensor"
    used: "Tensor | None"

    def part(self, place: tuple[slice, slice]) -> "Window":
        """Some of its rows and columns."""
        used = None if self.used is None else self.used[place]
        return Window(self.photo, self.rays.each(lambda v: v[place].clone()), self.truth[place].clone(), used)


@dataclass(frozen=True)
class Exam:
    """What every arm of a study is scored on, and whole photos to see it by; make it with :func:`make_exam`. ``frame``
    is a whole photo's pixels at the size scored at; ``background`` is what photos and fields are shown over, whatever a
    field was trained over."""

    scene: "Scene"
    windows: tuple[Window, ...]
    photos: tuple[Window, ...]
    frame: int
    background: Colour


def make_exam(ingest: Path, scene: "Scene", downscale: float, count: int, small: float) -> Exam:
    """``count`` windows spread over the held-out photos at 1/``downscale`` of their size, and SHOWN of these photos at
    1/``small``, large ones still smaller: of at most SMALL_SIDE pixels, which the study has time to draw."""
    from stages.io.photos import evenly_spread
    from stages.train.config import BLACK, WHITE
    from stages.train.data import scaled_size

    test, background = scene.of_split("test"), WHITE if scene.has_alpha else BLACK
    whole = (_photo(ingest, scene, test[i % len(test)], downscale, background) for i in range(count))
    windows = tuple(photo.part(_place(photo, i, count)) for i, photo in enumerate(whole))
    _check_used(windows)
    shown = [test[i] for i in evenly_spread(len(test), min(SHOWN, len(test)))]
    sides = [max(camera.width, camera.height) for camera in (scene.cameras[view.camera] for view in shown)]
    sizes = [max(small, side / SMALL_SIDE) for side in sides]
    photos = tuple(_photo(ingest, scene, *each, background) for each in zip(shown, sizes, strict=True))
    width, height = scaled_size(scene.cameras[test[0].camera], downscale)
    return Exam(scene, windows, photos, width * height, background)


def _photo(ingest: Path, scene: "Scene", view: "View", downscale: float, background: Colour) -> Window:
    from stages.train.data import PhotoReader, view_mask, view_rays

    truth = PhotoReader(ingest, scene, downscale).pixels(view, background)
    return Window(view.name, view_rays(scene, view, downscale), truth, view_mask(ingest, scene, view, downscale))


def _place(photo: Window, number: int, count: int) -> tuple[slice, slice]:
    """Where the ``number``-th of ``count`` windows lies in its photo: at its place of the R2 sequence or, where masks
    leave less than ENOUGH of that, at the first with as much of every ``count``-th place from there on, which are no
    other window's; of PLACES the one of which they leave most."""
    best, most = (slice(None), slice(None)), -1.0
    for turn in range(number, number + PLACES * count, count):
        top, left = (
            int((0.5 + turn * step) % 1 * (max(0, size - WINDOW) + 1))
            for step, size in zip(STEPS_OF_PLACES, photo.truth.shape[:2], strict=True)
        )
        place = slice(top, top + WINDOW), slice(left, left + WINDOW)
        left_over = 1.0 if photo.used is None else float(photo.used[place].float().mean())
        if left_over > most:
            best, most = place, left_over
        if most >= ENOUGH:
            break
    return best


def _check_used(windows: tuple[Window, ...]) -> None:
    """Raise StageError unless some of the pixels that every arm is scored on are to be used."""
    thinned = slice(None, None, THINNED)
    if not any(window.used is None or window.used[thinned, thinned].any() for window in windows):
        why = "masks leave next to nothing of the held-out photos at this size"
        raise StageError(
            "tradeoff.no-pixels-to-score",
            "nothing to score a study by",
            why,
            "Lower --normalise.test-every, or ignore less.",
        )


def run_arm(arm: Arm, exam: Exam, inputs: Inputs, folder: Path, progress: Progress) -> dict[str, Any]:
    """Train and score one arm, or read what an earlier attempt found; its figures, with ``failed`` (why) where the
    field did not learn. A killed training goes on from its checkpoint.

    Raises:
        StageError: where the machine is at fault: the arm is tried again when the study goes on.
    """
    from stages import train

    if (found := kept(figures_file(arm, folder))) is not None:
        return found
    started, work = time.perf_counter(), folder / arm.name
    work.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"failed": None}
    with peak_memory() as peak:
        try:
            result = train.run(train.Config(**arm.options), inputs, work, progress)
        except StageError as error:
            if error.code not in OWN_FAULTS:
                what = f"the study stopped at {arm.words}: {error.what}"
                hint = "Close other programs or free disk space; the same command then goes on with this training."
                raise StageError("tradeoff.stopped", what, error.why, hint) from error
            figures["failed"] = f"{error.what}: {error.why}"
        else:
            figures |= {name: result.facts[name] for name in ("train_seconds", "restarts")}
            figures |= score(work, exam, progress, arm.every)
            if arm.every == 1:
                write_strip(strip_file(arm, folder), draw_photos(work, exam))
                sync_file(strip_file(arm, folder))  # before the figures, with which the arm counts as done
    figures |= {"peak_memory_mb": round(peak() / 1e6), "wall_seconds": round(time.perf_counter() - started, 3)}
    write_json_durably(figures_file(arm, folder), figures)
    shutil.rmtree(work)
    return figures


def kept(file: Path) -> dict[str, Any] | None:
    """What an earlier attempt at a study found and kept; None where it did not, or where the file is damaged: it is
    then found anew."""
    try:
        return read_json(file)
    except StageError:
        return None


def figures_file(arm: Arm, folder: Path) -> Path:
    """Where the figures of an arm that was run are kept."""
    return folder / f"{arm.name}.json"


def strip_file(arm: Arm, folder: Path) -> Path:
    """Where the pictures of an arm that was scored on all pixels are kept."""
    return folder / f"{arm.name}.png"


def score(field: Path, exam: Exam, progress: Progress, every: int = 1) -> dict[str, Any]:
    """Of the field that stage train left in a folder: PSNR over the pixels of all windows, mean SSIM, seconds a frame.
    ``every``: one of so many pixels is drawn, along both axes; then there is no SSIM."""
    from nerf.training.metrics import psnr
    from stages.evaluate.image_metrics import ssim

    thinned = slice(None, None, every)
    windows = [window.part((thinned, thinned)) for window in exam.windows]
    paint = _painter(field, exam)
    paint(windows[0])  # the first picture pays for memory and kernels
    errors, similarities, seconds = [], [], 0.0
    for number, window in enumerate(windows):
        progress.update(f"scoring, window {number + 1} of {len(windows)}", number / len(windows))
        started = time.perf_counter()
        image = paint(window)
        seconds += time.perf_counter() - started
        error = (image - window.truth).square().mean(-1)
        errors.append(error if window.used is None else error[window.used])
        similarities.append(ssim(image, window.truth, window.used) if every == 1 else None)
    import torch

    known = [similarity for similarity in similarities if similarity is not None]
    rays = sum(window.rays.near.numel() for window in windows)
    return {
        "psnr": round(psnr(float(torch.cat([error.flatten() for error in errors]).mean())), 4),
        "ssim": round(sum(known) / len(known), 5) if known else None,
        "model_mb": round((field / "field.safetensors").stat().st_size / 1e6, 3),
        "frame_seconds": round(seconds * exam.frame / rays, 4),
    }


def drawing_seconds(field: Path, exam: Exam) -> float:
    """What drawing all windows of ``exam`` by the field in a folder takes here, told by parts of one of them."""
    from stages.render.renderer import TIMED_SECONDS, load_painter

    def sample(side: int) -> "Rays":
        some = slice(None, None, math.ceil(WINDOW / side))
        return exam.windows[0].part((some, some)).rays

    rays = sum(window.rays.near.numel() for window in exam.windows)
    return rays / load_painter(field, exam.background).rays_per_second(sample, WINDOW, TIMED_SECONDS)


def draw_photos(field: Path, exam: Exam) -> "list[Tensor]":
    """The photos of ``exam`` as the field in a folder has them."""
    return list(map(_painter(field, exam), exam.photos))


def _painter(field: Path, exam: Exam) -> "Callable[[Window], Tensor]":
    """What draws a window by the field in a folder, in [0, 1], over what photos are over, exposed as its photo is
    expected to be."""
    from stages.effects.decisions import expected_gains
    from stages.render.renderer import load_painter

    painter = load_painter(field, exam.background)
    gains = expected_gains(read_json(field / "field.json"), exam.scene, exam.scene.of_split("test"))

    def paint(window: Window) -> "Tensor":
        shown_as = painter.at_gain(gains[window.photo]) if gains else painter
        return shown_as.draw(window.rays).colour.clamp(0, 1)

    return paint


def write_strip(path: Path, windows: "list[Tensor]") -> None:
    """Pictures (h, w, 3) in [0, 1] side by side as a PNG, as high as the lowest."""
    import cv2
    import numpy as np

    from stages.io.files import write_png

    height = min(window.shape[0] for window in windows)
    sizes = [(max(1, round(window.shape[1] * height / window.shape[0])), height) for window in windows]
    pairs = zip(windows, sizes, strict=True)
    pictures = [cv2.resize(window.numpy(), size, interpolation=cv2.INTER_AREA) for window, size in pairs]
    write_png(path, np.rint(np.concatenate(pictures, axis=1) * 255).astype(np.uint8))


@contextmanager
def peak_memory() -> Iterator[Callable[[], int]]:
    """Yields a function that tells, once the block is left, the most bytes in use within it: a GPU's, or the whole
    program's, looked at twenty times a second."""
    import gc

    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
        yield torch.cuda.max_memory_allocated
        return
    import psutil

    process, most = psutil.Process(), [0]

    def look() -> None:
        most[0] = max(most[0], process.memory_info().rss)

    look()
    with periodically(MEMORY_LOOK_SECONDS, look):
        yield lambda: most[0]
