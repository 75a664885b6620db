"""Renders images of a trained field, and measures how many rays per second it renders on this machine."""

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
from stages.contract import Progress
from stages.hardware.device import compute_device
from stages.io.amounts import duration
from stages.io.field_files import load_field
from stages.io.files import read_json

RENDER_FRACTION = 0.3  # of the training time that rendering is expected to take; a busier machine may need more
MIN_RENDER_SECONDS = 0.5
TIMED_SECONDS = 0.5
MAX_TIMED_FRACTION = 0.05  # of the training time
FIRST_SIDE = 24  # pixels


@dataclass(frozen=True)
class Renderer:
    """A trained field and the background that it is rendered over."""

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

    def render(self, rays: Rays, on_chunk: Callable[[float], None] | None = None) -> Rendering:
        """The image (height, width) along ``rays``, on the CPU. ``on_chunk`` gets the finished fraction."""
        device = self.background.device
        on_device = rays.each(lambda part: part.to(device))
        image = render_image(self.model, on_device, self.background, on_chunk=on_chunk)
        return Rendering(*(part.cpu() for part in image))

    def rays_per_second(self, make_rays: Callable[[int], Rays], max_side: int, seconds: float) -> float:
        """Measured speed. ``make_rays(side)`` gives rays of the images to come, reduced to ``side`` pixels; the side
        grows from FIRST_SIDE to ``max_side`` until rendering takes ``seconds``."""
        side = min(FIRST_SIDE, max_side)
        self.render(make_rays(side))  # the first image allocates memory and compiles kernels
        while True:
            rays = make_rays(side)
            started = time.perf_counter()
            self.render(rays)
            elapsed = time.perf_counter() - started
            if elapsed >= seconds or side == max_side:
                return rays.near.numel() / elapsed
            side = min(math.ceil(side * math.sqrt(2)), max_side)


def load_renderer(
    train: Path, background: tuple[float, ...] | None = None, progress: Progress | None = None
) -> Renderer:
    """The field of the finished training in ``train``, over ``background``, which a field with a background model does
    not show; None: the background of its training. Colour effects are those of new views. ``progress`` gets a note if
    only torch's kernels run here."""
    device = compute_device()
    model, info = load_field(train, device, progress)
    return Renderer(model, torch.tensor(info["background"] if background is None else background, device=device))


class TimeBudget:
    """The time to render in a stage that begins now: what is left of the ``seconds`` given to it, less
    ``other_seconds`` for its other work; by default a ``fraction`` of the training time, at least ``min_seconds``."""

    def __init__(
        self,
        seconds: float | None,
        train: Path,
        other_seconds: float,
        fraction: float = RENDER_FRACTION,
        min_seconds: float = 0.0,
    ) -> None:
        self.began, self.given, self.other_seconds = time.perf_counter(), seconds, other_seconds
        self.trained, self.fraction, self.min_seconds = trained_seconds(train), fraction, min_seconds

    def seconds_left(self) -> float:
        """The seconds that rendering may still take."""
        if self.given is None:
            return max(self.min_seconds, self.fraction * self.trained)
        return max(MIN_RENDER_SECONDS, self.given - (time.perf_counter() - self.began) - self.other_seconds)

    def message(self) -> str:
        """Where the budget comes from."""
        if self.given is None:
            return f"training took {duration(self.trained)}"
        return f"given {duration(self.given)}, of which {duration(self.seconds_left())} are left for rendering"


def trained_seconds(train: Path) -> float:
    """The training time of the field in ``train``, without evaluation and saving."""
    return read_json(train / "curve.json")["points"][-1]["seconds"]


def measured_speed(train: Path, make_rays: Callable[[int], Rays], max_side: int) -> float:
    """Rays per second that the field in ``train`` renders on this machine, measured within a second or two."""
    seconds = min(TIMED_SECONDS, MAX_TIMED_FRACTION * trained_seconds(train))
    return load_renderer(train).rays_per_second(make_rays, max_side, seconds)
