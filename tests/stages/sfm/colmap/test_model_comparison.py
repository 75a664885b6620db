from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from nerf.geometry.scene import Camera
from nerf.synthetic.scenes import ring_of_cameras
from stages.io.sparse_model import SparseImage, SparseModel
from stages.sfm.colmap.model_comparison import compare_models, differ_by_drift, find_conflict
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


ROW, JOINT = 60, 30


def row(degrees: np.ndarray, steps: np.ndarray) -> dict[int, np.ndarray]:
    """Poses along a path: before each step of such a length the camera turns by so many degrees about the up axis."""
    heading = np.radians(np.cumsum(degrees))
    along = np.stack([np.cos(heading), np.zeros(ROW), np.sin(heading)], axis=1)
    centres = np.cumsum(along * steps[:, None], axis=0)
    cosine, sine, none = np.cos(heading), np.sin(heading), np.zeros(ROW)
    turned = np.stack([cosine, none, -sine, none, none + 1, none, sine, none, cosine], axis=1).reshape(-1, 3, 3)
    return dict(enumerate(np.concatenate([turned, centres[:, :, None]], axis=2)))


STRAIGHT, EVEN = np.zeros(ROW), np.ones(ROW)
AT_JOINT = (np.arange(ROW) == JOINT).astype(float)


@pytest.mark.parametrize(
    ("other", "without", "drift"),
    [
        (row(STRAIGHT + 0.4, EVEN), [], True),  # bent by 24 degrees in all
        (row(STRAIGHT, np.geomspace(1, 3, ROW)), [], True),  # stretched
        (row(20 * AT_JOINT, EVEN), [], False),  # one half is turned
        (row(STRAIGHT, np.where(np.arange(ROW) > JOINT, 3.0, 1)), [], False),  # one half is larger
        (row(STRAIGHT + 0.4, EVEN), [JOINT], False),  # the matches of one step contradict one of the models
    ],
)
def test_drift_is_what_small_steps_add_up_to(
    other: dict[int, np.ndarray], without: list[int], drift: bool, tmp_path: Path
) -> None:
    models = []
    for name, poses in (("first", row(STRAIGHT, EVEN)), ("second", other)):
        images = [SparseImage(f"{number:02d}.png", 0, pose) for number, pose in poses.items()]
        write_model(tmp_path / name, SparseModel.without_points([CAMERA], images))
        models.append(load_native(tmp_path / name))
    first, second = models
    ids = {first.image(image_id).name: image_id for image_id in first.reg_image_ids()}
    # Each photo has pairs with the next two; ``without``: no pair crosses the step to this one.
    pairs = {
        (ids[f"{i:02d}.png"], ids[f"{j:02d}.png"])
        for i in range(ROW)
        for j in range(i + 1, min(i + 3, ROW))
        if not any(i < at <= j for at in without)
    }
    assert len(compare_models(first, second)["different"]) > 3
    assert differ_by_drift(first, second, pairs) == drift
    assert not differ_by_drift(first, second, set())
