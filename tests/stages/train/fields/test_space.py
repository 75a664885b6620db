from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.scene import Camera, Scene, Similarity, View
from nerf.geometry.space_maps import Box
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import Ndc
from nerf.training.hash_grid_trainer import HashGridTrainer
from nerf.training.ray_dataset import RayDataset, ray_dataset_from_images
from stages.effects.decisions import Decisions, Space
from stages.train.config import Config
from stages.train.data import camera_directions
from stages.train.fields.field_list import make_trainer, with_defaults
from stages.train.fields.hash_grid import with_sizes
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.space import MAX_NEAR_RATIO, MAX_WIDTH, chosen_space, near_ratio, space_map_of, width_in_photos
from tests.camera_layouts import ring, wall
from tests.refusals import refused

CAMERA = Camera("PINHOLE", 40, 30, (40.0, 40.0, 20.0, 15.0))
UNBOUNDED = Decisions({"background": {}})
SMALL: dict[str, dict[str, Any]] = {
    "grid": {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 512, "micro_batches": 1},
    "vanilla": {"depth": 2, "width": 8, "samples_coarse": 4, "samples_fine": 4, "batch_rays": 32},
}


def scene_of(poses: np.ndarray, capture_type: CaptureType = "forward-facing") -> Scene:
    views = tuple(
        View(f"{i}.jpg", f"{i}.jpg", 0, pose, 0.5, 20.0, "test" if i % 8 == 0 else "train")
        for i, pose in enumerate(poses)
    )
    return Scene((CAMERA,), views, Similarity(1.0, np.eye(3), np.zeros(3)), False, False, capture_type, True)


def fanned(spread_deg: float) -> np.ndarray:
    """Eleven cameras in one place, turned about the vertical by up to so much to either side of +y."""
    poses = np.repeat(wall()[:1], 11, axis=0)
    for angle, pose in zip(np.radians(np.linspace(-spread_deg, spread_deg, 11)), poses, strict=True):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose[:, :3] = turn @ pose[:, :3]
    return poses


def walked(length: float) -> np.ndarray:
    """Eleven cameras that look along +y, one behind the other."""
    poses = np.repeat(wall()[:1], 11, axis=0)
    poses[:, 1, 3] += np.linspace(0, length, 11)
    return poses


def test_cameras_that_face_one_way_get_ndc() -> None:
    scene = scene_of(wall())
    space, why = chosen_space(UNBOUNDED, scene)
    assert space == "ndc" and "1.0 times" in why
    pyramid = space_map_of(Config(space="ndc"), scene)
    assert isinstance(pyramid, Ndc)
    np.testing.assert_allclose(pyramid.slopes, (19.5 / 40, 14.5 / 40))
    assert width_in_photos(pyramid, scene) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("decisions", "scene", "space"),
    [
        (Decisions(), scene_of(wall()), "bounded"),
        (UNBOUNDED, scene_of(ring(), "object-centric"), "contracted"),
        (UNBOUNDED, scene_of(fanned(10.0)), "ndc"),
        (UNBOUNDED, scene_of(fanned(30.0)), "contracted"),
        (UNBOUNDED, scene_of(fanned(60.0)), "contracted"),
        (UNBOUNDED, scene_of(walked(0.5)), "ndc"),
        (UNBOUNDED, scene_of(walked(5.0)), "contracted"),
    ],
    ids=["no background", "all round", "a little aside", "too wide", "no pyramid", "a step forwards", "a long walk"],
)
def test_the_space_follows_background_and_cameras(decisions: Decisions, scene: Scene, space: str) -> None:
    chosen, why = chosen_space(decisions, scene)
    assert chosen == space and why.startswith("normalised" if space == "ndc" else space)


def test_the_width_decides_between_two_pyramids() -> None:
    widths = []
    for spread in (10.0, 30.0):
        scene = scene_of(fanned(spread))
        pyramid = space_map_of(Config(space="ndc"), scene)
        assert isinstance(pyramid, Ndc)
        widths.append(width_in_photos(pyramid, scene))
    assert 1 < widths[0] < MAX_WIDTH < widths[1]


