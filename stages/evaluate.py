"""Stage evaluate: how good the field is on photos it has never seen, and beside two trivial predictions.

PSNR is taken from the float picture in [0, 1], per photo; figures over all photos are means of the photos' own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages.contract import Inputs, Progress, StageConfig, StageResult
from stages.files import read_json, read_scene, write_json
from stages.image_metrics import ERROR_SCALE, FEWEST_FOR_INTERVAL, bootstrap_interval, error_map, ssim
from stages.render_plan import TRAINING_COST

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.model import RadianceModel
    from nerf.scene import Scene, View
    from stages.baselines import MeanPhoto

NEEDS = ("ingest", "normalise", "train")
VERSION = 1
RESUMES = False
LINKS = ("metrics.json", "renders", "errors")

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
FIGURES = ("psnr", "ssim", "psnr_mean_image", "psnr_nearest_view")
NO_LPIPS = "LPIPS is not computed: no package in use ships its weights and nothing is downloaded"


class Config(StageConfig):
    """How to compare. None is chosen for you."""

    downscale: float | None = Field(default=None, ge=1)
    """How many times smaller than the photos to score. None: the size that the field was trained at."""
    background: Literal["white", "black"] | None = None
    """What photos with alpha are shown over. None: what the field was trained over, white where that was random."""
    seed: int = 0
    """Of the interval."""


def plan(config: Config, inputs: Inputs) -> Config:
    """The size that the field was trained at, where none was asked for."""
    if config.downscale is not None:
        return config
    return config.model_copy(update={"downscale": read_json(inputs["train"] / "field.json")["downscale"]})


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Render the test photos, compare, and write metrics.json, renders/ and errors/."""
    scene = read_scene(inputs["normalise"])
    examiner = _examiner(plan(config, inputs), scene, inputs, folder)
    test = scene.of_split("test")
    pixels = [examiner.pixels(view) for view in test]
    chosen = affordable(pixels, TRAINING_COST * read_json(inputs["train"] / "field.json")["rays"])
    notes = [_why_fewer(len(chosen), len(test))] if len(chosen) < len(test) else []
    for note in notes:
        progress.note(note)
    images = examiner.score([test[i] for i in chosen], progress)
    metrics = _overall(images, len(test), examiner.downscale, notes, config.seed)
    metrics["background"] = list(examiner.background)
    write_json(folder / "metrics.json", metrics)
    facts = {key: metrics[key] for key in (*FIGURES, "verdict")}
    return StageResult(("metrics.json", "renders", "errors"), _line(metrics), facts=facts)


@dataclass(frozen=True)
class Examiner:
    """Draws test views at 1/``downscale`` of the photos' size and compares them with what the camera saw."""

    scene: "Scene"
    ingest: Path
    folder: Path
    model: "RadianceModel"
    device: str
    downscale: float
    background: tuple[float, ...]

    def pixels(self, view: "View") -> int:
        """How many pixels, and so rays, a view has at this size."""
        from stages.training_data import scaled_size

        return math.prod(scaled_size(self.scene.cameras[view.camera], self.downscale))

    def score(self, views: "Sequence[View]", progress: Progress) -> list[dict[str, Any]]:
        """Render every view, write its picture and error map, and return its figures as metrics.json has them."""
        from stages.baselines import mean_photo

        for name in ("renders", "errors"):
            (self.folder / name).mkdir()
        if not views:
            return []
        progress.update("averaging the training photos")
        mean = mean_photo(self._photo(view) for view in self.scene.of_split("train"))
        images = []
        for done, view in enumerate(views):

            def on_chunk(share: float, done: int = done) -> None:
                progress.update(f"test photo {done + 1} of {len(views)}", (done + share) / len(views))

            images.append(self._score_one(view, mean, on_chunk))
        return images

    def _score_one(self, view: "View", mean: "MeanPhoto", on_chunk: Callable[[float], None]) -> dict[str, Any]:
        from stages.baselines import nearest_view, resized

        truth, image = self._photo(view), self._render(view, on_chunk)
        height, width = truth.shape[:2]
        nearest = nearest_view(view, self.scene.of_split("train"))
        # The decoded file has an ASCII name that is unique up to its suffix; the photo's own may be anything.
        file = Path(view.file.removeprefix("images/")).with_suffix(".png").as_posix()
        _write_png(self.folder / "renders" / file, (image * 255).round().byte().numpy())
        _write_png(self.folder / "errors" / file, error_map(image, truth))
        return {
            "name": view.name,
            "psnr": _psnr(image, truth),
            "ssim": ssim(image, truth),
            "psnr_mean_image": _psnr(mean.shown_at(height, width), truth),
            "psnr_nearest_view": _psnr(resized(self._photo(nearest), height, width), truth),
            "nearest_view": nearest.name,
            "render": f"renders/{file}",
            "error": f"errors/{file}",
        }

    def _photo(self, view: "View") -> "Tensor":
        from stages.training_data import view_pixels

        return view_pixels(self.ingest, self.scene, view, self.downscale, self.background)

    def _render(self, view: "View", on_chunk: Callable[[float], None]) -> "Tensor":
        import torch

        from nerf.rays import Rays
        from nerf.rendering import render_image
        from stages.training_data import view_rays

        rays = Rays(*(part.to(self.device) for part in view_rays(self.scene, view, self.downscale)))
        background = torch.tensor(self.background, device=self.device)
        return render_image(self.model, rays, background, on_chunk=on_chunk).colour.clamp(0, 1).cpu()


