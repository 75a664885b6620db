"""From posed photos to the scene frame: region of interest, up vector, near and far, the split, the exports."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerf import REGION_HALF_SIZE
from nerf.geometry.normalisation import Normalisation, normalise
from nerf.geometry.reconstruction import Reconstruction, angles, extent
from nerf.geometry.region_of_interest import find_capture_type
from nerf.geometry.scene import Camera, Scene, Split, View
from nerf.geometry.up_vector import Witness, up_by_places
from stages.contract import Inputs, Progress, StageError, StageResult
from stages.io.amounts import counted
from stages.io.files import read_json, write_json, write_tensors
from stages.io.photos import Box, Photo, read_photos
from stages.io.sparse_model import SparseModel
from stages.io.transforms_export import transforms
from stages.normalise.alpha import Alpha, alpha_or_none, find_alpha
from stages.normalise.backdrop import backdrop_or_none, find_backdrop
from stages.normalise.split import split_photos
from stages.sfm.colmap.cameras import camera_rays
from stages.sfm.colmap.models import read_model

if TYPE_CHECKING:
    from stages.normalise import Config

MIN_TRAINING_VIEWS = 2
MIN_VIEWS = 3  # one to hold out, two to train on
FRUSTUM_SAMPLES = 32  # ray directions along each side of a photo
OPAQUE_SAMPLES = 128  # likewise, where the edges of what is opaque are told
FULL_TURN_DEG = 320.0  # no gap wider than the step of nine photos around


def normalise_scene(config: "Config", inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """The stage's work: read the sparse model, choose the scene frame, write the stage's files."""

    model = read_model(inputs["sfm"] / "sparse")
    _check(config, len(model.images))
    by_file = {photo.file: photo for photo in read_photos(inputs["ingest"])}
    posed = sorted(
        ((by_file[f"images/{image.file}"], i) for i, image in enumerate(model.images)), key=lambda pair: pair[0].name
    )
    photos, order = [photo for photo, _ in posed], [i for _, i in posed]
    sfm = _reconstruction(model, order)
    registration = read_json(inputs["sfm"] / "registration.json")
    split = _split(photos, config, registration["test_files"])
    alpha = find_alpha(inputs["ingest"], photos, model, order, split, find_capture_type(sfm), config.masks, progress)
    backdrop = None if alpha is not None else find_backdrop(inputs["ingest"], photos, split)
    # What is opaque in a test photo decides nothing.
    if (separates := alpha or backdrop) is not None:
        boxes = [box if part == "train" else None for box, part in zip(separates.opaque, split, strict=True)]
        sfm = replace(sfm, opaque=_opaque(model, order, boxes))
    try:
        found = normalise(sfm, config.roi, _up_by_gps(registration["georeference"], sfm, photos))
    except ValueError as error:
        hint = "Take photos from different places, or give --normalise.roi."
        raise StageError("normalise.no-scale", "the scene has no scale", str(error), hint) from error
    if alpha is not None:
        alpha = alpha_or_none(alpha, photos, found, config.roi is not None, progress)
    if backdrop is not None:
        backdrop = backdrop_or_none(backdrop, found, progress)
    scene = _scene(sfm, photos, [model.images[i].camera for i in order], model.cameras, found, split, alpha)
    scene = replace(scene, backdrop=None if backdrop is None else backdrop.colour)
    write_json(folder / "scene.json", scene.to_json())
    write_tensors(folder / "points.safetensors", _points(model, sfm, found))
    write_json(folder / "transforms.json", transforms(scene))
    masks = [view.mask or view.alpha for view in scene.views]
    if (without := masks.count(None)) and any(photo.mask for photo in photos):
        them = f"{without} of {len(scene.views)} have none (a white one uses all of its photo)"
        progress.note(
            "normalise.no-masks-exported",
            f"transforms.json names no masks: nerfstudio needs one for each photo, and {them}",
        )
    return StageResult(
        outputs=("scene.json", "points.safetensors", "transforms.json"),
        line=_line(scene, found),
        facts=_facts(scene, found, len(model.view)),
    )


def _check(config: "Config", views: int) -> None:
    if views < MIN_VIEWS:
        raise StageError(
            "normalise.few-photos",
            f"only {counted(views, 'registered photo')}",
            f"a scene needs at least {MIN_VIEWS}: two for training and one for testing",
            "Add photos that overlap with these.",
        )
    if config.roi and config.roi[3] <= 0:
        raise StageError(
            "normalise.roi-radius",
            f"--normalise.roi has half-side {config.roi[3]:g}",
            "the half-side of the region, the fourth number, must be above 0",
            "Give x y z half-side in the frame of output/transforms.json.",
        )


def _split(photos: list[Photo], config: "Config", official: list[str] | None) -> list[Split]:
    """The split of the photos. Raises StageError where it leaves too few to train on."""
    split = split_photos(photos, config.test_every, official)
    if split.count("train") < MIN_TRAINING_VIEWS:
        raise StageError(
            "normalise.few-training-photos",
            f"only {split.count('train')} of {len(split)} photos remain for training",
            "the others are held out as test photos",
            f"Add training photos, or {'change the given split' if official else 'raise --normalise.test-every'}.",
        )
    return split


def _reconstruction(model: SparseModel, order: list[int]) -> Reconstruction:
    """The sparse model as plain geometry, its photos in ``order``."""
    return Reconstruction(
        from_camera=np.stack([model.images[i].sfm_from_camera for i in order]),
        ray_directions=np.stack([grid.reshape(-1, 3) for grid in _rays(model, order, FRUSTUM_SAMPLES)]),
        points=model.xyz,
        view=np.argsort(order)[model.view],
        point=model.point,
    )


def _opaque(model: SparseModel, order: list[int], boxes: Sequence[Box | None]) -> np.ndarray:
    """What may be opaque in each photo, as in a Reconstruction: ``boxes`` hold it, None where all of it may be."""
    parts = [_within(grid, box) for grid, box in zip(_rays(model, order, OPAQUE_SAMPLES), boxes, strict=True)]
    return np.stack([extent(angles(part)) for part in parts])


def _rays(model: SparseModel, order: list[int], side: int) -> list[np.ndarray]:
    """Ray directions of each photo, (side, side, 3)."""
    of_cameras = [camera_rays(camera, side, side).astype(float) for camera in model.cameras]
    return [of_cameras[model.images[i].camera] for i in order]


def _up_by_gps(georeference: dict[str, Any] | None, sfm: Reconstruction, photos: list[Photo]) -> Witness | None:
    """Up by where GPS says that the photos were taken; None where it says nothing, or does not say how high."""

    located = [photo.latitude is not None and photo.longitude is not None for photo in photos]
    if georeference is None or any(photo.altitude_m is None for photo, has in zip(photos, located, strict=True) if has):
        return None
    return up_by_places(sfm.centres[located], np.array(georeference["enu_from_sfm"]), georeference["error_m"])


def _within(rays: np.ndarray, box: Box | None) -> np.ndarray:
    """Those of a photo's (side, side, 3) ray directions that go through a box, at least one along each side, (n, 3)."""
    if box is None:
        return rays.reshape(-1, 3)
    side, (left, top, right, bottom) = len(rays), box
    rows, columns = (slice(int(low * side), math.ceil(high * side)) for low, high in ((top, bottom), (left, right)))
    return rays[rows, columns].reshape(-1, 3)


