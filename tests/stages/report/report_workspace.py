"""A workspace as the stages leave it, made up: what the tests of the report show."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages import report
from stages.io.files import write_json, write_tensors

NASTY = "<script>alert(1)</script>.jpg"
FACTS = {
    "scale": {"metres_per_unit": 0.5, "relative_error": 0.002, "source": "marker"},
    "mesh": {"vertices": 105_900, "faces": 211_817, "watertight": False, "components_kept": 1},
    "train": {"train_seconds": 183.3, "restarts": 0, "rollbacks": 2},
    "render": {"path": "orbit", "frames": 120, "width": 96, "height": 72, "fps": 24},
}
CAMERA_MODELS = [
    {"group": 0, "photos": 24, "model": model, "principal_point": place, "free_parameters": free, "chosen": worse == 0}
    | {"held_out_px": error, "worse_px": worse, "noise_px": noise, "reason": reason}
    for model, place, free, error, worse, noise, reason in [
        ("SIMPLE_RADIAL", "fixed", 2, 0.6912, 0.0812, 0.0101, None),
        ("OPENCV", "refined", 8, 0.6100, 0.0, 0.0, None),
        ("OPENCV_FISHEYE", "refined", 8, None, None, None, "its distortion has no inverse at 2.0% of the pixels"),
    ]
]
SPANS = {"profiled_steps": 19, "seconds": 5.0, "core_seconds": 10.0, "efficiency": 0.6} | {
    "rays": 19_456,
    "colour_evaluations": 243_200,
    "density_evaluations": 583_680,
    "rates": {"matmul_flops": 80_123_456_789, "gathered_rows": 150_000_000, "streamed_bytes": 19_000_000_000},
    "spans": [
        {"span": "backward", "seconds": 5.0, "share": 0.5, "min_seconds": 3.5},
        {"span": "mlp", "seconds": 3.0, "share": 0.3, "min_seconds": 1.9},
        {"span": "idle", "seconds": 1.0, "share": 0.1, "min_seconds": None},
        {"span": "rest", "seconds": 1.0, "share": 0.1, "min_seconds": None},
    ],
    "max_rays_per_second": 7205.9,
}
LINES = {
    "ingest": "24 photos 96×72, one camera",
    "sfm": "23/24 registered, 0.61 px",
    "normalise": "around an object, bounded",
    "scale": "1 unit = 50 cm ± 0.4% by 2 markers",
    "train": "180 s · 24 k rays/s · 21.4 dB on test pixels",
    "evaluate": "21.4 ± 0.4 dB, SSIM 0.61",
    "render": "orbit, 120 frames",
    "mesh": "212 k faces, 1 component, open at the back",
}


def make_workspace(root: Path, width: int = 96, height: int = 72, count: int = 24) -> dict[str, Path]:
    """Folders as the stages leave them, with ``count`` cameras on a ring and one photo that did not register."""
    inputs = {stage: root / "fox.nerf" / stage / "0123456789abcdef" for stage in LINES}
    for stage, folder in inputs.items():
        folder.mkdir(parents=True)
        _write_manifest(folder, stage)
    names = [NASTY if i == 8 else f"IMG_{i:04d}.jpg" for i in range(count)]
    _write_photos(inputs["ingest"], names, (width, height))
    _write_registration(inputs["sfm"], count)
    scene = _scene(names, (width, height))
    write_json(inputs["normalise"] / "scene.json", scene.to_json())
    rng = np.random.default_rng(0)
    points = {"xyz": rng.normal(0, 0.3, (2000, 3)).astype(np.float32), "rgb": _colours(rng, 2000)}
    write_tensors(inputs["normalise"] / "points.safetensors", points)
    _write_training(inputs["train"])
    _write_metrics(inputs["evaluate"], scene, (width, height))
    (inputs["render"] / "video.mp4").write_bytes(b"not really a video" * 100)
    Image.new("RGB", (64, 48), (90, 120, 150)).save(inputs["mesh"] / "preview.png")
    return inputs


def _colours(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(40, 220, (count, 3)).astype(np.uint8)


def _write_manifest(folder: Path, stage: str) -> None:
    config = {"evaluate": {"background": "white", "downscale": None}, "ingest": {"photos": "/home/someone/fox"}}
    machine = {"cores": 2, "gpu": None, "memory_gb": 23.5, "python": "3.11.9", "torch": "2.13.0"}
    manifest = {"stage": stage, "config": config.get(stage, {"seed": 0}), "facts": FACTS.get(stage, {})}
    seconds = {"sfm": 58.2, "train": 181.7, "render": 60.1}.get(stage, 2.5)
    write_json(folder / "manifest.json", manifest | {"line": LINES[stage], "seconds": seconds, "machine": machine})


def _write_photos(folder: Path, names: list[str], size: tuple[int, int]) -> None:
    (folder / "images").mkdir()
    photos = [{"name": name, "file": f"images/{i:04d}.png", "near_duplicate_of": None} for i, name in enumerate(names)]
    photos.append({"name": "blurred <b>.jpg", "file": "images/9999.png", "near_duplicate_of": None})
    refused = [{"name": "notes & sums.jpg", "reason": "not an image: text"}]
    write_json(folder / "photos.json", {"photos": photos, "rejected": refused, "frames": {}})
    for i, _ in enumerate(names):
        _picture(i, size).save(folder / f"images/{i:04d}.png")


def _write_registration(folder: Path, count: int) -> None:
    images: list[dict[str, object]] = [
        {"file": f"{i:04d}.png", "registered": True, "reason": None, "uncertainty_px": (i + 1) / 50}
        for i in range(count)
    ]
    reason = "only 12 matches with any other photo"
    images.append({"file": "9999.png", "registered": False, "reason": reason, "uncertainty_px": None})
    content = {"source": "sfm", "photos": count + 1, "registered": count, "reprojection_px": 0.61, "points": 8123}
    content |= {"near_duplicates": 0}
    lenses = {"camera_model": "OPENCV", "camera_models": CAMERA_MODELS}
    write_json(folder / "registration.json", content | lenses | {"images": images})


def _scene(names: list[str], size: tuple[int, int]) -> Scene:
    views = []
    for i, name in enumerate(names):
        angle = 2 * math.pi * i / len(names)
        forward = np.array([-math.cos(angle), -math.sin(angle), -0.3]) / math.hypot(1, 0.3)
        right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
        pose = np.stack([right, np.cross(forward, right), forward, -2.2 * forward], axis=1)
        split = "train" if i % 4 else "test"
        views.append(View(name, f"images/{i:04d}.png", 0, pose, 0.5, 4.0, split))
    camera = Camera("SIMPLE_PINHOLE", *size, (1.2 * size[0], size[0] / 2, size[1] / 2))
    return Scene((camera,), tuple(views), Similarity(1.0, np.eye(3), np.zeros(3)), True, False, "object-centric", True)


def _write_training(folder: Path) -> None:
    curve = [
        {"step": 50 * k, "seconds": 5 * 1.35**k, "train_psnr": 21 - 9 * 0.8**k, "probe_psnr": 21.5 - 10 * 0.8**k}
        | {"probe_ssim": 0.8 - 0.4 * 0.8**k}
        for k in range(13)
    ]
    about = {"field": "grid", "device": "cpu", "threads": 2, "single_cycle": True}
    write_json(folder / "curve.json", about | {"points": curve})
    write_json(folder / "field.json", {"kind": "vanilla", "downscale": 1.0, "steps": 600, "rays": 600_000})
    write_json(folder / "profile.json", SPANS)


def _write_metrics(folder: Path, scene: Scene, size: tuple[int, int]) -> None:
    for name in ("renders", "errors"):
        (folder / name).mkdir()
    images = []
    for rank, view in enumerate(scene.of_split("test")):
        file = Path(view.file).name
        _picture(rank * 4, size, blur=True).save(folder / "renders" / file)
        Image.new("RGB", size, (60 + rank, 20, 80)).save(folder / "errors" / file)
        figures = {"psnr": 19.0 + rank, "ssim": 0.5 + rank / 20, "psnr_mean_image": 12.9, "psnr_nearest_view": 14.2}
        figures |= {"psnr_right_half": 18.5 + rank, "psnr_exposure_fitted": 23.25 + rank, "psnr_pose_fitted": None}
        images.append({"name": view.name, "render": f"renders/{file}", "error": f"errors/{file}"} | figures)
    overall = {"psnr": 21.5, "ssim": 0.62, "psnr_mean_image": 12.9, "psnr_nearest_view": 14.2}
    overall |= {"psnr_right_half": 21.0, "psnr_exposure_fitted": 25.8, "psnr_pose_fitted": None}
    overall |= {"poses_fitted": False, "appearance": []}
    counts = {
        "background": [1.0, 1.0, 1.0],
        "photos_scored": len(images),
        "photos_test": len(images),
        "fraction": 0.25,
        "photo_size": [*size],
        "scored_size": [*size],
        "trained_size": [size[0] // 2, size[1] // 2],
        "error_scale": [0, 0.3],
    }
    words = {
        "notes": [{"code": "evaluate.no-lpips", "text": "LPIPS is not computed"}],
        "verdict": "Better than the nearest training view by 7.3 dB but soft.",
    }
    write_json(folder / "metrics.json", {"psnr_interval": [21.1, 21.9], "images": images} | overall | counts | words)


def _picture(seed: int, size: tuple[int, int], blur: bool = False) -> Image.Image:
    """Something to look at: soft waves, sharper without ``blur``."""
    x, y = np.meshgrid(np.linspace(0, 6, size[0]), np.linspace(0, 4, size[1]))
    waves = np.stack([np.sin(x * (1 if blur else 3) + seed), np.cos(y * (1 if blur else 2)), np.sin(x + y)], -1)
    return Image.fromarray((127 + 90 * waves).astype(np.uint8))


def written(inputs: dict[str, Path], folder: Path, progress: Any, **settings: Any) -> tuple[str, dict[str, Any]]:
    """The page and the summary of a workspace."""
    folder.mkdir()
    result = report.run(report.Config(**settings), inputs, folder, progress)
    assert result.outputs == ("report.html", "summary.json")
    return (folder / "report.html").read_text("utf-8"), json.loads((folder / "summary.json").read_text("utf-8"))


def add_stereo_check(inputs: dict[str, Path], compared: int, supervised: bool) -> None:
    """As evaluate leaves it where there are depth maps: ``compared`` of 18 photos, of which one has no depth."""
    figures = {"pixels": 2048, "differ": 0.0831, "nearer": 0.0514, "median_difference": 0.0093}
    images: list[dict[str, Any]] = [{"name": f"IMG_{i:04d}.jpg"} | figures for i in range(1, compared)]
    images.append({"name": NASTY, "pixels": 0, "differ": None, "nearer": None, "median_difference": None})
    (inputs["evaluate"] / "stereo_check").mkdir()
    for image in [one for one in images if one["pixels"]][:2]:
        image["picture"] = f"stereo_check/{image['name'][:-4]}.png"
        _picture(3, (64, 48)).save(inputs["evaluate"] / image["picture"])
    counts = {"photos_compared": compared, "photos_train": 18, "min_difference": 0.03}
    overall = figures | {"pixels": 2048 * (compared - 1)}
    worst = [image["name"] for image in images[:2]]
    write_json(inputs["evaluate"] / "stereo_check.json", counts | overall | {"images": images, "worst": worst})
    manifest = json.loads((inputs["train"] / "manifest.json").read_text("utf-8"))
    write_json(inputs["train"] / "manifest.json", manifest | {"config": {"depth": supervised}})
