"""What EXIF says of a photo: which way is up, its focal length, its camera, how and where it was taken."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image, TiffImagePlugin

from stages.ingest.decoding import decode, upright_size
from stages.ingest.exif import GpsPosition, clock_from_exif, exposure_from_exif, focal_from_exif, gps_from_exif
from tests.stages.ingest.photo_files import HEIGHT, WIDTH, exif_with, saved, smooth


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("suffix", "options"), [("png", {}), ("tif", {}), ("tif", {"compression": "tiff_lzw"})])
def test_every_exif_orientation_is_baked(
    tmp_path: Path, suffix: str, options: dict[str, Any], orientation: int
) -> None:
    """The stored rows and columns go where EXIF 2.32 says; the law is written out per orientation."""
    upright = smooth()
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: upright.transpose(1, 0, 2)[::-1],
        7: upright.transpose(1, 0, 2)[::-1, ::-1],
        8: upright.transpose(1, 0, 2)[:, ::-1],
    }[orientation]
    exif, path = exif_with(orientation, Make="Maker"), tmp_path / f"a.{suffix}"
    decoded = decode(saved(path, Image.fromarray(np.ascontiguousarray(stored)), exif=exif, **options))
    assert np.array_equal(decoded.pixels, upright)
    assert decoded.suffix == (".png" if (suffix, orientation) == ("png", 1) else None)
    assert decoded.camera_key[:6] == ("Maker", "", "", WIDTH, HEIGHT, orientation)
    assert upright_size(path) == ((WIDTH, HEIGHT), orientation)


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_invalid_orientation_means_upright(tmp_path: Path, orientation: int) -> None:
    path = saved(tmp_path / "a.png", Image.fromarray(smooth()), exif=exif_with(orientation))
    assert np.array_equal(decode(path).pixels, smooth())


def test_focal_from_the_35_mm_equivalent_is_by_the_diagonal() -> None:
    """A full-frame camera is its own equivalent: f mm on a 36 mm wide sensor."""
    focal, source = focal_from_exif({"FocalLengthIn35mmFilm": 50}, 3600, 2400)
    assert source == "FocalLengthIn35mmFilm"
    assert focal == pytest.approx(5000, rel=1e-4)


@pytest.mark.parametrize(("unit", "per_mm"), [(2, 25.4), (3, 10), (4, 1), (5, 1e-3)])
def test_focal_from_the_focal_plane_follows_a_resize(unit: int, per_mm: float) -> None:
    tags = {"FocalLength": 20.0, "FocalPlaneXResolution": 100 * per_mm, "FocalPlaneResolutionUnit": unit}
    recorded = {"ExifImageWidth": 4000, "ExifImageHeight": 3000}
    assert focal_from_exif(tags, 4000, 3000)[0] == pytest.approx(2000)
    assert focal_from_exif(tags | recorded, 1000, 750) == (pytest.approx(500), "FocalPlaneXResolution")
    assert focal_from_exif(tags | recorded, 750, 1000)[0] == pytest.approx(500)


@pytest.mark.parametrize(("told", "zoom"), [(2.0, 2), (1.0, 1), (0, 1), (None, 1), (float("nan"), 1), ("far", 1)])
def test_digital_zoom_lengthens_focal_lengths_without_it(told: object, zoom: float) -> None:
    tags = {"FocalLength": 20.0, "FocalPlaneXResolution": 2540.0, "DigitalZoomRatio": told}
    assert focal_from_exif(tags, 4000, 3000)[0] == pytest.approx(2000 * zoom)
    equivalent = {"FocalLengthIn35mmFilm": 50}  # of the picture as it is
    assert focal_from_exif(tags | equivalent, 4000, 3000) == focal_from_exif(equivalent, 4000, 3000)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"FocalLength": 20.0},
        {"FocalLengthIn35mmFilm": 0},
        {"FocalLengthIn35mmFilm": 65535},
        {"FocalLengthIn35mmFilm": "wide"},
        {"FocalLengthIn35mmFilm": float("nan")},
        {"FocalLength": 20.0, "FocalPlaneXResolution": 100.0, "FocalPlaneResolutionUnit": 1},
        {"FocalLengthIn35mmFilm": 50, "ExifImageWidth": 4000, "ExifImageHeight": 2000},  # cropped since
    ],
)
def test_no_or_absurd_exif_tells_no_focal(tags: dict[str, object]) -> None:
    assert focal_from_exif(tags, 4000, 3000) == (None, None)


def test_exif_reaches_the_camera_key(tmp_path: Path) -> None:
    tags: dict[str, Any] = {"Make": "Maker", "Model": "M1", "FocalLength": 8.0, "FocalLengthIn35mmFilm": 28}
    wide = decode(saved(tmp_path / "a.jpg", Image.fromarray(smooth()), exif=exif_with(**tags)))
    tags["FocalLength"] = 9.0
    zoomed = decode(saved(tmp_path / "b.jpg", Image.fromarray(smooth()), exif=exif_with(**tags)))
    assert wide.camera_key[:6] == ("Maker", "M1", "", WIDTH, HEIGHT, 1)
    assert wide.camera_key.focal_px == pytest.approx(28 / 43.27 * np.hypot(WIDTH, HEIGHT))
    assert wide.camera_key != zoomed.camera_key


def test_digital_zoom_makes_another_camera(tmp_path: Path) -> None:
    keys = []
    for index, told in enumerate((1.0, 0.0, 2.0)):
        exif = exif_with(Make="Maker", FocalLength=8.0, DigitalZoomRatio=told)
        keys.append(decode(saved(tmp_path / f"{index}.jpg", Image.fromarray(smooth()), exif=exif)).camera_key)
    assert keys[0] == keys[1] and keys[2].sensor() == keys[0].sensor()._replace(digital_zoom=2.0)


def test_how_a_photo_was_exposed(tmp_path: Path) -> None:
    tags = {"ExposureTime": 0.01, "ISOSpeedRatings": 200, "FNumber": 2.8}
    told = decode(saved(tmp_path / "a.jpg", Image.fromarray(smooth()), exif=exif_with(**tags))).exposure_ev
    assert told == pytest.approx(math.log2(0.01 * 200 / 2.8**2), abs=1e-3)
    one = exposure_from_exif(tags)
    assert one is not None
    assert exposure_from_exif(tags | {"ExposureTime": 0.02}) == pytest.approx(one + 1)
    assert exposure_from_exif(tags | {"ISOSpeedRatings": (100, 0)}) == pytest.approx(one - 1)
    assert exposure_from_exif(tags | {"FNumber": 5.6}) == pytest.approx(one - 2)


@pytest.mark.parametrize("tag", ["ExposureTime", "ISOSpeedRatings", "FNumber"])
@pytest.mark.parametrize("value", [None, 0, -1, float("nan"), "fast", ()])
def test_an_exposure_that_is_not_told_is_none(tag: str, value: object) -> None:
    assert exposure_from_exif({"ExposureTime": 0.01, "ISOSpeedRatings": 200, "FNumber": 2.8, tag: value}) is None


GREENWICH = {"GPSLatitude": (51, 28, 38.0), "GPSLatitudeRef": "N", "GPSLongitude": (0, 0, 1.8), "GPSLongitudeRef": "W"}


@pytest.mark.parametrize("suffix", ["jpg", "png", "heic"])
def test_where_a_photo_was_taken(tmp_path: Path, suffix: str) -> None:
    exif = exif_with(Make="Maker")
    numbers = {1: "S", 2: (33.0, 51.0, 24.5), 3: "E", 4: (151.0, 12.0, 54.0), 5: b"\1", 6: 4.25}
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(numbers)
    big = Image.fromarray(smooth(96, 64))
    decode(saved(tmp_path / "warm.png", big))  # registers HEIC
    place = decode(saved(tmp_path / f"a.{suffix}", big, exif=exif)).gps
    assert place.latitude == pytest.approx(-(33 + 51 / 60 + 24.5 / 3600), abs=1e-6)
    assert place.longitude == pytest.approx(151 + 12 / 60 + 54 / 3600, abs=1e-6)
    assert place.altitude_m == pytest.approx(-4.25)
    assert decode(tmp_path / "warm.png").gps == GpsPosition()


@pytest.mark.parametrize(
    "wrong",
    [
        {"GPSLatitude": (0, 0, 0), "GPSLongitude": (0, 0, 0)},  # no place found
        {"GPSLatitude": (91, 0, 0)},
        {"GPSLongitude": (180, 0, 1)},
        {"GPSLatitude": (51, float("nan"), 0)},
        {"GPSLatitude": (51, 28, TiffImagePlugin.IFDRational(0, 0))},
        {"GPSLatitude": (51, float("nan"), float("nan"))},
        {"GPSLatitude": (51, 28)},
        {"GPSLatitude": "51.4"},
        {"GPSLatitude": None},
        {"GPSLongitudeRef": None},
        {"GPSLatitudeRef": "E"},
    ],
)
def test_a_place_that_cannot_be_is_none(wrong: dict[str, object]) -> None:
    assert gps_from_exif(GREENWICH | {"GPSAltitude": 46.0} | wrong) == GpsPosition()


@pytest.mark.parametrize("seconds", [TiffImagePlugin.IFDRational(0, 0), float("nan"), None])
def test_minutes_with_a_fraction_need_no_seconds(seconds: object) -> None:
    place = gps_from_exif(GREENWICH | {"GPSLatitude": (51, 28 + 38 / 60, seconds)})
    assert place[:2] == pytest.approx(gps_from_exif(GREENWICH)[:2], abs=1e-9)


def test_altitudes_stand_for_themselves() -> None:
    place = gps_from_exif(GREENWICH)
    assert place[:2] == pytest.approx((51.477222, -0.0005), abs=1e-6) and place.altitude_m is None
    for value, level, expected in (
        (46.0, b"\0", 46.0),
        (12.5, 1, -12.5),
        (30.0, b"\3", -30.0),
        (1e9, 0, None),
        (float("nan"), 0, None),
    ):
        tags = GREENWICH | {"GPSAltitude": value, "GPSAltitudeRef": level}
        assert gps_from_exif(tags) == GpsPosition(place.latitude, place.longitude, expected)


@pytest.mark.parametrize("scene", ["banana", "sceaux_castle", "fern", "fox"])
def test_focal_prior_agrees_with_colmap(shared_data: Path, scene: str) -> None:
    photo = min((shared_data / scene / "images").iterdir())
    camera = pycolmap.infer_camera_from_image(photo)
    focal = decode(photo).camera_key.focal_px
    assert (focal is not None) == camera.has_prior_focal_length
    assert focal is None or focal == pytest.approx(camera.params[0], rel=1e-6)


def test_when_a_photo_was_taken(tmp_path: Path) -> None:
    tags: dict[str, Any] = {"DateTimeOriginal": "2024:02:29 23:59:58", "SubsecTimeOriginal": "75"}
    told = decode(saved(tmp_path / "a.jpg", Image.fromarray(smooth()), exif=exif_with(**tags))).clock_s
    assert told == pytest.approx(datetime(2024, 2, 29, 23, 59, 58, 750_000, UTC).timestamp(), abs=1e-3)
    later = clock_from_exif({"DateTimeOriginal": "2024:03:01 00:00:00"})
    assert told is not None and later is not None and later - told == pytest.approx(1.25, abs=1e-3)


@pytest.mark.parametrize(
    "told", [None, "", "0000:00:00 00:00:00", "    :  :     :  :  ", "2024:13:01 00:00:00", 7, b"x"]
)
def test_a_clock_that_was_never_set_tells_nothing(told: object) -> None:
    assert clock_from_exif({"DateTimeOriginal": told}) is None
    assert clock_from_exif({}) is None
