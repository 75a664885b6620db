"""The page of the report and summary.json: what the finished stages left, and one function per part of the page."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from nerf.geometry.scene import Scene
from stages.contract import Inputs
from stages.evaluate.summary import scored_on
from stages.io.amounts import counted, duration, short_count
from stages.io.ascii_names import shell_quoted
from stages.io.files import SMALL_COPY, read_json, read_scene, read_tensors
from stages.io.pixels import load_view, pillow
from stages.report.cameras import (
    CameraReport,
    camera_models,
    camera_report,
    doubtful_files,
    missing,
    order_is_informative,
    strategies,
    uncertainty,
)
from stages.report.effects import effects_table
from stages.report.html import data_uri, jpeg_uri, templates
from stages.report.plots import ORDER_COLOURS, Score, camera_svgs, curve_svg, falloff_svg
from stages.report.profile import profile_bar
from stages.scale.lengths import length_in_words
from stages.tradeoff.plots import COLUMNS, plot_svg, rendering_sentence, table_cells
from stages.train.curve import diminishing_returns_message, doubling_message, more_option, predicted_gain, ssim_message

if TYPE_CHECKING:
    from stages.report import Config

WIDTH_LARGE, WIDTH_SMALL = 900, 420  # pixels of a picture in the page
THUMBNAIL_PX = 160
# The facts of stage mesh in words, with their units; the space of its grid is told with the iso-level.
MESH_FIGURES = {
    "faces": ("faces", ""),
    "vertices": ("vertices", ""),
    "watertight": ("watertight", ""),
    "boundary": ("boundary", ""),
    "surface_area": ("surface area", " square units of the files"),
    "frame": ("frame of the files", ""),
    "resolution": ("grid points along an edge", ""),
    "voxel": ("voxel size", " units of the files"),
    "iso_level": ("iso-level of the density", " per scene unit"),
    "iso_level_reason": ("why this iso-level", ""),
    "surface_error_voxels": ("distance from half of the transmittance", " voxels"),
    "components_kept": ("components kept", ""),
    "components_dropped": ("components removed", ""),
    "faces_outside_photos": ("faces removed outside of all photos", ""),
    "faces_hidden": ("faces removed that no photo sees", ""),
    "faces_in_fringes": ("faces removed at open ends, after decimation", ""),
    "holes_closed": ("holes closed", ""),
    "holes_left": ("holes left open", ""),
    "invented_area_share": ("area that closes holes", "%"),
    "refined_voxels": ("refinement moved vertices by", " voxels (median)"),
    "photo_agreement_before": ("agreement of photos before refinement", " of 1"),
    "photo_agreement": ("agreement of photos after refinement", " of 1"),
    "texture": ("texture", " pixels"),
    "texels_per_pixel": ("texture pixels per photo pixel", ""),
    "texture_without_photo": ("texture that no photo shows", "%"),
    "texture_outliers": ("photo colours left out as outliers", "%"),
    "appearance": ("colours are shown at", ""),
}
MAX_SMALL = 12  # further test photos shown, besides the best, the median and the worst


@dataclass(frozen=True)
class Results:
    """What the finished stages left. The parts of stages that have not run are None.

    The study has no part in ``manifests``: its time is none of the run's.
    """

    inputs: Inputs
    manifests: Mapping[str, dict[str, Any]]
    photos: dict[str, Any] | None
    registration: dict[str, Any] | None
    scene: Scene | None
    effects: dict[str, Any] | None
    field: dict[str, Any] | None
    curve: dict[str, Any] | None
    profile: dict[str, Any] | None
    metrics: dict[str, Any] | None
    stereo_check: dict[str, Any] | None
    study: dict[str, Any] | None


def read_results(inputs: Inputs, stages: Sequence[str]) -> Results:
    """Read what is there of the ``stages``, in their order. Raises StageError for a file that a finished stage must
    have left and did not."""

    def of(stage: str, name: str) -> Any:
        return read_json(inputs[stage] / name) if stage in inputs else None

    def if_there(stage: str, name: str) -> Any:
        return of(stage, name) if stage in inputs and (inputs[stage] / name).exists() else None

    return Results(
        inputs=inputs,
        manifests={stage: of(stage, "manifest.json") for stage in stages if stage in inputs and stage != "tradeoff"},
        photos=of("ingest", "photos.json"),
        registration=of("sfm", "registration.json"),
        scene=read_scene(inputs["normalise"]) if "normalise" in inputs else None,
        effects=of("effects", "effects.json"),
        field=of("train", "field.json"),
        curve=of("train", "curve.json"),
        profile=if_there("train", "profile.json"),
        metrics=of("evaluate", "metrics.json"),
        stereo_check=if_there("evaluate", "stereo_check.json"),
        study=of("tradeoff", "tradeoff.json"),
    )


def summarise(results: Results) -> dict[str, Any]:
    """The content of summary.json; null for what no stage has told."""
    manifests, registration, metrics = results.manifests, results.registration or {}, results.metrics or {}
    train = manifests["train"]["facts"] if "train" in manifests else {}
    mesh = manifests["mesh"]["facts"] if "mesh" in manifests else None
    scale = manifests["scale"]["facts"] if "scale" in manifests else {}
    cameras, photos = _camera_report(results), results.photos["photos"] if results.photos else []
    different = sum(not photo["near_duplicate_of"] for photo in photos) or None
    return {
        "photos": registration.get("photos", different),
        **{key: registration.get(key) for key in ("registered", "near_duplicates", "camera_model", "reprojection_px")},
        "cameras_verdict": cameras.verdict,
        "cameras_doubtful": cameras.doubt is not None,
        "field": results.field["kind"] if results.field else None,
        "train_seconds": train.get("train_seconds"),
        "total_seconds": round(train.get("earlier_seconds", 0.0) + sum(m["seconds"] for m in manifests.values()), 3),
        "stage_seconds": {stage: manifest["seconds"] for stage, manifest in manifests.items()},
        "expected_seconds": _expected(manifests),
        "training_profile": results.profile,
        **{key: metrics.get(key) for key in ("psnr", "ssim", "psnr_mean_image", "psnr_nearest_view")},
        "scored_fraction": metrics.get("fraction"),
        "metres_per_unit": scale.get("metres_per_unit"),
        "mesh": mesh and {key: mesh[key] for key in ("vertices", "faces", "watertight")},
        "verdict": metrics.get("verdict", "Not measured: stage evaluate has not run."),
    }


def _camera_report(results: Results) -> CameraReport:
    return camera_report(results.registration, results.manifests["sfm"]["config"] if results.registration else {})


def _expected(manifests: Mapping[str, dict[str, Any]]) -> dict[str, float]:
    """The seconds that stages were expected to take before their run began, where anybody could tell."""
    known = {stage: manifest.get("expected") for stage, manifest in manifests.items()}
    return {stage: seconds for stage, seconds in known.items() if seconds is not None}


def page(results: Results, summary: dict[str, Any], config: "Config") -> str:
    """The whole HTML page."""
    environment = templates(Path(__file__).parent)
    environment.filters |= {
        "counted": counted,
        "duration": duration,
        "short": short_count,
        "thousands": "{:,}".format,
        "metres": length_in_words,
        "value": _value,
        "quoted": shell_quoted,
    }
    names = {photo["file"]: photo["name"] for photo in results.photos["photos"]} if results.photos else {}
    return environment.get_template("report.html.j2").render(
        workspace=_workspace(results.inputs),
        summary=summary,
        rejected=results.photos["rejected"] if results.photos else [],
        **_cameras_part(results, names),
        effects=effects_table(results.effects),
        falloff=_falloff(results),
        curve=_curve(results),
        profile=profile_bar(results.profile),
        metrics=results.metrics,
        scored_on=scored_on(results.metrics) if results.metrics and results.metrics["images"] else None,
        compared=(compared := _compared(results)),
        stereo=_stereo(results),
        opening=_opening(results, compared),
        mesh_figures=_mesh_figures(results.manifests.get("mesh", {}).get("facts", {})),
        video=_video(results.inputs, config.video_limit_mb),
        **_mesh_part(results),
        study=_study(results),
        **_run_part(results, summary, config),
    )


def _falloff(results: Results) -> Markup | None:
    """The curves of effect vignetting; None without it."""
    learnt = (results.field or {}).get("effects", {}).get("vignetting")
    return Markup(falloff_svg(list(learnt.values()))) if learnt else None


def _cameras_part(results: Results, names: Mapping[str, str]) -> dict[str, Any]:
    """Stage sfm: the verdict on the cameras, the photos that it speaks of, where the cameras stood, how they were
    found."""
    return {
        "registration": results.registration,
        "camera_report": _camera_report(results),
        "camera_groups": _camera_groups(results, names),
        "cameras": _cameras(results),
        "lenses": camera_models(results.registration),
        "strategies": strategies(results.registration),
        "uncertainty": uncertainty(results.registration, names),
        "missing": missing(results.registration, names),
    }


def _mesh_part(results: Results) -> dict[str, Any]:
    """Stage mesh: its picture, its copy that turns, and the names of its files."""
    preview = results.inputs["mesh"] / "preview.png" if "mesh" in results.inputs else None
    files = results.manifests.get("mesh", {}).get("outputs", ())
    return {
        "mesh_preview": data_uri(preview.read_bytes(), "image/png") if preview and preview.exists() else None,
        "mesh_files": [name for name in files if name not in ("preview.png", SMALL_COPY)],
        "turntable": _turntable(results),
        "turntable_script": Markup(Path(__file__).with_name("turntable.js").read_text("utf-8")),
    }


def _turntable(results: Results) -> dict[str, Any] | None:
    """The small copy of the mesh as turntable.js takes it, first seen from where the first training photo was taken;
    None without one."""
    file = results.inputs["mesh"] / SMALL_COPY if "mesh" in results.inputs else None
    if file is None or not file.exists() or results.scene is None:
        return None
    small = read_tensors(file)
    eye = results.scene.of_split("train")[0].scene_from_camera[:, 3] - small["middle"]
    tilt = float(np.arctan2(eye[2], np.hypot(eye[0], eye[1])))
    content = b"".join(small[name].tobytes() for name in ("positions", "faces", "colours"))
    return {
        "vertices": len(small["positions"]),
        "faces": len(small["faces"]),
        "start": [float(np.arctan2(eye[0], -eye[1])), tilt],
        "data": base64.b64encode(content).decode("ascii"),
    }


def _run_part(results: Results, summary: dict[str, Any], config: "Config") -> dict[str, Any]:
    """How it was made: time of every stage, settings, machine."""
    manifests = results.manifests
    return {
        "manifests": manifests,
        "budget": config.budget,
        "expected": {} if config.budget else summary["expected_seconds"],
        "longest": max((manifest["seconds"] for manifest in manifests.values()), default=0) or 1,
        "settings": _settings(manifests),
        "machine": manifests.get("train", next(iter(manifests.values()), {})).get("machine", {}),
        "go_on": command_that_scores(results.inputs, config),
    }


def _settings(manifests: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Every option that has a flag, by its flag, in the order of the stages."""
    settings = {}
    for stage in manifests:
        for name, _ in sorted(import_module(f"stages.{stage}").Config.flags()):
            *group, option = name.split(".")
            values = manifests[stage]["config"]
            if (table := values.get(group[0]) if group else values) is not None:
                settings[f"--{stage}.{name.replace('_', '-')}"] = table.get(option)
    return settings


