"""Masks that cut out an object tell its background; masks that hide something do not."""

from collections.abc import Callable, Container
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from nerf.geometry.region_of_interest import CaptureType
from nerf.geometry.scene import Camera, Split
from stages.io.files import write_png
from stages.io.photos import Photo
from stages.normalise.alpha import Alpha, MaskMeaning, find_alpha
from stages.normalise.outlines import hides_narrow_parts, read_outline
from tests.camera_layouts import ball, ring, seen_by
from tests.conftest import RecordedProgress

SIDE, PHOTOS = 400, 17
TESTS = (0, 8, 16)  # the photos that are held out
CAMERA = Camera("PINHOLE", SIDE, SIDE, (400.0, 400.0, 200.0, 200.0))
Paint = Callable[[int, np.ndarray], None]

PASSER_BY = [np.uint8(255) * (np.arange(SIDE) // 40 != place) for place in range(10)]
LENS = np.uint8(255) * (np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE / 2)) < SIDE / 2 - 5)


@pytest.fixture
def outlined(tmp_path: Path, progress: RecordedProgress):
    """What is found where each of a ring of photos shows a dark ball of points on plain ground and has a mask around
    it, which ``paint`` changes."""

    def find(
        paint: Paint = lambda number, mask: None,
        unmasked: Container[int] = (),
        meaning: MaskMeaning | None = None,
        capture_type: CaptureType = "object-centric",
        has_alpha: int = 0,
    ) -> Any:
        poses = ring(PHOTOS)
        scene = seen_by(poses, ball())
        photos = []
        for folder in ("masks", "images"):
            (tmp_path / folder).mkdir(exist_ok=True)
        for number, pose in enumerate(poses):
            mask = np.zeros((SIDE, SIDE), np.uint8)
            local = (scene.points - pose[:, 3]) @ pose[:, :3]
            for x, y in 400 * local[:, :2] / local[:, 2:] + 200:
                cv2.circle(mask, (int(x), int(y)), 12, 255, -1)
            alpha = number < has_alpha
            photo = Photo(f"{number:02d}.jpg", f"images/{number:02d}.png", SIDE, SIDE, 0, None, None, alpha, 1.0)
            write_png(
                tmp_path / photo.file, np.repeat(np.where(mask > 0, np.uint8(60), np.uint8(200))[..., None], 3, 2)
            )
            paint(number, mask)
            file = f"masks/{number:02d}.png"
            write_png(tmp_path / file, mask)
            photos.append(replace(photo, mask=None if number in unmasked else file))
        images = [SimpleNamespace(camera=0, sfm_from_camera=pose) for pose in poses]
        model: Any = SimpleNamespace(
            cameras=[CAMERA], images=images, xyz=scene.points, view=scene.view, point=scene.point
        )
        split: list[Split] = ["test" if number in TESTS else "train" for number in range(PHOTOS)]
        return find_alpha(tmp_path, photos, model, range(PHOTOS), split, capture_type, meaning, progress)

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
    assert all(found.masks) and [number for number, box in enumerate(found.opaque) if box is None] == [5]
    assert progress.codes == []


def test_among_many_white_masks_few_cut_out_nothing(outlined, progress: RecordedProgress) -> None:
    assert outlined(lambda number, mask: whiten(number, mask) if number % 3 else None) is None
    assert outlined(lambda number, mask: whiten(number, mask) if number % 3 == 0 else None) is not None
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
    assert outlined(unmasked=[1]) is None
    assert outlined(capture_type="forward-facing") is None
    assert outlined(has_alpha=3) is None
    assert [code for code in progress.codes if "masks" in code] == ["normalise.masks-ignore"] * 3
    assert progress.names("normalise.masks-ignore", "1 of 14")


def test_what_masks_mean_can_be_said(outlined, progress: RecordedProgress) -> None:
    assert outlined(meaning="ignore") is None
    found: Alpha = outlined(hide_middle, unmasked=range(2), meaning="cut-out", capture_type="inside-out")
    assert [mask is None for mask in found.masks] == [number < 2 for number in range(PHOTOS)]
    assert progress.codes == []
    assert outlined(unmasked=range(PHOTOS), meaning="cut-out") is None
    assert progress.codes == ["normalise.masks-not-used"]


def box(number: int, mask: np.ndarray) -> None:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    mask[rows[0] - 20 : rows[-1] + 20, columns[0] - 20 : columns[-1] + 20] = 255


def circle(number: int, mask: np.ndarray) -> None:
    cv2.circle(mask, (SIDE // 2, SIDE // 2), 140 + number, 255, -1)


@pytest.mark.parametrize("paint", [box, circle])
def test_loose_masks_on_plain_ground_only_ignore(outlined, progress: RecordedProgress, paint: Paint) -> None:
    assert outlined(paint) is None
    assert progress.codes == ["normalise.masks-ignore"]
    assert all(outlined(paint, meaning="cut-out").masks)


def rod(number: int, mask: np.ndarray) -> None:
    mask[:, 199:206] = 0  # one cell wide


def stick(number: int, mask: np.ndarray) -> None:
    mask[209:213, :260] = 0


@pytest.mark.parametrize("paint", [rod, stick])
def test_thin_things_before_an_object_are_not_cut_out(outlined, paint: Paint) -> None:
    found: Alpha = outlined(lambda number, mask: paint(number, mask) if number == 5 else None)
    assert [number for number, mask in enumerate(found.masks) if mask is None] == [5]


def test_cells_are_ignored_whole_whatever_the_size(tmp_path: Path) -> None:
    for side in (400, 512, 600, 750):
        write_png(
            tmp_path / "mask.png", np.uint8(255) * (np.arange(side * side).reshape(side, side) < side * side // 2)
        )
        model: Any = SimpleNamespace(cameras=[CAMERA])
        image: Any = SimpleNamespace(camera=0, sfm_from_camera=np.eye(3, 4))
        cells = read_outline(tmp_path / "mask.png", np.zeros((0, 3)), model, image).ignored
        assert (cells[64:] == 1).all() and (cells[:64] < 1).all()


def test_gaps_in_an_object_hide_nothing() -> None:
    ignored = np.ones((100, 100), bool)
    ignored[25:75, 25:46] = ignored[25:75, 53:75] = False
    y, x = np.mgrid[25.5:75:2, 25.5:75].reshape(2, -1) / 100
    places = np.stack([x, y], axis=1)
    assert hides_narrow_parts(ignored, places)
    assert not hides_narrow_parts(ignored, places[(x < 0.46) | (x > 0.52)])  # an outline may be wrong by a cell
    assert not hides_narrow_parts(ignored, places[(x < 0.46) | (x > 0.53) | (y < 0.28)])


def test_masks_of_test_photos_decide_nothing(outlined) -> None:
    found: Alpha = outlined(unmasked=TESTS)
    assert [number for number, mask in enumerate(found.masks) if mask is None] == [*TESTS]
    # In half of the training photos, which are fewer than half of all photos.
    assert outlined(lambda number, mask: hide_middle(number, mask) if 1 <= number <= 7 else None) is None
