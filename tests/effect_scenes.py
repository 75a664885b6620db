"""Synthetic photo sets with one effect or several, as finished folders of ingest, sfm and normalise: exact cameras and
tracks of the demo's still life, without structure from motion."""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerf.effects.exposure import expose
from nerf.geometry.normalisation import normalise
from nerf.geometry.rays import Rays
from nerf.geometry.reconstruction import Reconstruction
from nerf.geometry.rotations import rotation_from_vector
from nerf.geometry.scene import Camera, Scene, View
from nerf.synthetic.scenes import SyntheticScene, photograph, ring_of_cameras, still_life
from stages.io.files import write_json, write_tensors
from stages.io.photos import Photo, write_photos
from tests.camera_layouts import opaque_everywhere
from tests.small_scenes import pinhole_directions

WIDTH, HEIGHT, FOCAL = 240, 180, 250.0
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
POINTS, MATCHED, TRACK_NOISE_PX = 3000, 0.6, 0.3


@dataclass(frozen=True)
class Effects:
    """How the photos differ from plain ones. ``exposure_ev``: photos are brighter or darker by up to so much.
    ``highlight``: strength of mirror-like reflections. ``jitter_px``: by how much poses are wrong. ``alpha``: the sky
    is transparent. ``vignetting_ev``: darker at the corner. ``strangers``: share of photos in which somebody passes by.
    ``farther``: distance of every other camera over the usual one."""

    exposure_ev: float = 0.0
    highlight: float = 0.0
    jitter_px: float = 0.0
    alpha: bool = False
    vignetting_ev: float = 0.0
    strangers: float = 0.0
    farther: float = 1.0


def effect_scene(folder: Path, effects: Effects, seed: int = 0, views: int = 24) -> dict[str, Path]:
    """Write the folders; every eighth photo is a test photo."""
    inputs = {name: folder / name for name in ("ingest", "sfm", "normalise")}
    (inputs["ingest"] / "images").mkdir(parents=True)
    for name in ("sfm", "normalise"):
        inputs[name].mkdir()
    random = np.random.default_rng(seed)
    world = still_life(seed, effects.highlight)
    poses = ring_of_cameras(views, seed)
    poses[1::2, :, 3] *= effects.farther
    photos = [f"{index:03d}.png" for index in range(views)]
    for name, pose in zip(photos, poses, strict=True):
        picture = _photo(world, pose, _plain_photo(seed, effects.highlight, pose.tobytes()), effects, random)
        Image.fromarray(picture).save(inputs["ingest"] / "images" / name, compress_level=1)
    about = [Photo(n, f"images/{n}", WIDTH, HEIGHT, 0, None, None, effects.alpha, 1.0) for n in photos]
    write_photos(inputs["ingest"], about, [], {})
    points, view, point, xy = _tracks(world, poses, random)
    jitter = effects.jitter_px / FOCAL * random.normal(size=(views, 3)) / math.sqrt(2)
    turned = rotation_from_vector(torch.tensor(jitter)).numpy() @ poses[:, :, :3]
    calibrated = np.concatenate([turned, poses[:, :, 3:]], axis=2)
    _write_scene(inputs, photos, calibrated, (points, view, point, xy), effects.alpha)
    return inputs


@lru_cache(maxsize=128)  # photos of five scenes: they take longer than all that is done with them
def _plain_photo(seed: int, highlight: float, pose: bytes) -> torch.Tensor:
    """A photo of ``still_life(seed, highlight)`` without any effect, (height, width, 3)."""
    matrix = torch.tensor(np.frombuffer(pose).reshape(3, 4), dtype=torch.float32)
    return photograph(still_life(seed, highlight), pinhole_directions(2 * WIDTH, 2 * HEIGHT, 2 * FOCAL), matrix, 2)


