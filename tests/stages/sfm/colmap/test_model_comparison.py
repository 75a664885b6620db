from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import ring_of_cameras
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.model_comparison import compare_models, find_conflict
from stages.sfm.colmap.models import load_native, write_model
from tests.stages.sfm.colmap.made_models import PHOTOS, Made, turn

CAMERA = Camera("SIMPLE_PINHOLE", 60, 40, (50.0, 31.0, 19.0))
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("photos", "moved", "conflict"),
    [
        (range(6, 16), range(10, 12), {"group": 1, "shared": 6, "different": 2}),
        (range(6, 12), range(10, 12), None),  # it has no photo that the best model lacks
        (range(6, 16), range(9, 10), None),  # one photo may merely have a bad pose
        (range(6, 16), range(0), None),
        (range(12, 16), range(12, 16), None),  # nothing is shared
    ],
)
def test_a_model_with_different_poses_of_shared_photos_is_found(
    photos: range, moved: range, conflict: dict[str, Any] | None, tmp_path: Path
) -> None:
    poses = dict(enumerate(ring_of_cameras(16)))
    best = {number: poses[number] for number in range(12)}
    other = {number: QUARTER_TURN @ poses[number] if number in moved else poses[number] for number in photos}
    models = []
    for name, group in (("best", best), ("other", other)):
        images = [SparseImage(f"{number:02d}.png", 0, pose) for number, pose in group.items()]
        write_model(tmp_path / name, SparseModel.without_points([CAMERA], images))
        models.append(load_native(tmp_path / name))
    found = find_conflict(models)
    if conflict:
        names = {"photos": [f"{i:02d}.png" for i in moved], "others": [f"{i:02d}.png" for i in photos if i >= 12]}
        conflict = conflict | names
    assert found == conflict
    assert find_conflict(models[:1]) is None


def test_models_that_disagree_name_images_with_different_poses(made: Made) -> None:
    other = pycolmap.Reconstruction(made.model)
    for image_id in (3, 9):
        turn(other, image_id, degrees=40.0)
    names = [made.model.image(i).name for i in (3, 9)]
    compared = compare_models(made.model, other)
    assert (compared["photos"], compared["agree"]) == (PHOTOS, PHOTOS - 2)
    assert sorted(compared["different"]) == sorted(names)
