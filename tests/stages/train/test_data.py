import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.scene import Camera
from nerf.training.ray_dataset import PosedViews, make_ray_dataset
from stages.depth.consistency import DepthMap
from stages.depth.files import depth_map_file, write_depth_map
from stages.io.files import write_png, write_tensors
from stages.io.pixel_store import PixelStore, pixel_store
from stages.io.pixels import load_mask
from stages.train.config import WHITE
from stages.train.data import (
    MAX_PATCHES,
    PhotoReader,
    camera_directions,
    dataset_with_depths,
    patch_directions,
    scaled_size,
    training_dataset,
    view_mask,
    view_rays,
)
from tests.conftest import RecordedProgress
from tests.refusals import refused
from tests.stages.photo_scene import CAMERA, FOCAL, HEIGHT, RADIUS, WIDTH, ball_photo, photographed, seen_points


@given(st.integers(1, 9000), st.integers(1, 9000), st.floats(1.0, 50.0))
def test_scaled_sizes_are_within_half_a_pixel(width: int, height: int, downscale: float) -> None:
    scaled = scaled_size(Camera("PINHOLE", width, height, ()), downscale)
    for size, full in zip(scaled, (width, height), strict=True):
        assert isinstance(size, int) and size >= 1
        assert abs(size - full / downscale) <= 0.5 or size == 1


@pytest.mark.parametrize(
    ("downscale", "size"), [(1.0, (1417, 1064)), (2.0, (709, 532)), (2.5, (567, 426)), (1e9, (1, 1))]
)
def test_halves_are_rounded_up(downscale: float, size: tuple[int, int]) -> None:
    assert scaled_size(Camera("PINHOLE", 1417, 1064, ()), downscale) == size


def test_a_views_rays_go_through_its_pixel_centres(tmp_path: Path) -> None:
    _, scene = photographed(tmp_path)
    view = scene.views[1]
    rays = view_rays(scene, view, 1.0)
    assert rays.near.shape == (HEIGHT, WIDTH)
    assert torch.all(rays.near == view.near) and torch.all(rays.far == view.far)
    in_camera = np.array([(3.5 - WIDTH / 2) / FOCAL, (5.5 - HEIGHT / 2) / FOCAL, 1])
    expected = view.scene_from_camera[:, :3] @ in_camera / np.linalg.norm(in_camera)
    np.testing.assert_allclose(rays.directions[5, 3], expected, atol=1e-6)
    np.testing.assert_allclose(rays.origins[5, 3], view.scene_from_camera[:, 3], atol=1e-6)


@pytest.mark.parametrize("downscale", [1.0, 2.0, 3.3])
def test_the_ray_dataset_has_the_views_pixels_and_rays(
    downscale: float, tmp_path: Path, progress: RecordedProgress
) -> None:
    inputs, scene = photographed(tmp_path)
    dataset = training_dataset(inputs["ingest"], scene, "train", downscale, progress)
    rays, colours, alpha, _ = dataset.lookup(torch.arange(len(dataset.pixels)))
    views = scene.of_split("train")
    assert alpha is None and len(dataset.near) == len(views) == 6
    reader = PhotoReader(inputs["ingest"], scene, downscale)
    pixels = [reader.pixels(view, WHITE).flatten(0, 1) for view in views]
    assert torch.equal(colours, torch.cat(pixels))
    directions = [view_rays(scene, view, downscale).directions.flatten(0, 1) for view in views]
    torch.testing.assert_close(rays.directions, torch.cat(directions))


def test_transparent_pixels_are_shown_over_the_background(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path, channels=4)
    reader = PhotoReader(inputs["ingest"], scene, 1.0)
    over_white = reader.pixels(scene.views[0], WHITE)
    torch.testing.assert_close(over_white, torch.from_numpy(ball_photo()).float() / 255)
    over_green = reader.pixels(scene.views[0], (0.0, 1.0, 0.0))
    assert over_green[0, 0].tolist() == [0, 1, 0]
    assert training_dataset(inputs["ingest"], scene, "train", 1.0, progress).pixels.shape[1] == 4


