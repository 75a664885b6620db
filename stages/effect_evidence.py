"""All evidence about a scene's effects in one place: files of the stages before to statistics of nerf/evidence."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.contract import Inputs, Progress
from stages.files import read_json, read_tensors

if TYPE_CHECKING:
    import numpy as np

    from nerf.evidence.evidence import Evidence
    from nerf.scene import Scene
    from stages.track_colours import PhotoEvidence


class Found(NamedTuple):
    """``evidence`` by effect, those that can be modelled first. ``log_gain`` (training views, 3): natural logarithms of
    the photos' gains in linear light, 0 where nothing is known."""

    evidence: "dict[str, Evidence]"
    log_gain: "np.ndarray"


class _Residuals(NamedTuple):
    """Of the training photos' observations: observed less projected (k, 2) in pixels, where (k, 2), and whose."""

    residual: "np.ndarray"
    xy: "np.ndarray"
    view: "np.ndarray"
    point: "np.ndarray"


def gather(inputs: Inputs, scene: "Scene", progress: Progress) -> Found:
    """Look at the training photos along the tracks of the sparse model. Test photos are not looked at."""
    from nerf.evidence.exposure import fit_exposure
    from stages.track_colours import look_at_photos

    points = read_tensors(inputs["normalise"] / "points.safetensors")
    registration = read_json(inputs["sfm"] / "registration.json")
    photos = look_at_photos(inputs["ingest"], scene, points, progress)
    progress.update("weighing the evidence")
    fit = fit_exposure(photos.tracks)
    residuals = _residuals(scene, points)
    evidence = _of_colours(photos, fit) | _of_geometry(scene, points, registration, residuals)
    seen = _seen(photos, fit, scene, residuals, _is_video(inputs["ingest"]))
    return Found(evidence | seen, fit.log_gain)


def _of_colours(photos: "PhotoEvidence", fit: Any) -> "dict[str, Evidence]":
    from nerf.evidence.exposure import exposure_evidence
    from nerf.evidence.view_dependence import view_dependence_evidence

    return {
        "exposure": exposure_evidence(fit),
        "view_dependence": view_dependence_evidence(photos.tracks, fit),
    }


def _of_geometry(
    scene: "Scene", points: "dict[str, np.ndarray]", registration: dict[str, Any], residuals: _Residuals
) -> "dict[str, Evidence]":
    import numpy as np

    from nerf.evidence.background import background_evidence, untracked_share
    from nerf.evidence.poses import common_residuals, pose_evidence

    views = scene.of_split("train")
    sizes = np.array([[scene.cameras[v.camera].width, scene.cameras[v.camera].height] for v in views])
    place = residuals.xy / sizes[residuals.view]
    untracked = untracked_share(place, residuals.view, len(views))
    power = common_residuals(residuals.residual, residuals.xy, residuals.view, len(views))
    stated = {f"images/{image['file']}": image.get("uncertainty_px") for image in registration["images"]}
    uncertain = np.array([stated.get(view.file) for view in views], float)  # None becomes NaN
    return {
        "background": background_evidence(points["xyz"].astype(float), residuals.point, scene.has_alpha, untracked),
        "pose_refinement": pose_evidence(*power, uncertain),
        "lens": _lens(registration),
    }


def _lens(registration: dict[str, Any]) -> "Evidence":
    """The choice that stage sfm made by held-out reprojection error, shown beside the others."""
    from nerf.evidence.evidence import Evidence, unknown

    chosen = [row for row in registration["camera_models"] or [] if row["chosen"]]
    if not chosen:
        return unknown("px", 0.0, "the cameras were given", False)
    simplest = {row["group"]: row for row in reversed(registration["camera_models"])}
    gains = [simplest[row["group"]]["held_out_px"] - row["held_out_px"] for row in chosen]
    models = ", ".join(sorted({row["model"] for row in chosen}))
    noise = max(row["noise_px"] for row in chosen)
    words = f"{models}: held-out error {max(gains):.2g} px below that of {simplest[chosen[0]['group']]['model']}"
    return Evidence(max(gains), "px", noise, noise, any(row["model"] not in PINHOLES for row in chosen), words)


PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")


def _seen(
    photos: "PhotoEvidence", fit: Any, scene: "Scene", residuals: _Residuals, is_video: bool
) -> "dict[str, Evidence]":
    """What is said where it is seen, and not modelled."""
    import numpy as np

    from nerf.evidence.blur import blur_evidence
    from nerf.evidence.exposure import tone_evidence
    from nerf.evidence.media import media_evidence
    from nerf.evidence.rolling_shutter import motion_to_next, rolling_shutter_evidence
    from nerf.evidence.scale import scale_evidence
    from nerf.evidence.transients import transients_evidence
    from nerf.evidence.vignetting import vignetting_evidence

    views = scene.of_split("train")
    motion = np.full((len(views), 2), np.nan)
    if is_video:
        motion = motion_to_next(residuals.xy, residuals.point, residuals.view, len(views))
    height = np.array([scene.cameras[view.camera].height for view in views], float)
    row = residuals.xy[:, 1] / height[residuals.view]
    return {
        "tone": tone_evidence(fit),
        "transients": transients_evidence(photos.tracks, fit, photos.expected),
        "vignetting": vignetting_evidence(photos.tracks, fit),
        "scale": scale_evidence(photos.tracks),
        "blur": blur_evidence(photos.gradients),
        "rolling_shutter": rolling_shutter_evidence(residuals.residual, row, motion, residuals.view),
        "participating_media": media_evidence(photos.tracks, fit),
    }


def _is_video(ingest: Path) -> bool:
    from stages.photos import read_photos

    return any(photo.time_s is not None for photo in read_photos(ingest))


def _residuals(scene: "Scene", points: "dict[str, np.ndarray]") -> _Residuals:
    import numpy as np

    from stages.colmap.cameras import project

    number, parts = 0, []
    for index, view in enumerate(scene.views):
        if view.split != "train":
            continue
        mine = points["view"] == index
        point, xy = points["point"][mine].astype(int), points["xy"][mine].astype(float)
        pose = view.scene_from_camera
        local = (points["xyz"][point].astype(float) - pose[:, 3]) @ pose[:, :3]
        shown = project(scene.cameras[view.camera], local).reshape(-1, 2) if len(point) else xy
        inside = np.isfinite(shown).all(axis=1)  # NaN: behind the camera
        parts.append(((xy - shown)[inside], xy[inside], np.full(inside.sum(), number), point[inside]))
        number += 1
    return _Residuals(*(np.concatenate(column) for column in zip(*parts, strict=True)))