def _examiner(config: Config, scene: "Scene", inputs: Inputs, folder: Path) -> Examiner:
    """Load the field; data with alpha goes over the background asked for, the rest over what the field expects."""
    from stages.device import compute_device
    from stages.field_files import load_field

    assert config.downscale is not None
    device = compute_device()
    model, info = load_field(inputs["train"], device)
    chosen = config.background if scene.has_alpha else None
    background = tuple(info["background"]) if chosen is None else BACKGROUNDS[chosen]
    return Examiner(scene, inputs["ingest"], folder, model, device, config.downscale, background)


def affordable(pixels: Sequence[int], budget: int) -> list[int]:
    """Which photos to score: as many as ``budget`` pixels allow, at least one, spread evenly over the list."""
    for count in range(len(pixels), 1, -1):
        chosen = _spread(len(pixels), count)
        if sum(pixels[i] for i in chosen) <= budget:
            return chosen
    return _spread(len(pixels), min(1, len(pixels)))


def verdict(metrics: dict[str, Any]) -> str:
    """One sentence on how far the field can be trusted, from held-out PSNR, SSIM and the two trivial predictions.

    * no better than the mean image: unusable;
    * no better than the nearest photo: worse than showing that;
    * below 22 dB or SSIM 0.7: soft; below 27 dB or SSIM 0.85: good; else sharp, and trustworthy if at least three
      photos say so.
    """
    psnr, similarity, nearest, mean = (metrics[key] for key in ("psnr", "ssim", "psnr_nearest_view", "psnr_mean_image"))
    if psnr is None:
        return "Not measured: no photo was kept for testing."
    size = "" if metrics["width_share"] == 1 else f" at {metrics['width_share']:.0%} of their width"
    figures = f"{psnr:.1f} dB on unseen photos{size}" + ("" if similarity is None else f", SSIM {similarity:.2f}")
    gain = f"{psnr - nearest:.1f} dB better than the nearest photo"
    if psnr <= mean:
        what = f"Unusable: {psnr:.1f} dB is no better than the mean of the training photos ({mean:.1f} dB)"
        what += "; look at the camera layout, then train longer"
    elif psnr <= nearest:
        what = f"Worse than showing the nearest photo ({psnr:.1f} against {nearest:.1f} dB): train longer"
    elif psnr < 22 or _below(similarity, 0.7):
        what = f"Better than any photo nearby by {psnr - nearest:.1f} dB but soft: {figures}"
    elif psnr < 27 or _below(similarity, 0.85):
        what = f"Good, with fine detail missing: {figures}, {gain}"
    elif metrics["photos_scored"] < FEWEST_FOR_INTERVAL:
        what = f"Sharp, as far as {_photos(metrics['photos_scored'])} can tell: {figures}, {gain}"
    else:
        what = f"Sharp and trustworthy: {figures}, {gain}"
    return what + "."


def _overall(
    images: list[dict[str, Any]], test_photos: int, downscale: float, notes: list[str], seed: int
) -> dict[str, Any]:
    """The content of metrics.json."""
    metrics: dict[str, Any] = {key: _mean([image[key] for image in images]) for key in FIGURES}
    for key in ("psnr", "ssim"):
        values = [image[key] for image in images if image[key] is not None]
        metrics[f"{key}_interval"] = bootstrap_interval(values, seed)
    if not images:
        notes = [*notes, "no photo was kept for testing, so nothing is measured"]
    elif len(images) < FEWEST_FOR_INTERVAL:
        notes = [*notes, f"no interval: {_photos(len(images))} cannot show how much the figures vary"]
    metrics |= {
        "lpips": None,
        "photos_scored": len(images),
        "photos_test": test_photos,
        "width_share": 1 / downscale,
        "error_scale": [0, ERROR_SCALE],
        "notes": [*notes, NO_LPIPS],
        "images": images,
    }
    return metrics | {"verdict": verdict(metrics)}


def _line(metrics: dict[str, Any]) -> str:
    """21.4 ± 0.4 dB, SSIM 0.61 · nearest photo 14.2 dB, mean image 12.9 dB · 7 photos at 50 % width."""
    if metrics["psnr"] is None:
        return "no test photos, nothing measured"
    interval = metrics["psnr_interval"]
    spread = f" ± {(interval[1] - interval[0]) / 2:.1f}" if interval else ""
    similarity = "" if metrics["ssim"] is None else f", SSIM {metrics['ssim']:.2f}"
    trivial = f"nearest photo {metrics['psnr_nearest_view']:.1f} dB, mean image {metrics['psnr_mean_image']:.1f} dB"
    scored, test = metrics["photos_scored"], metrics["photos_test"]
    count = _photos(scored) if scored == test else f"{scored} of {test} photos"
    size = "" if metrics["width_share"] == 1 else f" at {metrics['width_share']:.0%} width"
    return f"{metrics['psnr']:.1f}{spread} dB{similarity} · {trivial} · {count}{size}"


def _why_fewer(scored: int, test: int) -> str:
    return f"{scored} of {test} test photos are scored, evenly spread: all of them would take longer than the training"


def _photos(count: int) -> str:
    return "1 photo" if count == 1 else f"{count} photos"


def _spread(length: int, count: int) -> list[int]:
    """``count`` indices in the middle of equal parts of a list."""
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _below(value: float | None, limit: float) -> bool:
    return value is not None and value < limit


def _psnr(image: "Tensor", truth: "Tensor") -> float:
    from nerf.metrics import mean_squared_error, psnr

    return psnr(mean_squared_error(image, truth))


def _write_png(path: Path, pixels: Any) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
