"""Stage evaluate: how good the field is on photos it has never seen, and beside two trivial predictions.

PSNR is taken from the float picture in [0, 1], per photo; figures over all photos are means of the photos' own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from stages.amounts import duration, short_count
from stages.contract import (
    Flexible,
    Inputs,
    Note,
    Progress,
    StageConfig,
    StageError,
    StageResult,
    Workload,
)
from stages.evaluate.image_metrics import ERROR_SCALE, MIN_FOR_INTERVAL, error_map, mean_interval, ssim
from stages.io.files import read_json, read_scene, write_json, write_png
from stages.io.photos import spread
from stages.train import trained_seconds
from stages.train.config import BLACK, WHITE

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.fields.interface import Rendering
    from nerf.geometry.rays import Rays
    from nerf.geometry.scene import Scene, View
    from stages.evaluate.baselines import MeanPhoto
    from stages.render.renderer import Renderer
    from stages.train.data import PhotoReader

INPUTS = ("ingest", "normalise", "train")
VERSION = 14
EXIT_CODE = 15
RESUMES = False
PUBLISHED = ("metrics.json", "renders", "errors")
NOT_HASHED = ("seconds",)  # it decides how many photos, and that enters the key
FLEXIBLE = Flexible(share=0.05, min_seconds=2.0, max_seconds=60.0)

BACKGROUNDS = {"white": WHITE, "black": BLACK}
RIGHT_HALVES = ("psnr_right_half", "psnr_exposure_fitted", "psnr_pose_fitted")
FIGURES = ("psnr", "ssim", "psnr_mean_image", "psnr_nearest_view", *RIGHT_HALVES)
TRUSTED_WIDTH = 0.5  # of the photos: below, a picture can be sharp and the field know nothing of fine detail
WORTH_SAYING = 0.5  # dB between two scores of right halves
MIN_SIDE = 128  # pixels of the longer side of a photo that is scored, where there is a choice
READING = 0.25  # seconds for each photo of the set where it is read at another size than the field was trained at
BESIDE_DRAWING = 0.05  # seconds for each photo of the set, to read it: the mean image is one of them all
DRAWINGS_TO_FIT = 3  # of a photo scored at a fitted pose: the raw one, one to fit by and the fitted one
TRIED_PHOTOS = 4  # to see how fast the field draws them
# Why nothing is measured, by whether there are test photos at all.
UNMEASURED = {False: "no photo was kept for testing", True: "masks leave nothing of the test photos looked at"}
NO_LPIPS = "LPIPS is not computed: no package in use ships its weights and nothing is downloaded"


class Config(StageConfig):
    """How to compare. None is chosen for you."""

    downscale: float | None = Field(
        default=None,
        ge=1,
        description="How many times smaller than the photos to score. None: the size that the field was "
        "trained at, or smaller where one photo of that takes too long.",
    )
    background: Literal["white", "black"] | None = Field(
        default=None,
        description="What photos with alpha are shown over. None: what the field was trained over, white "
        "where that was random.",
    )
    photos: int | None = Field(
        default=None,
        ge=1,
        description="How many test photos to score, evenly spread. None: as many as take no longer than the training.",
    )
    fit_poses: Literal["auto", "on", "off"] = Field(
        default="auto",
        description="Score right halves at poses fitted on the left halves, too. auto: where training refined poses. "
        "A hash-grid field's only.",
    )
    seconds: float | None = Field(
        default=None,
        gt=0,
        description="Seconds that the stage may take. None: drawing takes 30 % of the training's seconds.",
    )


def expected_seconds(config: Config, workload: Workload) -> float | None:
    """A twentieth of the training's seconds (fox, fountain_p11 and the demo, after three minutes)."""
    if config.seconds is not None:
        return config.seconds
    trained = trained_seconds(workload)
    return None if trained is None else 0.05 * trained


def plan(config: Config, inputs: Inputs, progress: Progress) -> Config:
    """The size that the field was trained at, and as many photos as this machine draws in a share of that time; where
    that is not enough for one, a smaller size."""
    asked = config.downscale
    if asked is None:
        downscale = read_json(inputs["train"] / "field.json")["downscale"]
        config = config.model_copy(update={"downscale": downscale})
    if config.photos is None and (scene := read_scene(inputs["normalise"])).of_split("test"):
        return _affordable(config, scene, inputs["train"], asked is None, progress)
    return config


