"""All statistics of a scene: what its sparse model and its training photos say about each optional effect."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.contract import Progress

if TYPE_CHECKING:
    import numpy as np

    from nerf.effects.statistics.exposure import ExposureFit
    from nerf.effects.statistics.statistic import Evidence
    from nerf.geometry.scene import Scene


PHOTOMETRIC = (
    *("exposure", "tone", "view_dependence", "vignetting"),
    *("transients", "scale", "participating_media", "blur"),
)
GEOMETRIC = ("background", "pose_refinement", "rolling_shutter")
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
REFERENCE_PX = 1000  # the longer side, as nerf/effects/statistics/poses.py says in its unit
GAIN_DIGITS = 4  # of logarithms: a hundredth of what they are known to


class SceneEvidence(NamedTuple):
    """The evidence by effect, the gains that effects may begin with, of the training photos in order of name, and the
    ``seconds`` that the evidence took, by effect."""

    of: "dict[str, Evidence]"
    exposure: "ExposureFit"
    seconds: dict[str, float]


class Clock:
    """Seconds by effect; of what serves several, each has an equal part."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def runs_for(self, *names: str) -> Iterator[None]:
        """While the block lasts."""
        started = time.perf_counter()
        yield
        part = (time.perf_counter() - started) / len(names)
        for name in names:
            self.seconds[name] = self.seconds.get(name, 0.0) + part

    def timed(self, statistics: "Mapping[str, Callable[[], Evidence]]") -> "dict[str, Evidence]":
        """What each of them says; each counts for its own name."""
        said = {}
        for name, statistic in statistics.items():
            with self.runs_for(name):
                said[name] = statistic()
        return said


def scene_evidence(
    ingest: Path,
    scene: "Scene",
    points: "Mapping[str, np.ndarray]",
    uncertainty_px: Mapping[str, float | None],
    progress: Progress,
) -> SceneEvidence:
    """Everything that can be told without training. ``points`` is points.safetensors, ``uncertainty_px`` what
    registration.json says of each photo by its file (``images/…``)."""
    import numpy as np

    from nerf.effects.statistics.blur import blur_evidence
    from nerf.effects.statistics.exposure import exposure_evidence, fit_exposure, tone_evidence
    from nerf.effects.statistics.media import media_evidence
    from nerf.effects.statistics.scale import scale_evidence
    from nerf.effects.statistics.transients import odd_photos, transients_evidence
    from nerf.effects.statistics.view_dependence import view_dependence_evidence
    from nerf.effects.statistics.vignetting import vignetting_evidence
    from stages.effects.track_colours import look_at_photos

    clock = Clock()
    with clock.runs_for(*PHOTOMETRIC):
        looked = look_at_photos(ingest, scene, points, progress)
        progress.update("fitting the photos' exposures")
        fit, tracks = fit_exposure(looked.tracks), looked.tracks
        odd = odd_photos(tracks, fit, looked.expected)
    of = clock.timed(
        {
            "exposure": lambda: exposure_evidence(fit, told_exposures(ingest, scene), odd.much),
            "tone": lambda: tone_evidence(fit),
            "view_dependence": lambda: view_dependence_evidence(tracks, fit),
            "vignetting": lambda: vignetting_evidence(tracks, fit),
            "transients": lambda: transients_evidence(odd, fit),
            "scale": lambda: scale_evidence(tracks),
            "participating_media": lambda: media_evidence(tracks, fit),
            "blur": lambda: blur_evidence(looked.gradients),
        }
    )
    of["exposure"] = unless_pixels_differ(of["exposure"], of["scale"])
    of |= geometric_evidence(ingest, scene, points, uncertainty_px, clock)
    # What is trained begins with the gains: logarithms that differ in their last digits from processor to processor
    # must not make another field.
    gains = np.round(fit.log_gain, GAIN_DIGITS) + 0.0  # no -0
    return SceneEvidence(of, fit._replace(log_gain=gains), clock.seconds)


def unless_pixels_differ(exposure: "Evidence", scale: "Evidence") -> "Evidence":
    """What is told of exposure, left to a pilot where ``scale`` is seen: coarse pixels average what fine ones tell
    apart, by which the gains of photos from very different distances differ, too (docs/experiments/effects.md)."""
    if not (exposure.called_for and scale.called_for):
        return exposure
    words = f"{exposure.words}; photos from such different distances differ in that, too"
    return exposure._replace(called_for=None, words=words)


