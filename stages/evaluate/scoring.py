"""From a trained field to figures: test photos are rendered, whole or in tiles, and compared with the photos."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays
from nerf.geometry.scene import Scene, View
from nerf.training.psnr import mean_squared_error, psnr
from stages.contract import Inputs, Note, Progress, StageError, StageResult
from stages.effects.image_effects import held_out_words, photo_effects, refines_poses
from stages.evaluate.baselines import MeanPhoto, mean_photo, nearest_view, resized
from stages.evaluate.half_images import from_fitted_pose, right_half_psnr
from stages.evaluate.image_metrics import error_map, ssim
from stages.evaluate.summary import FIGURES, line_of, overall, verdict
from stages.evaluate.tiles import PREVIEW_SHARE, Tiles, tiles_of
from stages.hardware.cluster import fan_out
from stages.io.amounts import counted
from stages.io.files import read_json, read_scene, write_json, write_png
from stages.render.renderer import Renderer, load_renderer
from stages.train.config import BLACK, WHITE
from stages.train.data import PhotoReader, scaled_size, view_mask, view_rays

if TYPE_CHECKING:
    from stages.evaluate import Config

BACKGROUNDS = {"white": WHITE, "black": BLACK}


class Scores(NamedTuple):
    """The figures of each photo as metrics.json has them, and notes on how they came about."""

    images: list[dict[str, Any]]
    notes: list[Note]


# --- load


def load(config: "Config", inputs: Inputs, progress: Progress) -> "Scorer":
    """The field; data with alpha goes over the background asked for, the rest over what the field expects."""
    assert config.fraction is not None, "plan() chooses it"
    scene, field = read_scene(inputs["normalise"]), read_json(inputs["train"] / "field.json")
    chosen = config.background if scene.has_alpha else None
    return Scorer(
        scene,
        inputs["ingest"],
        load_renderer(inputs["train"], BACKGROUNDS[chosen] if chosen else None, progress),
        field,
        fits_poses(config, field),
        config.downscale,
        config.fraction,
        PhotoReader(inputs["ingest"], scene, config.downscale),
        PhotoReader(inputs["ingest"], scene, field["downscale"]),
    )


def fits_poses(config: "Config", field: dict[str, Any]) -> bool:
    """Whether to score at fitted poses a field with this field.json. Raises StageError where it has no gradients for
    that."""
    fittable = field["kind"] == "grid"
    if config.fit_poses == "on" and not fittable:
        why = f"this is a {field['kind']} field, and only a hash-grid field has gradients with respect to its rays"
        raise StageError(
            "evaluate.no-pose-fit", "cannot fit poses of test photos", why, "Give --evaluate.fit-poses auto."
        )
    return fittable and (config.fit_poses == "on" or (config.fit_poses == "auto" and refines_poses(field["effects"])))


# --- compute


def score(scorer: "Scorer", folder: Path, progress: Progress, reload: Callable[[], "Scorer"]) -> Scores:
    """Score every test photo of which masks leave something, and write its picture and error map into ``folder``. On a
    cluster each process makes the scorer for itself by ``reload``."""
    for name in ("renders", "errors"):
        (folder / name).mkdir()
    test = scorer.scene.of_split("test")
    views = [view for view in test if (mask := scorer.mask(view)) is None or mask.any()]
    notes = list[Note]()
    if masked := len(test) - len(views):
        what = f"masks leave nothing of {counted(masked)} to score at this size"
        notes.append(Note("evaluate.masked", what))
        progress.note(*notes[-1])
    if not views:
        return Scores([], notes)
    progress.update("averaging the training photos")
    mean = scorer.mean_photo()

    def here(work: object, photos: Iterable[tuple[int, View]]) -> Iterator[dict[str, Any]]:
        for number, view in photos:

            def on_chunk(share: float, number: int = number) -> None:
                progress.update(f"test photo {number + 1} of {len(views)}", (number + share) / len(views))

            yield scorer.score(view, number, mean, folder, on_chunk)

    images = list[dict[str, Any]]()
    for figures in fan_out(_ScoreApart(reload, mean, folder), enumerate(views), here, "machine"):
        images.append(figures)
        progress.update(f"test photo {len(images)} of {len(views)}", len(images) / len(views))
    return Scores(images, notes)


@dataclass(frozen=True)
class _ScoreApart:
    """Scores numbered photos on a machine of a cluster."""

    load: Callable[[], "Scorer"]
    mean: MeanPhoto
    folder: Path

    @cached_property
    def scorer(self) -> "Scorer":
        return self.load()

    def __call__(self, photo: tuple[int, View]) -> dict[str, Any]:
        number, view = photo
        return self.scorer.score(view, number, self.mean, self.folder, lambda share: None)


@dataclass(frozen=True)
class Scorer:
    """What renders test photos at 1/``downscale`` of their size, ``fraction`` of each in tiles, and compares them with
    what the camera saw, less what masks ignore.

    ``field`` is the content of field.json; ``fits_poses``: right halves have a third score, with the photo's pose
    fitted, too. ``photos`` and ``trained_photos`` read photos at the
    size they are scored at and at the one that the field was trained on.
    """

    scene: Scene
    ingest: Path
    renderer: Renderer
    field: dict[str, Any]
    fits_poses: bool
    downscale: float | None
    fraction: float
    photos: PhotoReader
    trained_photos: PhotoReader

    def score(
        self, view: View, number: int, mean: MeanPhoto, folder: Path, on_chunk: Callable[[float], None]
    ) -> dict[str, Any]:
        """The figures of the ``number``-th photo."""
        truth, mask = self._photo(view), self.mask(view)
        height, width = truth.shape[:2]
        tiles = None if self.fraction == 1 else tiles_of(height, width, self.fraction, number, mask)
        scored, pixels = mask, None  # the picture of a whole photo shows also what is not scored
        if tiles is not None:
            scored = pixels = tiles.mask(height, width) if mask is None else tiles.mask(height, width) & mask
        renderer = self.renderer.through(photo_effects(self.field, self.scene, view, self.renderer.device))
        rendering = self._render(renderer, self._rays(view), pixels, on_chunk)
        image, background = rendering.colour.clamp(0, 1), self.renderer.background.cpu()
        right, exposure_fitted = right_half_psnr(rendering, background, truth, scored)
        pose_fitted = None
        if self.fits_poses and right is not None:
            fitted = self._at_fitted_pose(renderer, view, truth, scored)
            _, pose_fitted = right_half_psnr(fitted, background, truth, scored)
        nearest = nearest_view(view, self.scene.of_split("train"))
        return {
            "name": view.name,
            "psnr": _psnr(image, truth, scored),
            "ssim": ssim(image, truth, mask) if tiles is None else _tiled_ssim(image, truth, mask, tiles),
            "psnr_mean_image": _psnr(self._mean_of(view, mean, height, width), truth, scored),
            "psnr_nearest_view": _psnr(resized(self._photo(nearest), height, width), truth, scored),
            "psnr_right_half": right,
            "psnr_exposure_fitted": exposure_fitted,
            "psnr_pose_fitted": pose_fitted,
            "nearest_view": nearest.name,
            **self._write_pictures(renderer, view, image if tiles is None else None, truth, mask, folder),
        }

    def _write_pictures(
        self, renderer: Renderer, view: View, image: Tensor | None, truth: Tensor, mask: Tensor | None, folder: Path
    ) -> dict[str, str]:
        """The picture and its error map. Of a photo scored in tiles, whose ``image`` has holes, a smaller whole one."""
        if image is None:
            camera = self.scene.cameras[view.camera]
            downscale = camera.width / truth.shape[1] / math.sqrt(PREVIEW_SHARE * self.fraction)
            image = renderer.render(view_rays(self.scene, view, downscale)).colour.clamp(0, 1)
            truth = resized(truth, *image.shape[:2])
            mask = view_mask(self.ingest, self.scene, view, downscale)
        # The decoded file has an ASCII name that is unique up to its suffix; the photo's own may be anything.
        file = Path(view.file.removeprefix("images/")).with_suffix(".png").as_posix()
        write_png(folder / "renders" / file, (image * 255).round().byte().numpy())
        write_png(folder / "errors" / file, error_map(image, truth, mask))
        return {"render": f"renders/{file}", "error": f"errors/{file}"}

    def _at_fitted_pose(self, renderer: Renderer, view: View, truth: Tensor, scored: Tensor | None) -> Rendering:
        """The view from where its left half says that it was taken."""
        field, rays, background = self.renderer.field, self._rays(view), self.renderer.background.cpu()
        assert isinstance(field, HashGridField), "only with a hash-grid field does evaluate fit poses"
        rendering = self._render(renderer, rays, scored)
        effects = photo_effects(self.field, self.scene, view)
        moved = from_fitted_pose(field.on_cpu(), rays, rendering, background, truth, scored, effects)
        return self._render(renderer, moved, scored)

    @staticmethod
    def _render(
        renderer: Renderer, rays: Rays, pixels: Tensor | None, on_chunk: Callable[[float], None] | None = None
    ) -> Rendering:
        """The image (H, W) that ``rays`` see, black and empty but for some ``pixels``, (H, W) bool; None: all."""
        if pixels is None:
            return renderer.render(rays, on_chunk)
        seen = renderer.render(rays.each(lambda part: part[pixels][None]), on_chunk)
        whole = Rendering(torch.zeros(*pixels.shape, 3), torch.zeros(pixels.shape), torch.zeros(pixels.shape))
        for part, values in zip(whole, seen, strict=True):
            part[pixels] = values[0]
        return whole

    def mean_photo(self) -> MeanPhoto:
        """Of the training photos, at the size trained at, where their pixels are stored already."""
        train, downscale = self.scene.of_split("train"), self.trained_photos.downscale
        photos = (self.trained_photos.pixels(view, self._background) for view in train)
        return mean_photo(photos, (view_mask(self.ingest, self.scene, view, downscale) for view in train))

    def _mean_of(self, view: View, mean: MeanPhoto, height: int, width: int) -> Tensor:
        """What the mean of the training photos predicts for a photo."""
        trained_width, trained_height = scaled_size(self.scene.cameras[view.camera], self.trained_photos.downscale)
        return resized(mean.shown_at(trained_height, trained_width), height, width)

    @property
    def _background(self) -> list[float]:
        return self.renderer.background.tolist()

    def _photo(self, view: View) -> Tensor:
        return self.photos.pixels(view, self._background)

    def mask(self, view: View) -> Tensor | None:
        """Which pixels of a photo count, (H, W) bool; None: all of them."""
        return view_mask(self.ingest, self.scene, view, self.downscale)

    def _rays(self, view: View) -> Rays:
        return view_rays(self.scene, view, self.downscale)


def _psnr(image: Tensor, truth: Tensor, used: Tensor | None) -> float:
    if used is not None:
        image, truth = image[used], truth[used]
    return psnr(mean_squared_error(image, truth))


def _tiled_ssim(image: Tensor, truth: Tensor, mask: Tensor | None, tiles: Tiles) -> float | None:
    return ssim(tiles.cut(image), tiles.cut(truth), None if mask is None else tiles.cut(mask))


# --- save


def save(scorer: Scorer, scores: Scores, folder: Path) -> StageResult:
    """Write metrics.json."""
    test = scorer.scene.of_split("test")
    cameras = [scorer.scene.cameras[view.camera] for view in test]
    downscales = {"photo": 1.0, "scored": scorer.downscale, "trained": scorer.trained_photos.downscale}
    metrics = overall(scores.images, len(test), scores.notes) | {
        "fraction": scorer.fraction,
        **{
            f"{name}_size": max((scaled_size(camera, downscale) for camera in cameras), key=math.prod, default=None)
            for name, downscale in downscales.items()
        },
        "background": scorer.renderer.background.tolist(),
        "appearance": held_out_words(scorer.field),
        "poses_fitted": scorer.fits_poses,
    }
    metrics["verdict"] = verdict(metrics)
    write_json(folder / "metrics.json", metrics)
    facts = {key: metrics[key] for key in (*FIGURES, "verdict")}
    return StageResult(("metrics.json", "renders", "errors"), line_of(metrics), facts=facts)