def _photo(
    world: SyntheticScene, pose: np.ndarray, plain: torch.Tensor, effects: Effects, random: np.random.Generator
) -> np.ndarray:
    """One photo, (height, width, 3 or 4) uint8."""
    gain = math.log(2) * random.uniform(-effects.exposure_ev, effects.exposure_ev)
    across, down = (np.arange(WIDTH) + 0.5) / WIDTH - 0.5, (np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5
    square = (across[None, :] * WIDTH) ** 2 + (down[:, None] * HEIGHT) ** 2
    falling = -math.log(2) * effects.vignetting_ev * square / (WIDTH**2 + HEIGHT**2) * 4
    colour = expose(plain, torch.tensor(gain + falling, dtype=torch.float32)[..., None].expand_as(plain))
    if random.uniform() < effects.strangers:
        left, top = random.integers(0, WIDTH // 2), random.integers(0, HEIGHT // 3)
        colour[top : top + 2 * HEIGHT // 3, left : left + WIDTH // 4] = torch.tensor(random.uniform(size=3)).float()
    pixels = (255 * colour.clamp(0, 1)).round().byte().numpy()
    if not effects.alpha:
        return pixels
    matrix = torch.tensor(pose, dtype=torch.float32)
    rays = _rays(pinhole_directions(WIDTH, HEIGHT, FOCAL), matrix)
    hit = world.intersect(rays.origins, rays.directions).isfinite().any(0)
    return np.concatenate([pixels, 255 * hit.numpy()[..., None].astype(np.uint8)], axis=2)


def _rays(directions: torch.Tensor, pose: torch.Tensor) -> Rays:
    turned = directions @ pose[:, :3].T
    none = torch.zeros_like(turned[..., 0])
    return Rays(pose[:, 3].expand_as(turned).contiguous(), turned, none, none + math.inf)


def _tracks(world: SyntheticScene, poses: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """World points, and observations: view, point, pixels; of those that a photo sees some are matched."""
    points = world.surface_points(POINTS, int(random.integers(1 << 30)))[0].double().numpy()
    seen = []
    for number, pose in enumerate(poses):
        local = (points - pose[:, 3]) @ pose[:, :3]
        xy = FOCAL * local[:, :2] / np.maximum(local[:, 2:], 1e-6) + [WIDTH / 2, HEIGHT / 2]
        inside = (local[:, 2] > 0) & ((xy > 2) & (xy < [WIDTH - 2, HEIGHT - 2])).all(axis=1)
        chosen = np.flatnonzero(inside & (random.uniform(size=len(points)) < MATCHED))
        towards = torch.tensor(points[chosen] - pose[:, 3], dtype=torch.float32)
        distance = towards.norm(dim=-1)
        origin = torch.tensor(pose[:, 3], dtype=torch.float32).expand_as(towards)
        depth = world.intersect(origin, towards / distance[:, None]).amin(0)
        chosen = chosen[((depth - distance).abs() < 5e-3).numpy()]
        noisy = xy[chosen] + TRACK_NOISE_PX * random.normal(size=(len(chosen), 2))
        seen.append((np.full(len(chosen), number), chosen, noisy))
    view, point, xy = (np.concatenate(column) for column in zip(*seen, strict=True))
    several = np.bincount(point, minlength=len(points)) > 1
    kept, number = several[point], np.cumsum(several) - 1
    return points[several], view[kept], number[point[kept]], xy[kept]


def _write_scene(
    inputs: dict[str, Path],
    photos: list[str],
    poses: np.ndarray,
    tracks: tuple[np.ndarray, ...],
    has_alpha: bool,
) -> None:
    points, view, point, xy = tracks
    ray_directions = pinhole_directions(32, 32, 32 * FOCAL / WIDTH).reshape(-1, 3).double().numpy()
    sfm = Reconstruction(poses, np.repeat(ray_directions[None], len(poses), 0), points, view, point)
    found = normalise(opaque_everywhere(sfm) if has_alpha else sfm, None)
    views = tuple(
        View(
            name,
            f"images/{name}",
            0,
            found.scene_from_sfm.pose(poses[index]),
            float(found.near[index]),
            float(found.far[index]),
            "train" if index % 8 else "test",
        )
        for index, name in enumerate(photos)
    )
    scene = Scene((CAMERA,), views, found.scene_from_sfm, found.bounded, has_alpha, found.capture_type, found.up.known)
    write_json(inputs["normalise"] / "scene.json", scene.to_json())
    tensors = {
        "xyz": found.scene_from_sfm.points(points).astype(np.float32),
        "rgb": np.zeros((len(points), 3), np.uint8),
        "error_px": np.zeros(len(points), np.float32),
        "view": view.astype(np.int32),
        "point": point.astype(np.int32),
        "xy": xy.astype(np.float32),
    }
    write_tensors(inputs["normalise"] / "points.safetensors", tensors)
    images = [{"file": name, "registered": True, "reason": None, "uncertainty_px": None} for name in photos]
    write_json(inputs["sfm"] / "registration.json", {"images": images, "camera_models": []})