@pytest.mark.parametrize(("spread_deg", "max_res"), [(0.0, 1024), (10.0, 2048)])
def test_finest_cells_are_a_pixel_wide(spread_deg: float, max_res: int) -> None:
    """A frustum wider than the photos, of 1,000 pixels, has more of them."""
    large = replace(
        scene_of(fanned(spread_deg)), cameras=(Camera("PINHOLE", 1000, 750, (1000.0, 1000.0, 500.0, 375.0)),)
    )
    config = Config(space="ndc", view_dependence=True, downscale=1.0, grid=HashGridOptions(target_samples=4096))
    assert with_sizes(config, large, 1e9).grid.max_res == max_res


def test_the_near_ratio_grows_with_the_walk() -> None:
    """At 0.5 before each photo: the last but one of eleven stands 0.9 of the walk behind the first."""
    for length in (0.5, 5.0):
        scene = scene_of(walked(length))
        pyramid = space_map_of(Config(space="ndc"), scene)
        assert isinstance(pyramid, Ndc)
        assert near_ratio(pyramid, scene) == pytest.approx(1 + 0.9 * length / 0.5)
        assert (near_ratio(pyramid, scene) > MAX_NEAR_RATIO) == (length == 5.0)


def test_an_option_forces_a_space() -> None:
    scene = scene_of(wall())
    assert space_map_of(Config(space="bounded"), scene) == Box()
    assert space_map_of(Config(space="contracted"), scene) == Contraction()
    with refused("train.no-pyramid"):
        space_map_of(Config(space="ndc"), scene_of(ring()))


def grey_dataset(scene: Scene) -> RayDataset:
    views = scene.of_split("train")
    grey = [torch.full((30, 40, 3), 128, dtype=torch.uint8)] * len(views)
    poses = torch.tensor(np.stack([view.scene_from_camera for view in views]), dtype=torch.float32)
    ends = torch.full((len(views),), 0.5), torch.full((len(views),), 20.0)
    return ray_dataset_from_images(grey, [0] * len(views), [camera_directions(CAMERA, 1.0)], poses, *ends)


@pytest.mark.parametrize(
    ("space", "device", "after", "long_until"),
    [
        ("ndc", "cpu", None, 1 / 3),
        ("ndc", "cuda", None, 0.0),
        ("ndc", "cpu", "finished", 0.0),
        ("contracted", "cpu", None, 1 / 3),
        ("bounded", "cpu", None, 0.0),
    ],
)
def test_steps_are_long_at_first_without_bounds_on_a_cpu(
    space: Space, device: str, after: str | None, long_until: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = with_defaults(
        Config(field="grid", space=space, view_dependence=True, after=after, grid=HashGridOptions(**SMALL["grid"]))
    )
    monkeypatch.setattr("stages.train.fields.hash_grid.compute_device", lambda: device)
    scene = scene_of(wall())
    trainer = make_trainer(config.filled({"grid": {"backend": "torch"}}), scene, grey_dataset(scene), 0)
    assert isinstance(trainer, HashGridTrainer) and trainer.settings.long_steps_until == long_until


@pytest.mark.parametrize("field", ["grid", "vanilla"])
def test_both_fields_train_in_ndc(field: str) -> None:
    scene = scene_of(wall())
    dataset = grey_dataset(scene)
    config = Config(field=field, space="ndc", view_dependence=True, **{field: SMALL[field]})  # pyright: ignore
    config = with_defaults(config)
    if field == "grid":
        config = config.filled({"grid": {"backend": "torch"}})
    trainer = make_trainer(config, scene, dataset, 0)
    errors = [trainer.step(step, step / 60, 1.0).psnr for step in range(60)]
    assert isinstance(trainer.model.settings.space, Ndc)  # pyright: ignore
    assert np.median(errors[-10:]) > errors[0] + 3


def test_a_moved_scene_has_a_moved_pyramid() -> None:
    """The map belongs to the cameras, wherever the frame has its origin."""
    scene = scene_of(wall())
    moved = [replace(view, scene_from_camera=view.scene_from_camera + np.eye(3, 4, 3)) for view in scene.views]
    here, there = (space_map_of(Config(space="ndc"), each) for each in (scene, replace(scene, views=tuple(moved))))
    assert isinstance(here, Ndc) and isinstance(there, Ndc)
    np.testing.assert_allclose(np.subtract(there.apex, here.apex), [1.0, 0.0, 0.0], atol=1e-9)
    assert there.near == pytest.approx(here.near)
