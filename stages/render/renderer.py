"""Pictures of a trained field, how fast it draws them here, and how many rays that leaves time for."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from nerf.effects import ColourEffect
from nerf.effects.appearance import AppearanceModel
from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.rendering.images import render_image
from stages.amounts import duration
from stages.contract import Progress
from stages.hardware.device import compute_device
from stages.io.field_files import load_field
from stages.io.files import read_json

SHARE = 0.3  # of the training's seconds that drawing may be expected to take; what is left is room for a busier machine
MIN_DRAWING = 0.5  # seconds: less draws nothing
TIMED_SECONDS = 0.5
TIMED_SHARE = 0.05  # of the training's seconds, where that is less
FIRST_SIDE = 24  # pixels


@dataclass(frozen=True)
class Renderer:
    """A trained field, where it is computed, and what it is shown over."""

    model: RadianceModel
    background: Tensor  # (3,), on the model's device

    @property
    def device(self) -> str:
        """Where it is computed."""
        return str(self.background.device)

    @property
    def field(self) -> RadianceModel:
        """The field without effects."""
        return self.model.model if isinstance(self.model, AppearanceModel) else self.model

    def through(self, effects: tuple[ColourEffect, ...]) -> "Renderer":
        """The field through these effects, on its device, in place of those of new views."""
        return replace(self, model=AppearanceModel(self.field, effects) if effects else self.field)

    def draw(self, rays: Rays, on_chunk: Callable[[float], None] | None = None) -> Rendering:
        """The picture (height, width) that ``rays`` see, on the CPU. ``on_chunk`` is told the finished share."""
        device = self.background.device
        on_device = rays.each(lambda part: part.to(device))
        image = render_image(self.model, on_device, self.background, on_chunk=on_chunk)
        return Rendering(*(part.cpu() for part in image))

    def rays_per_second(self, sample: Callable[[int], Rays], largest: int, seconds: float) -> float:
        """Measured speed. ``sample(side)`` are rays of the pictures to come, reduced to ``side`` pixels; the side
        grows from FIRST_SIDE to ``largest`` until drawing takes ``seconds``."""
        side = min(FIRST_SIDE, largest)
        self.draw(sample(side))  # the first picture pays for memory and kernels
        while True:
            rays = sample(side)
            started = time.perf_counter()
            self.draw(rays)
            elapsed = time.perf_counter() - started
            if elapsed >= seconds or side == largest:
                return rays.near.numel() / elapsed
            side = min(math.ceil(side * math.sqrt(2)), largest)


def load_renderer(
    train: Path, background: tuple[float, ...] | None = None, progress: Progress | None = None
) -> Renderer:
    """The field that stage train left in ``train``, over ``background``, which a field with a sky does not show; None:
    what it was trained to stand before. Colour effects are those of new views. ``progress`` is told where the field is
    computed by torch's kernels alone."""
    device = compute_device()
    model, info = load_field(train, device, progress)
    return Renderer(model, torch.tensor(info["background"] if background is None else background, device=device))


class Allowance:
    """Seconds of drawing for a stage that begins now: what is left of ``seconds`` given to it, less ``beside`` for all
    else that it does; where none are given a ``share`` of the training's, ``at_least`` so many."""

    def __init__(
        self, seconds: float | None, train: Path, beside: float, share: float = SHARE, at_least: float = 0.0
    ) -> None:
        self.began, self.given, self.beside = time.perf_counter(), seconds, beside
        self.trained, self.share, self.at_least = trained_seconds(train), share, at_least

    def left(self) -> float:
        """Seconds that pictures may take."""
        if self.given is None:
            return max(self.at_least, self.share * self.trained)
        return max(MIN_DRAWING, self.given - (time.perf_counter() - self.began) - self.beside)

    def words(self) -> str:
        """What the choice is held against."""
        if self.given is None:
            return f"training took {duration(self.trained)}"
        return f"given {duration(self.given)}, of which {duration(self.left())} are left for drawing"


def trained_seconds(train: Path) -> float:
    """How long the field in ``train`` was trained, without measuring and saving."""
    return read_json(train / "curve.json")["points"][-1]["seconds"]


def measured_speed(train: Path, sample: Callable[[int], Rays], largest: int) -> float:
    """Rays per second that the field in ``train`` draws on this machine, found in no more than a second or two."""
    seconds = min(TIMED_SECONDS, TIMED_SHARE * trained_seconds(train))
    return load_renderer(train).rays_per_second(sample, largest, seconds)
