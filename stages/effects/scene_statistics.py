"""All statistics of a scene: what its sparse model and its training photos say about each optional effect."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nerf.effects.statistics.background import background_statistic, untracked_share
from nerf.effects.statistics.exposure import ExposureFit, exposure_statistic, fit_exposure
from nerf.effects.statistics.outlier_images import OutlierImages, outlier_images
from nerf.effects.statistics.pose_refinement import common_residuals, pose_statistic
from nerf.effects.statistics.statistic import Statistic, unknown
from nerf.effects.statistics.tracks import TrackColours
from nerf.effects.statistics.vignetting import RadialSlope, radial_slope
from nerf.effects.statistics.warnings import (
    across_rows,
    motion_to_next,
    participating_media_statistic,
    rolling_shutter_statistic,
    scale_variation_statistic,
    tone_statistic,
    transients_statistic,
)
from stages.contract import Progress
from stages.effects.track_colours import sample_photos
from stages.io.amounts import rgb
from stages.io.photos import read_photos
from stages.sfm.colmap.cameras import project

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
REFERENCE_PX = 1000  # the longer side, as nerf/effects/statistics/pose_refinement.py says in its unit
GAIN_DIGITS = 4  # of logarithms: a hundredth of what they are known to


class Places(NamedTuple):
    """Of each of k observations its photo, point, pixel and residual (px of a photo of REFERENCE_PX); of the photos
    their size, how uncertain poses are said to be, and their number among the frames of a video."""

    views: int
    beyond_is_nothing: str | None  # why, where the photos tell that nothing lies beyond the region
    xyz: np.ndarray  # (points, 3)
    view: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    residual_px: np.ndarray
    size: np.ndarray  # (views, 2) width and height
    uncertainty_px: np.ndarray  # (views,) NaN where it is not known
    frame: np.ndarray | None  # (views,)


class Observations(NamedTuple):
    """All that statistics look at: ``tracks`` read off the photos, the ``exposure`` and the ``darkening`` towards
    corners fitted to them, ``outliers`` among the photos, the ``exif_ev`` that the camera wrote, and ``places``."""

    tracks: TrackColours
    exposure: ExposureFit
    darkening: RadialSlope
    outliers: OutlierImages
    exif_ev: np.ndarray
    places: Places


def observed(
    ingest: Path,
    scene: "Scene",
    points: Mapping[str, np.ndarray],
    uncertainty_px: Mapping[str, float | None],
    progress: Progress,
) -> Observations:
    """What photos and tracks show."""
    looked = sample_photos(ingest, scene, points, progress)
    progress.update("fitting the photos' exposures")
    exposure = fit_exposure(looked.tracks)
    return Observations(
        tracks=looked.tracks,
        exposure=exposure,
        darkening=radial_slope(looked.tracks, exposure),
        outliers=outlier_images(looked.tracks, exposure, looked.expected),
        exif_ev=told_exposures(ingest, scene),
        places=observed_places(ingest, scene, points, uncertainty_px),
    )


def observed_places(
    ingest: Path, scene: "Scene", points: Mapping[str, np.ndarray], uncertainty_px: Mapping[str, float | None]
) -> Places:
    """What is told by places alone. Errors are laid on photos of REFERENCE_PX, for which thresholds are derived."""
    views = scene.of_split("train")
    xy, view, point, residual = training_residuals(scene, points)
    size = np.array([[scene.cameras[one.camera].width, scene.cameras[one.camera].height] for one in views], float)
    stated = np.array([uncertainty_px.get(one.file) for one in views], float)  # None becomes NaN
    usual = REFERENCE_PX / size.max(axis=1)
    return Places(
        views=len(views),
        beyond_is_nothing=_why_nothing_lies_beyond(scene),
        xyz=points["xyz"].astype(float),
        view=view,
        point=point,
        xy=xy,
        residual_px=residual * usual[view, None],
        size=size,
        uncertainty_px=stated * usual,
        frame=np.array(scene.indices_of("train")) if _is_video(ingest, [one.file for one in views]) else None,
    )


def _why_nothing_lies_beyond(scene: "Scene") -> str | None:
    if scene.backdrop is not None:
        return f"the photos show a plain backdrop, {rgb(scene.backdrop)}"
    return "the photos' alpha separates the background" if scene.has_alpha else None


def classify_exposure(seen: Observations) -> Statistic:
    """The deviation of gains over the photos, outliers aside."""
    found = exposure_statistic(seen.exposure, seen.exif_ev, seen.outliers.much)
    return unless_pixels_differ(found, scale_variation_statistic(seen.tracks))


def measured_gains(seen: Observations) -> np.ndarray:
    """The gains (views, 3), rounded: logarithms that differ in their last digits from processor to processor must not
    make another field."""
    return np.round(seen.exposure.log_gain, GAIN_DIGITS) + 0.0  # no -0


def measured_vignetting(seen: Observations) -> np.ndarray:
    """The coefficients (views, 3) of nerf/effects/vignetting.py, equal ones, which make the slope over the squared
    radius that all cameras have in common; rounded like gains."""
    falling = max(-seen.darkening.slope, 0.0)
    return np.full((seen.tracks.views, 3), round(falling / 3, GAIN_DIGITS))


def classify_background(places: Places) -> Statistic:
    """What lies beyond the region, and where no tracks are."""
    untracked = untracked_share(places.xy / places.size[places.view], places.view, places.views)
    return background_statistic(places.xyz, places.point, places.beyond_is_nothing, untracked)


def classify_poses(places: Places) -> Statistic:
    """How far photos are from where their pose puts them."""
    common = common_residuals(places.residual_px, places.xy, places.view, places.views)
    return pose_statistic(*common, places.uncertainty_px)


def classify_rolling_shutter(places: Places) -> Statistic:
    """Of the frames of a video."""
    motion = np.full((places.views, 2), np.nan)
    if places.frame is not None:
        usual = REFERENCE_PX / places.size.max(axis=1)
        motion = motion_to_next(places.xy * usual[places.view, None], places.point, places.view, places.frame)
    row = across_rows(places.xy, places.size[places.view])
    return rolling_shutter_statistic(places.residual_px, row, motion, places.view)


# What is seen and not modelled.
WARNINGS: dict[str, Callable[[Observations], Statistic]] = {
    "tone": lambda seen: tone_statistic(seen.exposure),
    "transients": lambda seen: transients_statistic(seen.outliers, seen.exposure),
    "scale_variation": lambda seen: scale_variation_statistic(seen.tracks),
    "rolling_shutter": lambda seen: classify_rolling_shutter(seen.places),
    "participating_media": lambda seen: participating_media_statistic(seen.tracks, seen.exposure),
}


def unless_pixels_differ(exposure: Statistic, scale: Statistic) -> Statistic:
    """What is told of exposure, left to a pilot where ``scale`` is seen: coarse pixels average what fine ones tell
    apart, by which the gains of photos from very different distances differ, too (docs/experiments/effects.md)."""
    if not (exposure.called_for and scale.called_for):
        return exposure
    words = f"{exposure.words}; very different distances make gains differ, too"
    return exposure._replace(called_for=None, words=words)


def told_exposures(ingest: Path, scene: "Scene") -> np.ndarray:
    """(training photos,) exposure that EXIF tells of each, EV up to a constant; NaN where it tells none."""
    told = {photo.file: photo.exposure_ev for photo in read_photos(ingest)}
    return np.array([told.get(view.file) for view in scene.of_split("train")], float)  # None becomes NaN


def camera_model_statistic(registration: dict[str, Any]) -> Statistic:
    """The choice that stage sfm made by held-out reprojection error, shown beside the others."""
    rows = registration.get("camera_models") or []
    chosen = [row for row in rows if row["chosen"]]
    if not chosen:
        given = registration.get("source") == "import"
        why = "no candidate makes a sound camera" if rows else "too few points to compare camera models"
        return unknown("px", float("inf"), "the cameras were imported" if given else why, False)
    # candidates come from the simplest on; a simple one that was not sound has no figure
    simplest = {row["group"]: row["held_out_px"] for row in reversed(rows) if row["held_out_px"] is not None}
    gained = sorted(((simplest[row["group"]] - row["held_out_px"], row) for row in chosen), key=lambda pair: -pair[0])
    (most, first), *others = gained
    words = f"{first['model']}: held-out error {most:.2g} px below that of the simplest candidate"
    words += "".join(f", {row['model']}: {gain:.2g} px" for gain, row in others)
    noise = first["noise_px"]
    return Statistic(most, "px", noise, noise, any(row["model"] not in PINHOLES for row in chosen), words)


def _is_video(ingest: Path, files: Sequence[str]) -> bool:
    """Whether all of the photos are frames of a video."""
    timed = {photo.file for photo in read_photos(ingest) if photo.time_s is not None}
    return set(files) <= timed


def training_residuals(
    scene: "Scene", points: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each observation of a training photo its pixel (k, 2), its photo's number among the training photos, its
    point, and observed minus projected pixel (k, 2). Points that their photo cannot see at all are left out."""
    parts = []
    trained = scene.indices_of("train")
    for number, index in enumerate(trained):
        of_view, pose = points["view"] == index, scene.views[index].scene_from_camera
        point, xy = points["point"][of_view].astype(int), points["xy"][of_view].astype(float)
        if not len(point):
            continue
        inside = (points["xyz"][point].astype(float) - pose[:, 3]) @ pose[:, :3]
        residual = xy - project(scene.cameras[scene.views[index].camera], inside)
        seen = np.isfinite(residual).all(axis=1)
        parts.append((xy[seen], np.full(seen.sum(), number), point[seen], residual[seen]))
    if not parts:
        return np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
    xy, view, point, residual = (np.concatenate(part) for part in zip(*parts, strict=True))
    return xy, view, point, residual