@pytest.mark.parametrize("downscale", [1.0, 2.0, 3.3])
def test_a_mask_can_be_the_alpha(downscale: float, tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path / "masks", mask=np.ascontiguousarray(ball_photo(4)[..., 3]))
    views = tuple(replace(view, mask=None, alpha=view.mask) for view in scene.views)
    by_mask = training_dataset(
        inputs["ingest"], replace(scene, has_alpha=True, views=views), "train", downscale, progress
    )
    inputs, scene = photographed(tmp_path / "alpha", channels=4)
    by_photo = training_dataset(inputs["ingest"], scene, "train", downscale, progress)
    assert by_mask.runs is None and torch.equal(by_mask.pixels, by_photo.pixels)


@pytest.mark.parametrize("downscale", [1.0, 2.0])
def test_ignored_alpha_is_like_a_mask(downscale: float, tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path, channels=4)
    write_png(inputs["ingest"] / "opaque/all.png", ball_photo(4)[..., 3].copy())
    views = tuple(replace(view, mask="opaque/all.png") for view in scene.views)
    opaque = replace(scene, has_alpha=False, views=views)
    dataset = training_dataset(inputs["ingest"], opaque, "train", downscale, progress)
    assert dataset.pixels.shape[1] == 3
    used = view_mask(inputs["ingest"], opaque, opaque.views[1], downscale)
    assert used is not None and 0 < used.float().mean() < 0.5
    assert dataset.unmasked_count == 6 * used.sum()
    drawn = dataset.lookup(dataset.unmasked_pixels(torch.arange(dataset.unmasked_count))).colour * 255
    assert torch.equal(drawn, torch.tensor([30.0, 60.0, 200.0]).expand_as(drawn)), "no white of what was cut out"
    assert view_mask(inputs["ingest"], scene, scene.views[1], downscale) is None


def test_an_opaque_photo_covers_every_pixel(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path, channels=3)
    dataset = training_dataset(inputs["ingest"], replace(scene, has_alpha=True), "train", 1.0, progress)
    assert dataset.pixels.shape[1] == 4
    assert (dataset.pixels[:, 3] == 255).all()
    assert torch.equal(dataset.pixels[: WIDTH * HEIGHT, :3], torch.from_numpy(ball_photo()).flatten(0, 1))


def test_cameras_of_test_views_do_not_enter_the_training_dataset(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path)
    other = replace(CAMERA, params=(FOCAL, FOCAL, 1.0, 1.0))
    views = tuple(replace(view, camera=int(view.split == "train")) for view in scene.views)
    mixed = replace(scene, cameras=(other, CAMERA), views=views)
    dataset = training_dataset(inputs["ingest"], mixed, "train", 1.0, progress)
    assert dataset.patches.shape[1] == WIDTH * HEIGHT
    assert torch.equal(dataset.patches, training_dataset(inputs["ingest"], scene, "train", 1.0, progress).patches)


def test_evaluation_reads_the_pixels_that_training_stored(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path)
    ingest, trained, held_out = inputs["ingest"], scene.of_split("train")[2], scene.of_split("test")[1]
    reader = PhotoReader(ingest, scene, 2.0)
    decoded = [reader.pixels(view, WHITE) for view in (trained, held_out)]
    for split in ("train", "test"):
        training_dataset(ingest, scene, split, 2.0, progress)
    for view, pixels in zip((trained, held_out), decoded, strict=True):
        (ingest / view.file).unlink()
        assert torch.equal(reader.pixels(view, WHITE), pixels)


def test_pixel_store_is_asked_once_a_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found_out(ingest: Path, name: str, *rest: Any) -> PixelStore:
        asked.append(name)
        return pixel_store(ingest, name, *rest)

    inputs, scene = photographed(tmp_path)
    asked = list[str]()
    monkeypatch.setattr("stages.train.data.pixel_store", found_out)
    reader = PhotoReader(inputs["ingest"], scene, 1.0)
    for view in scene.views:
        reader.pixels(view, WHITE)
    assert sorted(asked) == ["test", "train"]


LENSES = {
    "none": Camera("PINHOLE", 4000, 3000, (3000.0, 3000.0, 2010.0, 1490.0)),
    "phone": Camera("SIMPLE_RADIAL", 4000, 3000, (3000.0, 2000.0, 1500.0, 0.1)),
    "action camera": Camera("OPENCV", 4000, 3000, (2200.0, 2200.0, 2000.0, 1500.0, -0.25, 0.06, 1e-3, 1e-3)),
    "fisheye": Camera("OPENCV_FISHEYE", 4000, 3000, (2000.0, 2000.0, 2000.0, 1500.0, 0.02, -0.005, 0.0, 0.0)),
}


