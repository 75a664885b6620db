"""A page of the viewer in headless Chromium with software WebGL, driven by playwright."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerf.fields.hash_grid import HashGridField
from nerf.geometry.rays import Rays, rays_of_view

CHROMIUM = Path("/usr/bin/chromium")
SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
STALL = "GPU stall due to ReadPixels"  # a hint of the driver: to wait is what a test wants
WAIT_SECONDS = 300  # for a page on a busy machine


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser. Skips where there is none."""
    if not CHROMIUM.exists():
        pytest.skip(f"no browser at {CHROMIUM} (apt-get install chromium)")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=SOFTWARE_GL)
        yield browser
        browser.close()


class Viewer:
    """A loaded page, of a file or of a server. ``faults``: errors, console messages and requests for anything else."""

    def __init__(
        self, browser: Any, source: Path | str, width: int = 120, height: int = 90, fragment: str = "", **options: Any
    ) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height}, **options)
        self.page, self.faults = self.context.new_page(), list[str]()
        self.own = source if isinstance(source, str) else source.resolve().as_uri()
        self.page.on("console", lambda message: self._told(message.text))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("request", lambda request: self._requested(request.url))
        self.page.set_default_timeout(1000 * WAIT_SECONDS)
        self.page.goto(self.own + fragment)
        self.until(
            "window.viewer || window.follower || document.getElementById('message')?.textContent.includes('cannot')"
        )

    def _told(self, text: str) -> None:
        if STALL not in text:
            self.faults.append(text)

    def _requested(self, url: str) -> None:
        if not url.startswith((self.own, "blob:", "data:")):
            self.faults.append(url)

    def run(self, script: str, argument: Any = None) -> Any:
        """The value of a JavaScript expression, or of a function of ``argument``."""
        return self.page.evaluate(script, argument)

    def until(self, condition: str) -> None:
        """Waits until an expression is true."""
        ends = time.monotonic() + WAIT_SECONDS
        while not self.run(f"Boolean({condition})"):
            assert time.monotonic() < ends, f"{condition} did not come about: {self.faults}"
            time.sleep(0.05)

    def done(self) -> None:
        """Waits until all pixels of what is to be shown are there."""
        self.until("!viewer.navigation.flight && viewer.renderer.isDone")

    def picture(self, width: int, height: int, request: dict[str, Any]) -> np.ndarray:
        """(height, width, 4) in [0, 1] of a camera; ``request`` as Renderer.request gives it."""
        draw = "async ([w, h, r]) => Array.from(await viewer.renderer.picture(w, h, r))"
        return np.array(self.run(draw, [width, height, request]), float).reshape(height, width, 4) / 255

    def shown(self) -> np.ndarray:
        """What the canvas shows, all of its pixels drawn."""
        self.done()
        return self.drawn()

    def drawn(self) -> np.ndarray:
        """What the canvas is to show, drawn apart from it: while fields follow each other it may never be done."""
        draw = "async () => Array.from(await viewer.renderer.picture(viewer.canvas.width, viewer.canvas.height))"
        return np.array(self.run(draw), float)

    def close(self) -> None:
        """Closes the page."""
        self.context.close()


def request_of(pose: np.ndarray, lens: list[float], near_far: tuple[float, float], **more: Any) -> dict[str, Any]:
    """What Renderer.picture takes; ``lens``: width, height, focal lengths, principal point."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    where = {"rotation": pose[:, :3].T.flatten().tolist(), "centre": pose[:, 3].tolist()}
    return {"pose": where, "lens": dict(zip(names, lens, strict=True)), "nearFar": list(near_far)} | more


def pinhole_rays(pose: np.ndarray, lens: list[float], near_far: tuple[float, float]) -> Rays:
    """The same camera's rays (height, width) for the Python renderer."""
    width, height, fx, fy, cx, cy = lens
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    directions = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return rays_of_view(torch.tensor(directions).float(), torch.tensor(pose).float(), *near_far)


def rendered(field: HashGridField, rays: Rays, background: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Colour and opacity by the Python renderer."""
    flat = rays.each(lambda part: part.reshape(-1, *part.shape[2:]))
    rendering = field.render(flat, torch.tensor(background))
    shape = rays.near.shape
    return rendering.colour.clamp(0, 1).reshape(*shape, 3).numpy(), rendering.opacity.reshape(shape).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """In dB, of pictures in [0, 1]."""
    return float(-10 * np.log10(max(np.square(a - b).mean(), 1e-10)))
