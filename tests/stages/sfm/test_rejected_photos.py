"""Photos, and cameras given for them, of which stage sfm can make nothing are refused with the reason."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages import sfm
from stages.contract import StageError, run_stage
from tests.blots import blots
from tests.refusals import refused
from tests.stages.sfm.sfm_inputs import SMALL, ingested


def turned(angle: float, panorama: np.ndarray, size: tuple[int, int] = (240, 180), focal: float = 250.0) -> np.ndarray:
    """What a camera sees of a far picture after turning about its vertical axis."""
    cos, sin = np.cos(angle), np.sin(angle)
    lens = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    far = np.array([[focal, 0, panorama.shape[1] / 2], [0, focal, panorama.shape[0] / 2], [0, 0, 1]])
    homography = far @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ np.linalg.inv(lens)
    return cv2.warpPerspective(panorama, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def refusal(images: dict[str, np.ndarray], folder: Path, progress) -> StageError:
    inputs = ingested(folder / "ingest", images)
    with pytest.raises(StageError) as error:
        run_stage(sfm.STAGE, SMALL, inputs, folder / "sfm", progress)
    assert not (folder / "sfm" / "sparse").exists()
    assert not (folder / "sfm" / "registration.json").exists()
    return error.value


def test_photos_without_overlap_are_refused(tmp_path: Path, progress) -> None:
    error = refusal({f"{i}.png": blots(i, 240, 180) for i in range(4)}, tmp_path, progress)
    assert error.code == "sfm.no-overlap" and "4 photos" in error.what and "6 pairs" in error.why


def test_turning_on_the_spot_is_refused(tmp_path: Path, progress) -> None:
    panorama = blots(0)
    error = refusal({f"{i}.png": turned(0.12 * i - 0.3, panorama) for i in range(6)}, tmp_path, progress)
    assert error.code == "sfm.pure-rotation" and "15 of 15" in error.why


def test_identical_photos_are_refused(tmp_path: Path, progress) -> None:
    error = refusal({f"{i}.png": blots(0, 240, 180) for i in range(3)}, tmp_path, progress)
    assert error.code == "sfm.same-view" and "3 of 3 pairs" in error.why


def test_blank_photos_are_refused(tmp_path: Path, progress) -> None:
    error = refusal({f"{i}.png": np.full((180, 240, 3), 90, np.uint8) for i in range(3)}, tmp_path, progress)
    assert error.code == "sfm.few-features" and "50 features" in error.why


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_photos_are_refused_at_once(count: int, tmp_path: Path, progress) -> None:
    error = refusal({f"{i}.png": blots(i, 240, 180) for i in range(count)}, tmp_path, progress)
    assert error.code == "sfm.few-photos" and f"{count} photo" in error.what


@pytest.mark.parametrize(
    ("given", "sizes", "code", "named"),
    [
        (
            {"camera_params": (250.0, 120.0, 90.0)},
            [(240, 180)],
            "parameters-without-model",
            "--sfm.camera-model",
        ),
        (
            {"camera_model": "RADIAL", "camera_params": (250.0, 120.0, 90.0)},
            [(240, 180)],
            "parameter-count",
            "3 numbers",
        ),
        (
            {"camera_model": "SIMPLE_PINHOLE", "camera_params": (-250.0, 120.0, 90.0)},
            [(240, 180)],
            "focal-not-positive",
            "--sfm.camera-params",
        ),
        (
            {"camera_model": "SIMPLE_PINHOLE", "camera_params": (250.0, 120.0, 90.0)},
            [(240, 180), (180, 240), (240, 136)],
            "parameters-of-other-photos",
            "1 of 3 photos do not have the shape of the photos that the parameters are for: 2.png (240×136)",
        ),
        (
            {"camera_model": "SIMPLE_PINHOLE", "camera_params": (250.0, 80.0, 60.0)},
            [(240, 180), (180, 240)],
            "parameters-of-no-photo",
            "the middle of none of the photos' sizes (240×180, 180×240)",
        ),
    ],
)
def test_intrinsics_that_cannot_be_those_of_the_photos_are_refused(
    given: dict[str, object], sizes: list[tuple[int, int]], code: str, named: str, tmp_path: Path, progress
) -> None:
    images = {f"{i}.png": blots(i, *sizes[i % len(sizes)]) for i in range(3)}
    config, inputs = SMALL.model_copy(update=given), ingested(tmp_path / "ingest", images)
    with refused(f"sfm.{code}", named):
        run_stage(sfm.STAGE, config, inputs, tmp_path / "sfm", progress)