def _scene(
    sfm: Reconstruction,
    photos: list[Photo],
    camera_of: list[int],
    cameras: Sequence[Camera],
    found: Normalisation,
    split: list[Split],
    alpha: Alpha | None,
) -> Scene:
    """The scene, its views in order of name. ``alpha`` None: alpha that is no background is one more mask."""

    of_masks = [None] * len(photos) if alpha is None else alpha.masks
    views = tuple(
        View(
            name=photo.name,
            file=photo.file,
            camera=camera_of[i],
            scene_from_camera=found.scene_from_sfm.pose(sfm.from_camera[i]),
            near=float(found.near[i]),
            far=float(found.far[i]),
            split=split[i],
            mask=_left_as_mask(photo, of_masks[i], alpha is not None),
            alpha=of_masks[i],
        )
        for i, photo in enumerate(photos)
    )
    return Scene(
        cameras=tuple(cameras),
        views=views,
        scene_from_sfm=found.scene_from_sfm,
        bounded=found.bounded,
        has_alpha=alpha is not None,
        capture_type=found.capture_type,
        up_known=found.up.known,
    )


def _left_as_mask(photo: Photo, alpha: str | None, has_alpha: bool) -> str | None:
    """The mask of a photo's view, beside the one that is its ``alpha``."""
    if not has_alpha:
        return photo.opaque_mask or photo.mask
    return None if alpha else photo.mask


def _points(model: SparseModel, sfm: Reconstruction, found: Normalisation) -> dict[str, np.ndarray]:
    """points.safetensors, as docs/FILES.md lists it."""

    return {
        "xyz": found.scene_from_sfm.points(model.xyz).astype(np.float32),
        "rgb": model.rgb.astype(np.uint8),
        "error_px": model.error_px.astype(np.float32),
        "view": sfm.view.astype(np.int32),
        "point": sfm.point.astype(np.int32),
        "xy": model.xy.astype(np.float32),
    }


def _line(scene: Scene, found: Normalisation) -> str:
    """What was decided, for the user."""
    arc = 360 if found.arc_deg > FULL_TURN_DEG else round(found.arc_deg / 10) * 10
    capture_type = {
        "object-centric": f"{arc}° around an object",
        "inside-out": "inside-out capture of a space",
        "forward-facing": "forward-facing capture",
    }[found.capture_type]
    background = "transparent" if scene.has_alpha else "plain" if scene.backdrop else "unbounded"
    up = f"up from {found.up.source}" if found.up.known else "no up vector: the cameras disagree"
    return f"{capture_type}, background {background} · {up}"


def _facts(scene: Scene, found: Normalisation, observations: int) -> dict[str, Any]:
    """The decisions and the numbers behind them."""

    return {
        "capture_type": scene.capture_type,
        "bounded": scene.bounded,
        "has_alpha": scene.has_alpha,
        "backdrop": scene.backdrop,
        "up": found.up.source,
        "up_known": scene.up_known,
        "arc_deg": round(found.arc_deg, 1),
        "share_beyond_region": round(found.beyond, 4) if observations else None,
        "region_half_sfm": REGION_HALF_SIZE / scene.scene_from_sfm.scale,
        "near": min(view.near for view in scene.views),
        "far": max(view.far for view in scene.views),
        "train": len(scene.of_split("train")),
        "test": len(scene.of_split("test")),
    }