def _affordable(config: Config, scene: "Scene", train: Path, may_shrink: bool, progress: Progress) -> Config:
    """``config`` with the number of photos that there is time for, and where it must and ``may_shrink``, a smaller
    size."""
    from stages.render.renderer import Allowance, measured_speed
    from stages.train.data import scaled_size

    assert config.downscale is not None
    test = scene.of_split("test")
    allowance = Allowance(config.seconds, train, BESIDE_DRAWING * len(scene.views))
    cameras = [scene.cameras[view.camera] for view in test]
    drawings = DRAWINGS_TO_FIT if fits_poses(config, read_json(train / "field.json")) else 1
    pixels = [drawings * math.prod(scaled_size(camera, config.downscale)) for camera in cameras]
    progress.update("trying how fast the field draws")
    largest = max(1, int(min(max(c.width, c.height) for c in cameras) / config.downscale))
    speed = measured_speed(train, lambda side: _tried_rays(scene, side), largest)
    budget = allowance.left() * speed
    chosen = affordable(pixels, budget)  # one at least: only one where that takes too long
    if len(chosen) < len(test):
        progress.note(
            "evaluate.slow-field",
            f"{short_count(speed)} rays/s here: all {len(test)} test photos take about "
            f"{duration(sum(pixels) / speed)}, {allowance.words()}; --evaluate.photos asks for more",
        )
    downscale, one = config.downscale, pixels[chosen[0]]
    smallest = max(cameras[chosen[0]].width, cameras[chosen[0]].height) / MIN_SIDE
    saved = (one - budget) / speed - READING * len(scene.views)
    if may_shrink and saved > 0 and smallest > downscale:
        downscale = min(math.ceil(100 * downscale * math.sqrt(one / budget)) / 100, smallest)
        progress.note(
            "evaluate.reduced",
            f"a test photo takes about {duration(one / speed)}, {allowance.words()}: it is scored at "
            f"{1 / downscale:.0%} of its width; --evaluate.downscale {config.downscale:g} asks for more",
        )
    return config.model_copy(update={"photos": len(chosen), "downscale": downscale})


