"""What structure-from-motion makes of photo sets that it finds hard: the right cameras, or the right words."""

import json
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from nerf.geometry.alignment import align
from pipeline.cli.commands import run_command
from stages import ingest, sfm
from stages.contract import Note, StageError, run_stage
from stages.io.files import read_json
from stages.sfm.colmap.models import read_model
from tests.hard_photos import (
    BARREL,
    FISHEYE,
    LENS,
    OFF_CENTRE,
    PLANE,
    TELE,
    WIDE,
    Shot,
    along,
    as_taken,
    closer,
    every_fifth_blurred,
    exposed,
    on_the_spot,
    shoot,
    straight_ahead,
    two_lenses,
    walk,
)
from tests.refusals import refused

SCENE_SIZE = 2.0  # the diameter of the table
OUTLIER = [*along(walk(11)), Shot("stranger.png", LENS, walk(1, start=20)[0], scene=7)]
TWO_GROUPS = [*along(walk(9)), *along(walk(7), scene=PLANE, prefix="other")]


def found(
    folder: Path, shots: Sequence[Shot], develop: Callable = as_taken, config: sfm.Config | None = None
) -> tuple[Path, list[Note]]:
    """The finished stage sfm of these photos, and what was said."""
    notes: list[Note] = []

    class Listening:
        def update(self, message: str, done: float | None = None) -> None:
            pass

        def note(self, code: str, text: str) -> None:
            notes.append(Note(code, text))

    shoot(folder / "photos", shots, develop)
    inputs = {"ingest": folder / "ingest"}
    inputs["ingest"].mkdir()
    ingest.run(ingest.Config(photos=folder / "photos"), {}, inputs["ingest"], Listening())
    run_stage(sfm.STAGE, config or sfm.Config(), inputs, folder / "sfm", Listening())
    return folder / "sfm", notes


