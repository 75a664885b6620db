"""Masks that cut out an object tell its background; masks that hide something do not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.scene import Camera
from stages.io.files import write_png
from stages.io.photos import Photo
from stages.normalise.alpha import Alpha, MaskMeaning, find_alpha
from tests.camera_layouts import ball, ring, seen_by
from tests.conftest import RecordedProgress

SIDE, PHOTOS = 400, 17
CAMERA = Camera("PINHOLE", SIDE, SIDE, (400.0, 400.0, 200.0, 200.0))
Paint = Callable[[int, np.ndarray], None]

PASSER_BY = [np.uint8(255) * (np.arange(SIDE) // 40 != place) for place in range(10)]
LENS = np.uint8(255) * (np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE / 2)) < SIDE / 2 - 5)


@pytest.fixture
def outlined(tmp_path: Path, progress: RecordedProgress):
    """What is found where each of a ring of photos has a mask around a ball of points, which ``paint`` changes."""

    def find(
        paint: Paint = lambda number, mask: None,
        unmasked: int = 0,
        meaning: MaskMeaning | None = None,
        capture_type: CaptureType = "object-centric",
        has_alpha: int = 0,
    ) -> Any:
        poses = ring(PHOTOS)
        scene = seen_by(poses, ball())
        photos = []
        for number, pose in enumerate(poses):
            mask = np.zeros((SIDE, SIDE), np.uint8)
            local = (scene.points - pose[:, 3]) @ pose[:, :3]
            for x, y in 400 * local[:, :2] / local[:, 2:] + 200:
                cv2.circle(mask, (int(x), int(y)), 12, 255, -1)
            paint(number, mask)
            file = f"masks/{number:02d}.png"
            (tmp_path / "masks").mkdir(exist_ok=True)
            write_png(tmp_path / file, mask)
            alpha = number < has_alpha
            photo = Photo(f"{number:02d}.jpg", f"images/{number:02d}.jpg", SIDE, SIDE, 0, None, None, alpha, 1.0)
            white = bool(mask.all())  # which ingest does not keep
            photos.append(
                photo if number < unmasked else replace(photo, mask=None if white else file, white_mask=white)
            )
        images = [SimpleNamespace(camera=0, sfm_from_camera=pose) for pose in poses]
        model: Any = SimpleNamespace(
            cameras=[CAMERA], images=images, xyz=scene.points, view=scene.view, point=scene.point
        )
        return find_alpha(tmp_path, photos, model, range(PHOTOS), capture_type, meaning, progress)

    return find


def hide_middle(number: int, mask: np.ndarray) -> None:
    mask[:, 180:220] = 0


def test_masks_around_an_object_are_its_alpha(outlined) -> None:
    found: Alpha = outlined()
    assert found.masks == [f"masks/{number:02d}.png" for number in range(PHOTOS)]
    assert all(box and 0.2 < box[0] < 0.3 < 0.7 < box[2] < 0.8 for box in found.opaque)


def test_a_mask_that_hides_part_of_it_stays_one(outlined) -> None:
    found: Alpha = outlined(lambda number, mask: hide_middle(number, mask) if number == 5 else None)
    assert [number for number, mask in enumerate(found.masks) if mask is None] == [5]
    assert found.opaque[5] is None


def whiten(number: int, mask: np.ndarray) -> None:
    mask.fill(255)


def test_a_photo_with_a_white_mask_is_opaque(outlined, progress: RecordedProgress) -> None:
    found: Alpha = outlined(lambda number, mask: whiten(number, mask) if number == 5 else None)
    assert [number for number, mask in enumerate(found.masks) if mask is None] == [5]
    assert found.opaque[5] is None
    assert progress.codes == []


def test_among_many_white_masks_few_cut_out_nothing(outlined, progress: RecordedProgress) -> None:
    assert outlined(lambda number, mask: whiten(number, mask) if number % 2 else None) is not None
    assert outlined(lambda number, mask: whiten(number, mask) if number % 2 == 0 else None) is None
    assert progress.codes == []


def speck(number: int, mask: np.ndarray) -> None:
    mask.fill(255)
    mask[20 * number, 100:103] = 0


def lens(number: int, mask: np.ndarray) -> None:
    np.copyto(mask, LENS)
    mask[0, : 4 * number] = 255


@pytest.mark.parametrize(
    ("paint", "codes"),
    [
        (hide_middle, ["normalise.masks-ignore"]),
        (lambda number, mask: np.copyto(mask, PASSER_BY[number % 10]), []),
        (lens, []),
        (lambda number, mask: mask[:, 100:].fill(255), []),  # nothing but a sky on one side is ignored
        (speck, []),
        (lambda number, mask: mask.fill(0), []),
    ],
    ids=["hides", "passer-by", "lens", "side", "speck", "all"],
)
def test_other_masks_only_ignore(outlined, progress: RecordedProgress, paint: Paint, codes: list[str]) -> None:
    assert outlined(paint) is None
    assert progress.codes == codes


def test_what_speaks_against_a_cut_out_is_said(outlined, progress: RecordedProgress) -> None:
    assert outlined(unmasked=1) is None
    assert outlined(capture_type="forward-facing") is None
    assert outlined(has_alpha=2) is None
    assert [code for code in progress.codes if "masks" in code] == ["normalise.masks-ignore"] * 3
    assert "1 of 17 photos has no mask" in progress.notes[0]


def test_what_masks_mean_can_be_said(outlined, progress: RecordedProgress) -> None:
    assert outlined(meaning="ignore") is None
    found: Alpha = outlined(hide_middle, unmasked=2, meaning="cut-out", capture_type="inside-out")
    assert [mask is None for mask in found.masks] == [number < 2 for number in range(PHOTOS)]
    assert progress.codes == []
    assert outlined(unmasked=PHOTOS, meaning="cut-out") is None
    assert progress.codes == ["normalise.masks-not-used"]
