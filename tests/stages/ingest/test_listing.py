"""Which files of a folder are taken, where a video and what cameras write beside it lie there."""

from pathlib import Path

import pytest

from stages.ingest.sources import find_source
from tests.refusals import refused
from tests.stages.ingest.test_sources import names, touch


@pytest.mark.parametrize(
    "beside",
    [
        ["DJI_0001.SRT"],
        ["DJI_0001.LRF", "DJI_0001.MRK", "DJI_0001.nav", "DJI_0001.obs"],
        ["GL010001.LRV", "GX010001.THM"],
        ["README", "track.gpx", "track.kml", "clip.vtt"],
    ],
)
def test_a_video_is_taken_whatever_its_camera_writes_beside_it(tmp_path: Path, beside: list[str]) -> None:
    source = find_source(touch(tmp_path, "GX010001.MP4", *beside))
    assert (source.kind, names(source)) == ("video", ["GX010001.MP4"])


@pytest.mark.parametrize("photo", ["a.jpg", "a.JP2", "a.DNG", "a.HIF"])
def test_an_image_by_its_ending_precedes_a_video(tmp_path: Path, photo: str) -> None:
    source = find_source(touch(tmp_path, "clip.mp4", photo, "unknown"))
    assert (source.kind, names(source)) == ("photos", [photo, "unknown"])


def test_photos_of_unknown_endings_precede_a_video(tmp_path: Path) -> None:
    source = find_source(touch(tmp_path, "clip.mp4", "0.x", "1.x", "2.x"))
    assert (source.kind, names(source)) == ("photos", ["0.x", "1.x", "2.x"])


def test_files_without_endings_are_tried_without_a_video(tmp_path: Path) -> None:
    assert names(find_source(touch(tmp_path, "0", "1", "0.srt"))) == ["0", "1"]
    assert names(find_source(touch(tmp_path, "a.mp4", "b.mp4"))) == ["0", "1"]


def test_a_preview_is_a_video_where_there_is_no_other(tmp_path: Path) -> None:
    assert names(find_source(touch(tmp_path, "a.lrf"))) == ["a.lrf"]
    assert find_source(tmp_path / "a.lrf").kind == "video"
    with refused("ingest.several-videos", "2 videos", "a.lrf, b.LRV"):
        find_source(touch(tmp_path, "b.LRV"))