def _workspace(inputs: Inputs) -> str:
    """The workspace folder's own name: stage folders are <workspace>/<stage>/<key>."""
    return next((folder.resolve().parents[1].name for folder in inputs.values()), "")


def command_that_scores(inputs: Inputs, config: "Config") -> str:
    """`pipeline resume`, or where the last run ended before the score, the command of that."""
    repeated = config.resumed is None or "evaluate" in config.resumed
    return f"pipeline {'resume' if repeated else 'evaluate'} {shell_quoted(_workspace(inputs))}"


def _camera_groups(results: Results, names: Mapping[str, str]) -> list[dict[str, Any]]:
    """The photos that the verdict on the cameras speaks of: a title, names and pictures, how many more there are."""
    groups = _camera_report(results).groups if names else []
    return [
        {
            "title": group.title,
            "more": group.more,
            "photos": [
                {"name": names[f"images/{file}"], "picture": _thumbnail(results.inputs["ingest"] / "images" / file)}
                for file in group.files
            ],
        }
        for group in groups
    ]


def _thumbnail(path: Path) -> str | None:
    """A small picture of a photo, None where it is not there."""
    if not path.exists():
        return None
    with pillow().open(path) as picture:
        picture.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
        return jpeg_uri(Image.fromarray(_opaque(np.asarray(picture), 255)))