def told_exposures(ingest: Path, scene: "Scene") -> "np.ndarray":
    """(training photos,) exposure that EXIF tells of each, EV up to a constant; NaN where it tells none."""
    import numpy as np

    from stages.io.photos import read_photos

    told = {photo.file: photo.exposure_ev for photo in read_photos(ingest)}
    return np.array([told.get(view.file) for view in scene.of_split("train")], float)  # None becomes NaN


def lens_evidence(registration: dict[str, Any]) -> "Evidence":
    """The choice that stage sfm made by held-out reprojection error, shown beside the others."""
    from nerf.effects.statistics.statistic import Evidence, unknown

    rows = registration.get("camera_models") or []
    chosen = [row for row in rows if row["chosen"]]
    if not chosen:
        given = registration.get("source") == "import"
        why = "no candidate makes a sound camera" if rows else "too few points to compare camera models"
        return unknown("px", float("inf"), "the cameras were given" if given else why, False)
    # candidates come from the simplest on; a simple one that was not sound has no figure
    simplest = {row["group"]: row["held_out_px"] for row in reversed(rows) if row["held_out_px"] is not None}
    gained = sorted(((simplest[row["group"]] - row["held_out_px"], row) for row in chosen), key=lambda pair: -pair[0])
    (most, first), *others = gained
    words = f"{first['model']}: held-out error {most:.2g} px below that of the simplest candidate"
    words += "".join(f", {row['model']}: {gain:.2g} px" for gain, row in others)
    noise = first["noise_px"]
    return Evidence(most, "px", noise, noise, any(row["model"] not in PINHOLES for row in chosen), words)


def geometric_evidence(
    ingest: Path,
    scene: "Scene",
    points: "Mapping[str, np.ndarray]",
    uncertainty_px: Mapping[str, float | None],
    clock: Clock,
) -> "dict[str, Evidence]":
    """What is told by places alone. Errors are laid on photos of REFERENCE_PX, for which thresholds are derived."""
    import numpy as np

    from nerf.effects.statistics.background import background_evidence, untracked_share
    from nerf.effects.statistics.poses import common_residuals, pose_evidence
    from nerf.effects.statistics.rolling_shutter import across_rows, motion_to_next, rolling_shutter_evidence

    views = scene.of_split("train")
    with clock.runs_for(*GEOMETRIC):
        xy, view, point, residual = training_residuals(scene, points)
        size = np.array([[scene.cameras[one.camera].width, scene.cameras[one.camera].height] for one in views], float)
        stated = np.array([uncertainty_px.get(one.file) for one in views], float)  # None becomes NaN
        usual = REFERENCE_PX / size.max(axis=1)
        residual, stated = residual * usual[view, None], stated * usual

    def background() -> "Evidence":
        untracked = untracked_share(xy / size[view], view, len(views))
        return background_evidence(points["xyz"].astype(float), point, scene.has_alpha, untracked)

    def rolling_shutter() -> "Evidence":
        motion = np.full((len(views), 2), np.nan)
        if _is_video(ingest, [one.file for one in views]):
            motion = motion_to_next(xy * usual[view, None], point, view, np.array(scene.indices_of("train")))
        return rolling_shutter_evidence(residual, across_rows(xy, size[view]), motion, view)

    return clock.timed(
        {
            "background": background,
            "pose_refinement": lambda: pose_evidence(*common_residuals(residual, xy, view, len(views)), stated),
            "rolling_shutter": rolling_shutter,
        }
    )


def _is_video(ingest: Path, files: Sequence[str]) -> bool:
    """Whether all of the photos are frames of a video."""
    from stages.io.photos import read_photos

    timed = {photo.file for photo in read_photos(ingest) if photo.time_s is not None}
    return set(files) <= timed


def training_residuals(
    scene: "Scene", points: "Mapping[str, np.ndarray]"
) -> "tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]":
    """Of each observation of a training photo its pixel (k, 2), its photo's number among the training photos, its
    point, and observed minus projected pixel (k, 2). Points that their photo cannot see at all are left out."""
    import numpy as np

    from stages.sfm.colmap.cameras import project

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
