from pathlib import Path

import pycolmap
import pytest

from stages.io.photos import Photo
from stages.sfm.colmap.database import calibration
from stages.sfm.colmap.database.calibration import Told, calibrate_focal_lengths
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.thinning import thin_matches
from tests.stages.sfm.colmap.made_models import FOCAL_PX, enter_focal_length, focal_length, look_apart, make


def test_told_focal_lengths_do_not_depend_on_timing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    for name, rounding in (("one", 0.0), ("other", 3e-13)):
        database = tmp_path / f"{name}.db"
        fill_database(database, [Photo("a.png", "images/a.png", 1024, 768, 0, None, None, False, 1.0)], MAPPING_MODEL)
        monkeypatch.setattr(
            calibration, "_calibrated", lambda _, start, by=rounding: {1: 1234.56789 * (1 + start * by)}
        )
        assert calibrate_focal_lengths(database) == (frozenset({1}), True)
        with pycolmap.Database.open(database) as db:
            told.append(db.read_camera(1).mean_focal_length())
    assert told == [1234.57, 1234.57]


@pytest.mark.parametrize("ratio", [0.5, 0.9, 1.2, 2.0])
@pytest.mark.parametrize("by_exif", [True, False])
def test_focal_lengths_are_calibrated_where_exif_is_far_off(tmp_path: Path, ratio: float, by_exif: bool) -> None:
    made = make(tmp_path)
    look_apart(made)
    enter_focal_length(made.database, ratio * FOCAL_PX, by_exif=by_exif)
    assert thin_matches(made.database, tmp_path / "thinned.db").all and not list(tmp_path.glob("*calibration*"))
    found = focal_length(tmp_path / "thinned.db") / FOCAL_PX
    assert found == ratio if by_exif and 0.8 < ratio < 1.3 else abs(found - 1) < 0.1


@pytest.mark.parametrize("by_exif", [True, False])
def test_photos_whose_axes_meet_calibrate_nothing(tmp_path: Path, by_exif: bool) -> None:
    made = make(tmp_path)
    enter_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=by_exif)
    assert thin_matches(made.database, tmp_path / "thinned.db") == Told()
    assert focal_length(tmp_path / "thinned.db") == 0.5 * FOCAL_PX


def test_known_cameras_and_fisheyes_are_not_calibrated(tmp_path: Path) -> None:
    made = make(tmp_path)
    look_apart(made)
    enter_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=True)
    assert thin_matches(made.database, tmp_path / "known.db", camera_is_known=True) == Told()
    enter_focal_length(made.database, 0.5 * FOCAL_PX, by_exif=True, model="OPENCV_FISHEYE")
    assert thin_matches(made.database, tmp_path / "fisheye.db") == Told()
    assert focal_length(tmp_path / "known.db") == focal_length(tmp_path / "fisheye.db") == 0.5 * FOCAL_PX
