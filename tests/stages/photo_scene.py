"""A tiny finished ingest, normalise and effects: photos of a ball, with exact cameras and points, as files."""

from pathlib import Path

import numpy as np
from PIL import Image

from nerf.geometry.scene import Camera, Scene, Similarity, View
from stages.effects.decisions import Decisions, write_decisions
from stages.io.files import write_json, write_png, write_tensors

WIDTH, HEIGHT, FOCAL = 24, 16, 20.0
RADIUS = 0.6  # of the ball
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))


def pose_towards_origin(angle: float, distance: float = 3.0) -> np.ndarray:
    """A camera on a horizontal circle that looks at the origin, z up."""
    centre = distance * np.array([np.cos(angle), np.sin(angle), 0])
    forward, down = -centre / distance, np.array([0, 0, -1.0])
    return np.stack([np.cross(down, forward), down, forward, centre], axis=1)


def ball_photo(channels: int = 3) -> np.ndarray:
    """A blue ball at the origin, seen from 3 units away; white, or nothing, behind it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    inside = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) < FOCAL * RADIUS / 3
    photo = np.where(inside[..., None], [30, 60, 200], 255)
    if channels == 4:
        photo = np.concatenate([photo, np.where(inside, 255, 0)[..., None]], axis=2)
    return photo.astype(np.uint8)


def photographed(
    folder: Path, views: int = 8, channels: int = 3, bounded: bool = True, mask: np.ndarray | None = None
) -> tuple[dict[str, Path], Scene]:
    """Write photos, scene.json and a ``mask`` (0 ignore, 255 use) for all; every fourth view is a test view."""
    inputs = {name: folder / name for name in ("ingest", "normalise", "effects")}
    (inputs["ingest"] / "images").mkdir(parents=True)
    inputs["normalise"].mkdir()
    inputs["effects"].mkdir()
    write_decisions(inputs["effects"], Decisions({"view_dependence": {}} | ({} if bounded else {"background": {}})))
    kept = []
    for index in range(views):
        file = f"images/{index:03d}.png"
        Image.fromarray(ball_photo(channels)).save(inputs["ingest"] / file)
        pose = pose_towards_origin(2 * np.pi * index / views)
        masked = None if mask is None else f"masks/{index:03d}.png.png"
        if mask is not None and masked:
            write_png(inputs["ingest"] / masked, mask)
        kept.append(View(f"{index}.png", file, 0, pose, 2.0, 4.0, "train" if index % 4 else "test", masked))
    still = Similarity(1.0, np.eye(3), np.zeros(3))
    scene = Scene((CAMERA,), tuple(kept), still, bounded, channels == 4, "object-centric", True)
    write_json(inputs["normalise"] / "scene.json", scene.to_json())
    write_tensors(inputs["normalise"] / "points.safetensors", seen_points(scene))
    return inputs, scene


def seen_points(scene: Scene) -> dict[str, np.ndarray]:
    """points.safetensors: 16 points around the ball's waist, each seen by the cameras that it is turned to."""
    angle = 2 * np.pi * np.arange(16) / 16
    xyz = RADIUS * np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)
    seen = []
    for number, view in enumerate(scene.views):
        rotation, centre = view.scene_from_camera[:, :3], view.scene_from_camera[:, 3]
        turned_to = np.flatnonzero(((centre - xyz) * xyz).sum(axis=1) > 0)
        x, y, z = ((xyz[turned_to] - centre) @ rotation).T
        xy = FOCAL * np.stack([x / z, y / z], axis=1) + [WIDTH / 2, HEIGHT / 2]
        seen += [(number, point, *place) for point, place in zip(turned_to, xy, strict=True)]
    view, point, *xy = np.array(seen).T
    return {
        "xyz": xyz.astype(np.float32),
        "rgb": np.tile(np.array([30, 60, 200], np.uint8), (16, 1)),
        "error_px": np.full(16, 0.5, np.float32),
        "view": view.astype(np.int32),
        "point": point.astype(np.int32),
        "xy": np.stack(xy, axis=1).astype(np.float32),
    }
