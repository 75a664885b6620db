"""Results of a workspace that are given back to it as cameras: they are read, and kept, where they stay."""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.display import SilentDisplay
from pipeline.engine.run_file import RunFile
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.workspace import COPIES, Workspace, is_result, lasting
from stages.sfm import Config as SfmConfig

SHOWN = {"render": "path.json", "sfm": "sparse", "normalise": "transforms.json"}
KEY = "0123456789abcdef"


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """One that shows cameras of three finished stages."""
    root = tmp_path / "w.nerf"
    for stage in SHOWN:
        (root / stage / KEY).mkdir(parents=True)
    (root / "render" / KEY / "path.json").touch()
    frame = {"file_path": "0.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    (root / "normalise" / KEY / "transforms.json").write_text(json.dumps({"fl_x": 5, "frames": [frame]}))
    (root / "sfm" / KEY / "sparse").mkdir()
    for part in ("cameras", "images", "points3D"):
        (root / "sfm" / KEY / f"sparse/{part}.bin").touch()
    with Workspace(root) as held:
        held.write_run(held.read_run())
        for stage, name in SHOWN.items():
            held.link_outputs(root / stage / KEY, (name,))
    return root


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "photos/0.png")
    return tmp_path / "photos"


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[Settings]:
    """The settings of each run, of which no stage runs."""
    found: list[Settings] = []
    monkeypatch.setattr(
        "pipeline.engine.runner.Runner.run", lambda self, *_, **__: found.append(self.settings) or False
    )
    return found


def test_cameras_of_a_video_are_read_where_they_stay(
    workspace: Path, seen: list[Settings], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(workspace)
    shown, stays = workspace / "output/path.json", workspace / "render" / KEY / "path.json"
    for words in (["--cameras", str(shown)], ["--render.cameras", str(shown)]):
        assert run_command(["render", str(workspace), *words]) == 0
    assert [settings.render.cameras for settings in seen] == [stays, stays]


@pytest.mark.parametrize(
    ("given", "stays"),
    [
        ("output/sparse", f"sfm/{KEY}/sparse"),
        ("output", f"sfm/{KEY}/sparse"),
        ("output/transforms.json", f"normalise/{KEY}/transforms.json"),
    ],
)
def test_cameras_of_photos_are_read_where_they_stay(
    given: str, stays: str, workspace: Path, photos: Path, seen: list[Settings], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(workspace)
    assert run_command(["run", str(photos), "-o", ".", "--cameras", given]) == 0
    assert [(settings.ingest.cameras, settings.sfm.cameras) for settings in seen] == [(workspace / stays,) * 2]


def test_cameras_of_another_workspace_are_recorded_as_shown(workspace: Path, photos: Path, tmp_path: Path, seen: list):
    shown = workspace / "output/transforms.json"
    assert run_command(["run", str(photos), "-o", str(tmp_path / "other.nerf"), "--cameras", str(shown)]) == 0
    assert seen[0].ingest.cameras == seen[0].sfm.cameras == shown


def test_a_photo_list_is_read_where_it_stays(workspace: Path, photos: Path, tmp_path: Path, seen: list):
    stays = workspace / "sfm" / KEY / "photo_groups/2.txt"
    stays.parent.mkdir()
    stays.write_text("0.png\n")
    with Workspace(workspace) as held:
        held.link_outputs(workspace / "sfm" / KEY, ("photo_groups",))
    given = ["--ingest.photo-list", str(workspace / "output/photo_groups/2.txt")]
    for root in (workspace, tmp_path / "other.nerf"):
        assert run_command(["run", str(photos), "-o", str(root), *given]) == 0
    assert [settings.ingest.photo_list for settings in seen] == [stays, Path(given[1])]
    with Workspace(workspace) as held:
        held.write_run(RunFile(options={"ingest": {"photo_list": str(stays)}}))
    assert run_command(["clean", str(workspace)]) == 0
    assert stays.exists() and not (workspace / "render" / KEY).exists()


def test_links_of_the_user_s_own_are_recorded_as_given(workspace: Path, photos: Path, tmp_path: Path, seen: list):
    (tmp_path / "mine.json").symlink_to(workspace / "normalise" / KEY / "transforms.json")
    (tmp_path / "link").symlink_to(photos)
    words = ["run", str(tmp_path / "link"), "-o", str(workspace), "--cameras", str(tmp_path / "mine.json")]
    assert run_command(words) == 0
    assert seen[0].sfm.cameras == tmp_path / "mine.json" and seen[0].ingest.photos == tmp_path / "link"


def test_copies_replace_links_where_links_are_forbidden(workspace: Path):
    shown, stays = workspace / "output/path.json", workspace / "render" / KEY / "path.json"
    shown.unlink()
    shutil.copy(stays, shown)
    assert lasting(shown, workspace) == shown, "of which result it is a copy is not known"
    (workspace / COPIES).write_text(f"path.json\trender/{KEY}/path.json\n")
    assert lasting(shown, workspace) == stays


def test_clean_keeps_what_the_options_name(workspace: Path):
    for stays in (True, False):
        with Workspace(workspace) as held:
            cameras = str(workspace / "output/../render" / KEY / "path.json") if stays else None
            held.write_run(RunFile(options={"render": {"cameras": cameras}}))
        assert run_command(["clean", str(workspace)]) == 0
        assert (workspace / "render" / KEY / "path.json").exists() == stays
        assert not (workspace / "sfm" / KEY).exists()


def test_what_the_options_name_inside_goes_with_a_moved_workspace(workspace: Path, tmp_path: Path):
    (workspace / "mine").mkdir()
    inside, outside = workspace / "sfm" / KEY / "sparse", str(tmp_path / "set/transforms.json")
    options = {"ingest": {"photos": str(workspace / "mine")}, "sfm": {"cameras": str(inside)}}
    with Workspace(workspace) as held:
        held.write_run(RunFile(options=options | {"render": {"cameras": outside}}))
    moved = workspace.rename(tmp_path / "moved.nerf")
    (tmp_path / "link").symlink_to(moved)
    for root in (moved, tmp_path / "link"):
        options = Workspace(root).read_run().options
        assert options["ingest"]["photos"] == str(root / "mine"), "also where no result lies"
        assert options["sfm"]["cameras"] == str(root / "sfm" / KEY / "sparse")
        assert options["render"]["cameras"] == outside
    assert run_command(["clean", str(moved)]) == 0
    assert (moved / "sfm" / KEY / "sparse/images.bin").exists() and not (moved / "normalise" / KEY).exists()


def test_a_moved_workspace_keeps_its_budget(tmp_path: Path):
    def of_options(root: Path) -> str:
        settings = Settings(sfm=SfmConfig(cameras=root / "sfm" / KEY / "sparse"))
        return Runner(Workspace(root), settings, SilentDisplay()).digests.of_options()

    assert of_options(tmp_path / "w.nerf") == of_options(tmp_path / "moved.nerf")


def test_a_result_is_no_photo_set_of_its_own_workspace(workspace: Path, photos: Path, capsys: pytest.CaptureFixture):
    shutil.copytree(photos, workspace / "ingest" / KEY / "images")
    with Workspace(workspace) as held:
        held.link_outputs(workspace / "ingest" / KEY, ("images",))
    for place in ("output/images", f"ingest/{KEY}/images"):
        assert run_command(["run", str(workspace / place), "-o", str(workspace)]) == 2
        assert "is a result in that workspace" in capsys.readouterr().err
    assert (workspace / "output/images/0.png").is_file()
    shutil.copytree(photos, workspace / "mine")
    assert not is_result(workspace / "mine", workspace) and not is_result(photos, workspace)