def _video(inputs: Inputs, limit_mb: float) -> str | None:
    """The video as a data URI, or its name beside the page where it is larger than the limit."""
    if "render" not in inputs:
        return None
    video = inputs["render"] / "video.mp4"
    return data_uri(video.read_bytes(), "video/mp4") if video.stat().st_size < limit_mb * 1e6 else "video.mp4"


def _cameras(results: Results) -> dict[str, Any] | None:
    """The layout of cameras that passed: ``svgs`` by the name of the view, and what a reader has to know of them."""
    if results.scene is None:
        return None
    doubtful = {f"images/{file}" for file in doubtful_files(results.registration)} if results.registration else set()
    drawn = [view for view in results.scene.views if view.file not in doubtful] or list(results.scene.views)
    points = read_tensors(results.inputs["normalise"] / "points.safetensors")
    joined = order_is_informative(results.registration)
    svgs = camera_svgs(results.scene, drawn, points["xyz"], points["rgb"], joined)
    return {
        "svgs": {name: Markup(svg) for name, svg in svgs.items()},
        "joined": joined,
        "colours": ORDER_COLOURS,
        "undrawn": len(results.scene.views) - len(drawn),
    }


def _curve(results: Results) -> dict[str, Any] | None:
    """The training curve, and what it says of the time, in sentences."""
    if results.curve is None:
        return None
    points, metrics = results.curve["points"], results.metrics or {}
    baselines = {"nearest training view": "psnr_nearest_view", "mean image": "psnr_mean_image"}
    coming = predicted_gain(results.curve["field"], results.curve["single_cycle"], points)
    scored = metrics.get("psnr") is not None
    score = Score(metrics["psnr"], metrics["psnr_interval"]) if scored else None
    svg = curve_svg(points, {name: metrics.get(key) for name, key in baselines.items()}, coming, score)
    if svg is None:
        return None
    words = [doubling_message(points, coming), diminishing_returns_message(points), ssim_message(points)]
    threads = results.curve["threads"]
    where = "a GPU" if results.curve["device"] == "cuda" else counted(threads, "processor core")
    sentences = [f"{word[0].upper()}{word[1:]}." for word in words if word]
    return {"svg": Markup(svg), "words": sentences, "where": where, "more": more_option(points)}


