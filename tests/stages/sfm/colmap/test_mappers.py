from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from stages.sfm.colmap.adjustment.bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.database.images import adopt_cameras
from stages.sfm.colmap.mappers import incremental_options, map_incrementally
from stages.sfm.colmap.model_check import (
    check_model,
)
from stages.sfm.retry_strategies import MappingOptions
from tests.stages.sfm.colmap.made_models import FOCAL_PX, PHOTOS, enter_focal_length, make


def test_colours_in_the_end_are_those_of_mapping(tmp_path: Path) -> None:
    made, random = make(tmp_path), np.random.default_rng(0)
    camera = made.model.camera(1)
    for image in made.model.images.values():
        spots = Image.fromarray(random.integers(1, 255, (9, 12, 3), dtype=np.uint8))
        spots.resize((camera.width, camera.height)).save(tmp_path / image.name)

    def mapped(coloured: bool) -> pycolmap.Reconstruction:
        options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=False)
        options.extract_colors |= coloured
        return map_incrementally(made.database, tmp_path, tmp_path / "models", options)[0]

    def points(model: pycolmap.Reconstruction) -> bytes:
        model.write_binary(tmp_path)
        return (tmp_path / "points3D.bin").read_bytes()

    plain, coloured = mapped(False), mapped(True)
    assert not any(point.color.any() for point in plain.points3D.values())
    assert all(point.color.any() for point in coloured.points3D.values())
    for model in (plain, coloured):
        model.extract_colors_for_all_images(tmp_path)
    assert all(point.color.any() for point in plain.points3D.values())
    assert points(plain) == points(coloured)


def test_focal_lengths_are_held_while_mapping_and_then_released(tmp_path: Path) -> None:
    made = make(tmp_path, points=1000)
    enter_focal_length(made.database, 1.1 * FOCAL_PX, by_exif=True)
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True, hold_focal=True)
    (model,) = map_incrementally(made.database, tmp_path, tmp_path / "models", options)
    assert model.camera(1).mean_focal_length() == 1.1 * FOCAL_PX and model.num_reg_images() == PHOTOS
    release_focal_lengths(model)
    assert abs(model.camera(1).mean_focal_length() / FOCAL_PX - 1) < 0.01
    assert check_model(model, made.database, 0).check.passed.all()


def test_only_adopted_cameras_are_held(tmp_path: Path) -> None:
    made = make(tmp_path, cameras=PHOTOS)
    with pycolmap.Database.open(made.database) as db, pycolmap.DatabaseTransaction(db):
        for camera in db.read_all_cameras():
            camera.focal_length = 1.1 * FOCAL_PX
            db.update_camera(camera)
    held = {made.model.image(image_id).camera_id for image_id in range(1, 12)}
    adopt_cameras(made.database, made.model, held)
    assert len(held) == 11
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=True, held_cameras=held)
    (model,) = map_incrementally(made.database, tmp_path, tmp_path / "models", options)
    assert model.num_reg_images() == PHOTOS
    focal = {i: model.camera(i).mean_focal_length() for i in model.cameras}
    assert {focal[i] for i in held} == {FOCAL_PX}
    assert all(0 < abs(focal[i] / FOCAL_PX - 1) < 0.02 for i in focal.keys() - held), "found, though wrong at first"