def _tried_rays(scene: "Scene", side: int) -> "Rays":
    """Rays of a few test photos, reduced to a long side of ``side`` pixels, in one row each photo after the other."""
    from nerf.geometry.rays import join_rays
    from stages.train.data import view_rays

    test = scene.of_split("test")
    few = [test[i] for i in spread(len(test), min(TRIED_PHOTOS, len(test)))]
    cameras = [scene.cameras[view.camera] for view in few]
    photos = [view_rays(scene, v, max(c.width, c.height) / side) for v, c in zip(few, cameras, strict=True)]
    return join_rays((rays.each(lambda part: part.reshape(1, -1, *part.shape[2:])) for rays in photos), dim=1)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Render the test photos, compare, and write metrics.json, renders/ and errors/."""
    from stages.effects.image_effects import held_out_words

    scene = read_scene(inputs["normalise"])
    config = plan(config, inputs, progress)
    examiner = _examiner(config, scene, inputs, folder, progress)
    test = scene.of_split("test")
    chosen = spread(len(test), min(config.photos or 0, len(test)))
    few = f"{len(chosen)} of {len(test)} test photos are scored, evenly spread"
    notes = [Note("evaluate.some-photos", few)] if len(chosen) < len(test) else []
    views = [test[i] for i in chosen]
    scored = [view for view in views if (used := examiner.used(view)) is None or used.any()]
    if len(scored) < len(views):
        notes.append(
            Note(
                "evaluate.masked", f"masks leave nothing to compare of {_photos(len(views) - len(scored))} at this size"
            )
        )
    for note in notes:
        progress.note(*note)
    images = examiner.score(scored, progress)
    metrics = _overall(images, len(test), examiner.downscale, notes)
    metrics["background"] = examiner.renderer.background.tolist()
    metrics["appearance"] = held_out_words(examiner.field)
    metrics["poses_fitted"] = examiner.fits_poses
    write_json(folder / "metrics.json", metrics)
    facts = {key: metrics[key] for key in (*FIGURES, "verdict")}
    return StageResult(("metrics.json", "renders", "errors"), _line(metrics), facts=facts)


@dataclass(frozen=True)
class Examiner:
    """Draws test views at 1/``downscale`` of the photos' size and compares them with what the camera saw, less what
    masks ignore. ``field`` is the content of field.json; ``fits_poses``: right halves have a third score, with the
    photo's pose fitted, too."""

    scene: "Scene"
    ingest: Path
    folder: Path
    renderer: "Renderer"
    field: dict[str, Any]
    fits_poses: bool
    downscale: float

    def score(self, views: "Sequence[View]", progress: Progress) -> list[dict[str, Any]]:
        """Render every view, write its picture and error map, and return its figures as metrics.json has them."""
        from stages.evaluate.baselines import mean_photo

        for name in ("renders", "errors"):
            (self.folder / name).mkdir()
        if not views:
            return []
        progress.update("averaging the training photos")
        train = self.scene.of_split("train")
        mean = mean_photo(map(self._photo, train), map(self.used, train))
        images = []
        for done, view in enumerate(views):

            def on_chunk(share: float, done: int = done) -> None:
                progress.update(f"test photo {done + 1} of {len(views)}", (done + share) / len(views))

            images.append(self._score_one(view, mean, on_chunk))
        return images

    def _score_one(self, view: "View", mean: "MeanPhoto", on_chunk: Callable[[float], None]) -> dict[str, Any]:
        from stages.evaluate.baselines import nearest_view, resized
        from stages.evaluate.half_images import right_half_psnr
        from stages.train.data import view_rays

        truth, used = self._photo(view), self.used(view)
        rendering = self._renderer(view).draw(view_rays(self.scene, view, self.downscale), on_chunk)
        image = rendering.colour.clamp(0, 1)
        background = self.renderer.background.cpu()
        right, fitted = right_half_psnr(rendering, background, truth, used)
        posed = None
        if self.fits_poses and right is not None:
            _, posed = right_half_psnr(self._from_fitted_pose(view, truth, used), background, truth, used)
        height, width = truth.shape[:2]
        nearest = nearest_view(view, self.scene.of_split("train"))
        # The decoded file has an ASCII name that is unique up to its suffix; the photo's own may be anything.
        file = Path(view.file.removeprefix("images/")).with_suffix(".png").as_posix()
        write_png(self.folder / "renders" / file, (image * 255).round().byte().numpy())
        write_png(self.folder / "errors" / file, error_map(image, truth, used))
        return {
            "name": view.name,
            "psnr": _psnr(image, truth, used),
            "ssim": ssim(image, truth, used),
            "psnr_mean_image": _psnr(mean.shown_at(height, width), truth, used),
            "psnr_nearest_view": _psnr(resized(self._photo(nearest), height, width), truth, used),
            "psnr_right_half": right,
            "psnr_exposure_fitted": fitted,
            "psnr_pose_fitted": posed,
            "nearest_view": nearest.name,
            "render": f"renders/{file}",
            "error": f"errors/{file}",
        }

    def _from_fitted_pose(self, view: "View", truth: "Tensor", used: "Tensor | None") -> "Rendering":
        """The view from where its left half says that it was taken."""
        from nerf.fields.hash_grid import HashGridField
        from stages.effects.image_effects import photo_effects
        from stages.evaluate.half_images import from_fitted_pose
        from stages.train.data import view_rays

        field = self.renderer.field
        assert isinstance(field, HashGridField), "only with a hash-grid field does evaluate fit poses"
        rays = view_rays(self.scene, view, self.downscale)
        rendering, effects = self._renderer(view).draw(rays), photo_effects(self.field, self.scene, view)
        background = self.renderer.background.cpu()
        moved = from_fitted_pose(field.on_cpu(), rays, rendering, background, truth, used, effects)
        return self._renderer(view).draw(moved)

    @cached_property
    def _reader(self) -> "PhotoReader":
        from stages.train.data import PhotoReader

        return PhotoReader(self.ingest, self.scene, self.downscale)

    def _photo(self, view: "View") -> "Tensor":
        return self._reader.pixels(view, self.renderer.background.tolist())

    def used(self, view: "View") -> "Tensor | None":
        from stages.train.data import view_mask

        return view_mask(self.ingest, self.scene, view, self.downscale)

    def _renderer(self, view: "View") -> "Renderer":
        from stages.effects.image_effects import photo_effects

        return self.renderer.through(photo_effects(self.field, self.scene, view, self.renderer.device))


def _examiner(config: Config, scene: "Scene", inputs: Inputs, folder: Path, progress: Progress) -> Examiner:
    """Load the field; data with alpha goes over the background asked for, the rest over what the field expects."""
    from stages.render.renderer import load_renderer

    assert config.downscale is not None
    chosen = config.background if scene.has_alpha else None
    renderer = load_renderer(inputs["train"], BACKGROUNDS[chosen] if chosen else None, progress)
    field = read_json(inputs["train"] / "field.json")
    return Examiner(scene, inputs["ingest"], folder, renderer, field, fits_poses(config, field), config.downscale)


def fits_poses(config: Config, field: dict[str, Any]) -> bool:
    """Whether to score at fitted poses a field with this field.json. Raises StageError where it has no gradients for
    that."""
    from stages.effects.image_effects import refines_poses

    fittable = field["kind"] == "grid"
    if config.fit_poses == "on" and not fittable:
        why = f"this is a {field['kind']} field, and only a hash-grid field tells the gradients of its rays"
        raise StageError(
            "evaluate.no-pose-fit", "cannot fit poses of test photos", why, "Give --evaluate.fit-poses auto."
        )
    return fittable and (config.fit_poses == "on" or (config.fit_poses == "auto" and refines_poses(field["effects"])))


def affordable(pixels: Sequence[int], budget: float) -> list[int]:
    """Which photos to score: as many as ``budget`` pixels allow, at least one, spread evenly over the list."""
    for count in range(len(pixels), 1, -1):
        chosen = spread(len(pixels), count)
        if sum(pixels[i] for i in chosen) <= budget:
            return chosen
    return spread(len(pixels), min(1, len(pixels)))