def errors(folder: Path, shots: Sequence[Shot]) -> dict[str, tuple[float, float]]:
    """Of every registered photo: how far off it is, in percent of the scene's size, and how far turned, in degrees."""
    images = read_model(folder / "sparse").images
    by_name = {shot.name: shot.pose for shot in shots}
    true = np.stack([by_name[image.file] for image in images])
    poses = np.stack([image.sfm_from_camera for image in images])
    true_from_sfm = align(poses[:, :, 3], true[:, :, 3])
    poses = np.stack([true_from_sfm.pose(pose) for pose in poses])
    percent = 100 / SCENE_SIZE * np.linalg.norm(poses[:, :, 3] - true[:, :, 3], axis=1)
    cosines = (np.einsum("nij,nij->n", poses[:, :, :3], true[:, :, :3]) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return {image.file: pair for image, *pair in zip(images, percent, degrees, strict=True)}  # type: ignore[misc]


def missing(folder: Path) -> dict[str, str]:
    """The code of the reason why, by unregistered photo."""
    images = read_json(folder / "registration.json")["images"]
    return {image["file"]: image["reason_code"] for image in images if not image["registered"]}


@pytest.mark.parametrize(
    ("shots", "develop", "focal_px"),
    [
        pytest.param(along(walk(12), BARREL), as_taken, (250,), id="barrel distortion"),
        pytest.param(along(closer(walk(14, of=28), 0.5), FISHEYE), as_taken, (152.8,), id="fisheye of 150 degrees"),
        pytest.param(along(walk(12), OFF_CENTRE), as_taken, (330,), id="principal point off centre"),
        pytest.param(two_lenses(), as_taken, (TELE.params[0], WIDE.params[0]), id="two lenses"),
        pytest.param(along(walk(12), scene=PLANE), as_taken, (334,), id="planar scene"),
        pytest.param(along(walk(3)), as_taken, (334,), id="three photos"),
        pytest.param(along(walk(12)), exposed, (334,), id="exposure from -2 to +2 EV"),
    ],
)
def test_every_camera_is_found(
    shots: list[Shot], develop: Callable, focal_px: tuple[float, ...], tmp_path: Path
) -> None:
    folder, _ = found(tmp_path, shots, develop)
    assert missing(folder) == {}
    off = np.array(list(errors(folder, shots).values()))
    assert off.shape == (len(shots), 2) and (off > 0).any() and (off < 1).all()
    cameras = sorted(read_model(folder / "sparse").cameras, key=lambda camera: -camera.params[0])
    assert [camera.params[0] for camera in cameras] == pytest.approx(focal_px, rel=0.03)


def test_a_photo_of_another_scene_is_left_out(tmp_path: Path) -> None:
    folder, notes = found(tmp_path, OUTLIER)
    assert list(missing(folder)) == ["stranger.png"]
    assert any(code == "sfm.unregistered" and "1 of 12" in text for code, text in notes)
    assert 0 < max(max(pair) for pair in errors(folder, OUTLIER).values()) < 1


def test_the_larger_of_two_groups_is_taken(tmp_path: Path) -> None:
    folder, notes = found(tmp_path, TWO_GROUPS)
    assert list(missing(folder)) == [shot.name for shot in TWO_GROUPS if shot.scene == PLANE]
    assert set(missing(folder).values()) == {"sfm.unregistered-other-group"}
    assert 0 < max(max(pair) for pair in errors(folder, TWO_GROUPS).values()) < 1
    strategies = read_json(folder / "registration.json")["strategies"]
    assert strategies[0]["registered"] == 9
    assert any(code == "sfm.unregistered" and "7 of 16" in text for code, text in notes)


def test_the_other_group_runs_by_its_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    shoot(tmp_path / "my photos", TWO_GROUPS)
    up_to_sfm = ["--until", "sfm", "--sfm.max-strategies", "1", "--json"]
    assert run_command(["run", str(tmp_path / "my photos"), "-o", str(tmp_path / "w.nerf"), *up_to_sfm]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (note,) = [event["message"] for event in events if event.get("code") == "sfm.photo-group"]
    _, _, command = note.partition("pipeline ")
    assert run_command([*shlex.split(command), *up_to_sfm]) == 0
    (other,) = {*tmp_path.glob("*.nerf")} - {tmp_path / "w.nerf"}
    photos = [photo["name"] for photo in read_json(other / "output/photos.json")["photos"]]
    assert photos == [shot.name for shot in TWO_GROUPS if shot.scene == PLANE]
    assert missing(other / "output") == {}
    assert 0 < max(max(pair) for pair in errors(other / "output", TWO_GROUPS).values()) < 1
    assert not (other / "output/photo_groups").exists()


def test_blurred_photos_are_named_and_do_no_harm(tmp_path: Path) -> None:
    shots = along(walk(15))
    folder, notes = found(tmp_path, shots, every_fifth_blurred)
    blurred = {shot.name for index, shot in enumerate(shots) if index % 5 == 2}
    assert missing(folder).keys() <= blurred
    assert all(any(name in note.text for note in notes) for name in blurred)
    off = errors(folder, shots)
    assert 0 < max(max(pair) for name, pair in off.items() if name not in blurred) < 1
    assert all(max(pair) < 5 for pair in off.values())  # 15 px of blur are 5 % of the width


def test_pure_rotation_is_named(tmp_path: Path) -> None:
    with refused("sfm.pure-rotation", "66 of 66"):
        found(tmp_path, along(on_the_spot()))


def test_forward_motion_is_named_or_solved(tmp_path: Path) -> None:
    """The default strategy alone: another one, which takes the camera model as known, registers them all. Whether the
    default does is on the edge: it differs between processors, by their rounding."""
    shots = along(straight_ahead())
    try:
        folder, _ = found(tmp_path, shots, config=sfm.Config(max_strategies=1))
    except StageError as error:
        assert error.code == "sfm.forward-motion" and "66 of 66" in error.why
    else:
        assert not missing(folder)
        assert 0 < read_json(folder / "registration.json")["reprojection_px"] < 1