@pytest.mark.parametrize(
    ("lens", "limit_px"), [("none", 5e-4), ("phone", 3e-3), ("action camera", 3e-2), ("fisheye", 6e-2)]
)
def test_patches_bend_no_ray(lens: str, limit_px: float) -> None:
    camera, downscale = LENSES[lens], 4.0
    width, height = scaled_size(camera, downscale)
    directions = patch_directions(camera, downscale)
    assert max(directions.shape[:2]) == MAX_PATCHES < width
    placed = PosedViews(torch.eye(3, 4)[None], torch.ones(1), torch.ones(1))
    dataset = make_ray_dataset(
        torch.zeros(width * height, 3, dtype=torch.uint8), [(height, width)], [0], [directions], placed
    )
    found = dataset.lookup(torch.arange(width * height))[0].directions
    exact = camera_directions(camera, downscale).view(-1, 3)
    off_px = (found.double() - exact.double()).norm(dim=1).max() * camera.params[0] / downscale
    assert 0 < off_px < limit_px


def half_mask() -> np.ndarray:
    """Ignores the right side from x = 11 on."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, 11:] = 0
    return mask


@pytest.mark.parametrize(("downscale", "columns"), [(1.0, 11), (2.0, 5), (3.0, 3)])
def test_a_reduced_pixel_is_used_where_all_it_covers_is(
    downscale: float, columns: int, tmp_path: Path, progress: RecordedProgress
) -> None:
    inputs, scene = photographed(tmp_path, mask=half_mask())
    used = view_mask(inputs["ingest"], scene, scene.views[0], downscale)
    assert used is not None
    width, height = scaled_size(CAMERA, downscale)
    assert used.shape == (height, width)
    assert torch.equal(used, (torch.arange(width) < columns).expand(height, width))
    dataset = training_dataset(inputs["ingest"], scene, "train", downscale, progress)
    assert (dataset.unmasked_count, len(dataset.pixels)) == (6 * height * columns, 6 * height * width)
    assert progress.codes[-1] == "train.masked" and progress.names("train.masked", f"{columns / width:.0%}", "training")


def test_masks_are_loaded_a_few_at_a_time_and_dropped(
    tmp_path: Path, progress: RecordedProgress, monkeypatch: pytest.MonkeyPatch
) -> None:
    """500 of 12 megapixels would be 6 GB."""

    def load(*asked: Any) -> np.ndarray:
        loaded.append(weakref.ref(mask := load_mask(*asked)))
        alive.append(sum(each() is not None for each in loaded))
        return mask

    loaded, alive = list[weakref.ref[np.ndarray]](), list[int]()
    inputs, scene = photographed(tmp_path, views=16, mask=half_mask())
    monkeypatch.setattr("stages.train.data.load_mask", load)
    monkeypatch.setattr("stages.train.data.loaders", lambda files, channels: 2)
    dataset = training_dataset(inputs["ingest"], scene, "train", 1.0, progress)
    assert len(loaded) == 12 and 1 <= max(alive) <= 4
    unmasked_count = dataset.is_unmasked(torch.arange(len(dataset.pixels))).view(12, HEIGHT, WIDTH)
    assert torch.equal(unmasked_count, torch.from_numpy(half_mask() > 0).expand(12, -1, -1))


def test_no_photo_is_opened_where_the_pixels_are_there(
    tmp_path: Path, progress: RecordedProgress, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs, scene = photographed(tmp_path)
    pixels = training_dataset(inputs["ingest"], scene, "train", 1.0, progress).pixels
    monkeypatch.setattr("PIL.Image.open", None)
    assert torch.equal(training_dataset(inputs["ingest"], scene, "train", 1.0, progress).pixels, pixels)


def test_without_masks_nothing_is_kept_of_them(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path)
    assert view_mask(inputs["ingest"], scene, scene.views[0], 1.0) is None
    assert training_dataset(inputs["ingest"], scene, "train", 1.0, progress).runs is None
    assert progress.notes == []


def test_masks_that_leave_nothing_at_a_size_are_said(tmp_path: Path, progress: RecordedProgress) -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4, 4] = 255
    inputs, scene = photographed(tmp_path, mask=mask)
    assert training_dataset(inputs["ingest"], scene, "train", 1.0, progress).unmasked_count == 6
    with refused("train.all-masked", "training photos", "--train.downscale"):
        training_dataset(inputs["ingest"], scene, "train", 2.0, progress)


@pytest.mark.parametrize("downscale", [1.0, 2.0, 3.3])
def test_the_bank_knows_where_training_photos_show_points(
    downscale: float, tmp_path: Path, progress: RecordedProgress
) -> None:
    inputs, scene = photographed(tmp_path)
    dataset = dataset_with_depths(inputs, scene, downscale, progress)
    assert dataset.sparse_pixels is not None and dataset.sparse_depths is not None
    seen = seen_points(scene)
    trained = np.array([view.split == "train" for view in scene.views])[seen["view"]]
    assert len(dataset.sparse_pixels) == trained.sum() > 30
    rays = dataset.lookup(dataset.sparse_pixels).rays
    hit = rays.origins + dataset.sparse_depths[:, None] * rays.directions
    # Rays run through the middles of pixels, points lie anywhere inside of them.
    half_a_pixel = 0.5 * 2**0.5 * downscale * 3.0 / FOCAL
    closest = torch.cdist(hit, torch.from_numpy(seen["xyz"])).min(-1).values
    assert (closest < half_a_pixel).all()
    assert float((hit.norm(dim=-1) - RADIUS).abs().mean()) < half_a_pixel / 2


def test_depth_maps_are_those_of_the_training_photos(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path)
    for number, view in enumerate(scene.views):
        if view.split == "train":
            path = depth_map_file(tmp_path, view.file)
            path.parent.mkdir(exist_ok=True)
            distance = np.full((2, 3), (view.near + view.far) / 2 + number / 1e3, np.float32)
            write_depth_map(path, DepthMap(distance, distance / 100, np.full((2, 3), 2, np.uint8)))
    dataset = dataset_with_depths(inputs, scene, 2.0, progress, tmp_path)
    pixel = dataset.first_pixel[:-1] + 1
    expected = [
        (view.near + view.far) / 2 + number / 1e3 for number, view in enumerate(scene.views) if view.split == "train"
    ]
    assert len(expected) > 1
    torch.testing.assert_close(dataset.depths(pixel, torch.arange(len(pixel))), torch.tensor(expected))
    assert dataset_with_depths(inputs, scene, 2.0, progress).depth_maps is None


def test_points_guide_once_two_training_photos_saw_them(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path)
    seen = seen_points(scene)
    trained = np.array([view.split == "train" for view in scene.views])[seen["view"]]
    of_one = seen["point"] == 6
    assert trained[of_one].sum() > 1 and (~trained[of_one]).any()
    rows = [*np.flatnonzero(of_one & ~trained), *np.flatnonzero(of_one & trained)[:2]]
    for count, known in {len(rows) - 1: 0, len(rows): 2}.items():
        some = {name: seen[name][rows[:count]] if name in ("view", "point", "xy") else seen[name] for name in seen}
        write_tensors(inputs["normalise"] / "points.safetensors", some)
        dataset = dataset_with_depths(inputs, scene, 1.0, progress)
        assert (0 if dataset.sparse_pixels is None else len(dataset.sparse_pixels)) == known


def test_points_on_the_rim_of_alpha_are_no_guide(tmp_path: Path, progress: RecordedProgress) -> None:
    inputs, scene = photographed(tmp_path, channels=4)
    dataset, opaque = (
        dataset_with_depths(inputs, each, 1.0, progress) for each in (scene, replace(scene, has_alpha=False))
    )
    assert dataset.sparse_pixels is not None and opaque.sparse_pixels is not None
    assert (dataset.pixels[dataset.sparse_pixels, 3] == 255).all()
    assert 0 < len(dataset.sparse_pixels) < len(opaque.sparse_pixels)


def test_points_on_masked_pixels_are_no_guide(tmp_path: Path, progress: RecordedProgress) -> None:
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, WIDTH // 2 :] = 0
    inputs, scene = photographed(tmp_path, mask=mask)
    known = dataset_with_depths(inputs, scene, 1.0, progress).sparse_pixels
    assert known is not None and (known % WIDTH < WIDTH // 2).all()