def verdict(metrics: dict[str, Any]) -> str:
    """One sentence on how far the field can be trusted, from held-out PSNR, SSIM and the two trivial predictions.

    * no better than the mean image: unusable;
    * no better than the nearest photo: worse than showing that;
    * below 22 dB or SSIM 0.7: soft; below 27 dB or SSIM 0.85: good; else sharp, and trustworthy if at least three
      photos say so at no less than half of their width.
    """
    psnr, similarity, nearest, mean = (metrics[key] for key in ("psnr", "ssim", "psnr_nearest_view", "psnr_mean_image"))
    if psnr is None:
        return f"Not measured: {UNMEASURED[metrics['photos_test'] > 0]}."
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
    elif metrics["width_share"] < TRUSTED_WIDTH:
        what = f"Sharp as a small picture, finer detail was not looked at: {figures}, {gain}"
    elif metrics["photos_scored"] < MIN_FOR_INTERVAL:
        what = f"Sharp, as far as {_photos(metrics['photos_scored'])} can tell: {figures}, {gain}"
    else:
        what = f"Sharp and trustworthy: {figures}, {gain}"
    return what + "."


def _overall(images: list[dict[str, Any]], test_photos: int, downscale: float, notes: list[Note]) -> dict[str, Any]:
    """The content of metrics.json."""
    metrics: dict[str, Any] = {key: _mean([image[key] for image in images]) for key in FIGURES}
    for key in ("psnr", "ssim"):
        values = [image[key] for image in images if image[key] is not None]
        metrics[f"{key}_interval"] = mean_interval(values)
    if not images:
        notes = [*notes, Note("evaluate.unmeasured", f"{UNMEASURED[test_photos > 0]}, so nothing is measured")]
    elif len(images) < MIN_FOR_INTERVAL:
        words = f"no interval: {_photos(len(images))} cannot show how much the figures vary"
        notes = [*notes, Note("evaluate.no-interval", words)]
    if small := sum(image["psnr_right_half"] is None for image in images):
        words = f"a half of {_photos(small)} has too few pixels to fit an exposure on or to score with it"
        notes = [*notes, Note("evaluate.small-halves", words)]
    metrics |= {
        "lpips": None,
        "photos_scored": len(images),
        "photos_test": test_photos,
        "width_share": 1 / downscale,
        "error_scale": [0, ERROR_SCALE],
        "notes": [*(note.text for note in notes), NO_LPIPS],
        "images": images,
    }
    return metrics | {"verdict": verdict(metrics)}


def _line(metrics: dict[str, Any]) -> str:
    """21.4 ± 0.4 dB, SSIM 0.61 · nearest photo 14.2 dB, mean image 12.9 dB · 7 photos at 50 % width."""
    if metrics["psnr"] is None:
        return f"nothing measured: {UNMEASURED[metrics['photos_test'] > 0]}"
    interval = metrics["psnr_interval"]
    deviation = f" ± {(interval[1] - interval[0]) / 2:.1f}" if interval else ""
    similarity = "" if metrics["ssim"] is None else f", SSIM {metrics['ssim']:.2f}"
    similarity += _right_halves(metrics)
    trivial = f"nearest photo {metrics['psnr_nearest_view']:.1f} dB, mean image {metrics['psnr_mean_image']:.1f} dB"
    scored, test = metrics["photos_scored"], metrics["photos_test"]
    count = _photos(scored) if scored == test else f"{scored} of {test} photos"
    size = "" if metrics["width_share"] == 1 else f" at {metrics['width_share']:.0%} width"
    return f"{metrics['psnr']:.1f}{deviation} dB{similarity} · {trivial} · {count}{size}"


def _right_halves(metrics: dict[str, Any]) -> str:
    """The scores of right halves, where what is fitted on the left ones makes a difference worth saying."""
    right, fitted, posed = (metrics[key] for key in RIGHT_HALVES)
    if right is None or all(abs(score - right) <= WORTH_SAYING for score in (fitted, posed) if score is not None):
        return ""
    words = f" · right halves {right:.1f} dB, {fitted:.1f} dB with its exposure fitted on the left half"
    return words if posed is None else f"{words}, {posed:.1f} dB with its pose, too"


def _photos(count: int) -> str:
    return "1 photo" if count == 1 else f"{count} photos"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _below(value: float | None, limit: float) -> bool:
    return value is not None and value < limit


def _psnr(image: "Tensor", truth: "Tensor", used: "Tensor | None") -> float:
    from nerf.training.metrics import mean_squared_error, psnr

    if used is not None:
        image, truth = image[used], truth[used]
    return psnr(mean_squared_error(image, truth))
