from pathlib import Path

import pycolmap
import pytest

from stages.io.photos import Photo
from stages.sfm.colmap.database import calibration
from stages.sfm.colmap.database.calibration import calibrate_focal_lengths
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database


def test_told_focal_lengths_do_not_depend_on_timing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    for name, rounding in (("one", 0.0), ("other", 3e-13)):
        database = tmp_path / f"{name}.db"
        fill_database(database, [Photo("a.png", "images/a.png", 1024, 768, 0, None, None, False, 1.0)], MAPPING_MODEL)
        monkeypatch.setattr(
            calibration, "_calibrated", lambda _, start, by=rounding: {1: 1234.56789 * (1 + start * by)}
        )
        assert calibrate_focal_lengths(database)
        with pycolmap.Database.open(database) as db:
            told.append(db.read_camera(1).mean_focal_length())
    assert told == [1234.57, 1234.57]