def _study(results: Results) -> dict[str, Any] | None:
    """The study of cost and quality: recommendation, plot, table, and the ablation's pictures where there are any."""
    if results.study is None:
        return None
    ablation, field = results.inputs["tradeoff"] / "ablation.png", results.study["workspace_field"]
    train = results.inputs.get("train")
    return results.study | {
        "svg": Markup(plot_svg(results.study)),
        "columns": COLUMNS,
        "rendering": rendering_sentence(results.study["points"]),
        "rows": [{"cells": table_cells(row), "front": row["pareto_front"]} for row in results.study["points"]],
        "field_is_older": field and train and field["train"] != train.resolve().name,
        "sheet": data_uri(ablation.read_bytes(), "image/png") if ablation.exists() else None,
    }


def _compared(results: Results) -> dict[str, Any] | None:
    """Photo, render and error of the best, median and worst test photos, and of some of the others, small."""
    if results.metrics is None or results.scene is None or not results.metrics["images"]:
        return None
    ranked = sorted(results.metrics["images"], key=lambda image: (-image["psnr"], image["name"]))
    roles = {0: "best", len(ranked) // 2: "median", len(ranked) - 1: "worst"} if len(ranked) > 2 else {}
    large = roles or dict.fromkeys(range(len(ranked)), "test photo")
    others = [rank for rank in range(len(ranked)) if rank not in large]
    small = others[:: max(1, -(-len(others) // MAX_SMALL))]
    return {
        "large": [_pictures(results, ranked[rank], WIDTH_LARGE) | {"role": role} for rank, role in large.items()],
        "small": [_pictures(results, ranked[rank], WIDTH_SMALL) for rank in small],
        "ranked": ranked,
    }


def _stereo(results: Results) -> dict[str, Any] | None:
    """How the field's depth compares with stereo's, with pictures of the photos in which it differs most; None where
    nothing was compared."""
    found = results.stereo_check
    if found is None or not found["pixels"]:
        return None
    images = {image["name"]: image for image in found["images"]}
    files = {name: results.inputs["evaluate"] / images[name]["picture"] for name in found["worst"]}
    pictures = [images[name] | {"uri": jpeg_uri(Image.open(file))} for name, file in files.items()]
    supervised = results.manifests.get("train", {}).get("config", {}).get("depth", False)
    return found | {"pictures": pictures, "supervised": supervised}


def _opening(results: Results, compared: dict[str, Any] | None) -> dict[str, Any] | None:
    """The picture that leads to the viewer: the best render of a test photo; None where there is neither."""
    if not results.manifests.get("viewer", {}).get("facts", {}).get("drawn"):
        return None
    best = compared["large"][0] if compared else None
    return {"render": best and best["render"], "aspect": best["aspect"] if best else 1.5, "name": best and best["name"]}


def _pictures(results: Results, image: dict[str, Any], width: int) -> dict[str, Any]:
    """One test photo's figures with its photo, render and error map as data URIs, all of one size."""
    assert results.scene is not None
    view = next(view for view in results.scene.views if view.name == image["name"])
    render = Image.open(results.inputs["evaluate"] / image["render"])
    error = Image.open(results.inputs["evaluate"] / image["error"])
    size = (min(width, render.width), max(1, round(render.height * min(1, width / render.width))))
    assert results.metrics is not None
    background = round(255 * results.metrics["background"][0])
    photo = Image.fromarray(_opaque(load_view(results.inputs["ingest"], view, *size), background))
    pictures = {"photo": photo, "render": render.resize(size, Image.Resampling.BOX), "error": error.resize(size)}
    aspect = round(size[0] / size[1], 4)
    return image | {"aspect": aspect} | {name: jpeg_uri(picture) for name, picture in pictures.items()}


def _opaque(pixels: np.ndarray, background: int) -> np.ndarray:
    """(H, W, 3) uint8 from (H, W, 3 or 4): transparent photos over a grey level, as they were scored."""
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3:] / 255
    return np.rint(pixels[..., :3] * alpha + background * (1 - alpha)).astype(np.uint8)


def _mesh_figures(facts: dict[str, Any]) -> list[tuple[str, Any, str]]:
    """What stage mesh told, in the order of MESH_FIGURES: words, value, unit."""
    found = []
    for name, (words, unit) in MESH_FIGURES.items():
        fact = facts.get(name)
        if unit == "%" and fact is not None:
            fact = 100 * fact
        if name == "iso_level":
            unit = " per unit of normalised device coordinates" if facts.get("grid_space") == "ndc" else unit
        if name in facts:
            found.append((words, fact, "" if fact is None else unit))
    return found


def _value(value: Any) -> str:
    """A setting or fact in words; of an absolute path only the name, so that the page can be given away."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    if isinstance(value, list):
        return ", ".join(map(_value, value))
    if isinstance(value, dict):
        return ", ".join(f"{key} {_value(entry)}" for key, entry in value.items())
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else str(value)
