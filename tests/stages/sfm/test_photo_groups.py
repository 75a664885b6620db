"""Photos that form groups of their own: which groups are listed, in which files, and the commands to run them."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.ingest.listing import read_photo_list
from stages.io.photos import Photo
from stages.sfm.reconstruction import list_groups
from stages.sfm.registration import image_rows, photo_groups
from tests.stages.sfm.test_registration import matches

FILES = list("abcdefghijklmnopqrst")
PHOTOS = [Photo(f"my {file}.jpg", f"images/{file}", 4, 3, 0, None, None, False, 1.0) for file in FILES]
MODELS = [["a", "b", "c", "d"], ["e", "f", "g"], ["b", "c", "d"], ["h", "i", "j", "k"], ["l", "m"]]


def test_groups_are_numbered_by_size() -> None:
    assert photo_groups(MODELS) == {
        "photo_groups/2.txt": ["h", "i", "j", "k"],
        "photo_groups/3.txt": ["e", "f", "g"],
    }
    assert photo_groups(MODELS[:1]) == {}


def test_reasons_name_the_list() -> None:
    nothing = dict.fromkeys(FILES, (0, 0))
    linked = matches((4, 5), (7, 8), (11, 12))
    linked = replace(linked, keypoints=linked.keypoints.repeat(len(FILES))[: len(FILES)])
    conflict = {"group": 3, "shared": 2, "different": 2}
    for contradiction in (None, conflict):
        rows = image_rows(FILES, linked, MODELS, {}, nothing, contradiction, {})
        by_file = {row["file"]: row for row in rows}
        assert "output/photo_groups/3.txt" in by_file["e"]["reason"]
        assert "output/photo_groups/2.txt" in by_file["h"]["reason"]
        assert by_file["l"]["reason_code"] == "sfm.unregistered-other-group" and "output" not in by_file["l"]["reason"]
    assert by_file["h"]["reason_code"] == "sfm.unregistered-repeated-structure"


def test_each_group_has_a_list_and_a_command(tmp_path: Path, progress: Any) -> None:
    folder = tmp_path / "my set.nerf/sfm/0123.partial"
    (folder / "photo_groups").mkdir(parents=True)
    (folder / "photo_groups/9.txt").touch()
    list_groups(tmp_path / "my photos", PHOTOS, MODELS, folder, progress)
    assert read_photo_list(folder / "photo_groups/3.txt") == ["my e.jpg", "my f.jpg", "my g.jpg"]
    assert sorted(file.name for file in (folder / "photo_groups").iterdir()) == ["2.txt", "3.txt"]
    assert progress.codes == ["sfm.photo-group"] * 2
    assert progress.names("sfm.photo-group", "4 photos", "my h.jpg")
    command = shlex.split(progress.notes[0].partition("pipeline run ")[2])
    listed, other = tmp_path / "my set.nerf/output/photo_groups/2.txt", tmp_path / "my set-2.nerf"
    assert command == [str(tmp_path / "my photos"), "--ingest.photo-list", str(listed), "-o", str(other)]


def test_frames_of_a_video_are_run_from_the_workspace(tmp_path: Path, progress: Any) -> None:
    frames = [replace(photo, time_s=float(index)) for index, photo in enumerate(PHOTOS)]
    list_groups(tmp_path / "clip.mp4", frames, MODELS, tmp_path / "clip.nerf/sfm/0123.partial", progress)
    assert progress.names("sfm.photo-group", tmp_path / "clip.nerf/output/images")
    assert not progress.names("sfm.photo-group", "clip.mp4")


def test_few_commands_are_given(tmp_path: Path, progress: Any) -> None:
    models = [["a"], *(FILES[first : first + 3] for first in range(1, 16, 3))]
    list_groups(None, PHOTOS, models, tmp_path, progress)
    assert progress.codes == ["sfm.photo-group"] * 3 + ["sfm.more-photo-groups"]
    assert len(list((tmp_path / "photo_groups").iterdir())) == 5
    list_groups(None, PHOTOS, [FILES], tmp_path, progress)
    assert not (tmp_path / "photo_groups").exists()
