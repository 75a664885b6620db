import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nerf import REGION_HALF_SIZE
from nerf.geometry.camera_paths import nearest_rotations
from nerf.geometry.scene import Camera
from stages import normalise
from stages.io.files import read_json, read_scene, read_tensors, write_png
from stages.io.photos import Box, Photo, read_photos, write_photos
from stages.normalise.scene_frame import _within
from stages.normalise.split import split_photos
from tests.camera_layouts import ball, ring, seen_by
from tests.refusals import refused

CAMERA = Camera("PINHOLE", 400, 400, (400.0, 400.0, 200.0, 200.0))


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Builds the folders of ingest and sfm for a ring of photos around a ball of points; COLMAP lists them reversed."""

    def build(
        count: int = 17,
        transparent: int = 0,
        test_files: list[str] | None = None,
        one_place: bool = False,
        crooked: bool = False,
        opaque: Box | None = None,
        around: float = 0.0,
        before: int | None = None,
    ) -> dict[str, Path]:
        poses = ring(count)
        if crooked:
            shaken = poses + np.random.default_rng(0).normal(0, 0.02, poses.shape)
            poses = np.concatenate([nearest_rotations(shaken[:, :, :3]), shaken[:, :, 3:]], axis=2)
        if one_place:
            poses[:, :, 3] = 0
        # ``around`` so far about the ball there are points, too, a tenth as many as the photos see of it
        ring_about = around * ring(40, 1.0, 0.0)[:, :, 3] if around else np.zeros((0, 3))
        scene = seen_by(poses, np.zeros((0, 3)) if one_place else np.concatenate([ball(), ring_about]))
        folders = {name: tmp_path / name for name in ("ingest", "sfm", "normalise")}
        for folder in folders.values():
            folder.mkdir(exist_ok=True)
        photos = [
            Photo(f"ä {i:02d}.jpg", f"images/{i:02d}.png", 400, 400, 0, None, None, i < transparent, 1.0)
            for i in range(count)
        ]
        photos = [
            replace(photo, opaque=opaque, opaque_mask=f"opaque/{i:02d}.png") if photo.has_alpha else photo
            for i, photo in enumerate(photos)
        ]
        write_photos(folders["ingest"], photos, [], {})
        (folders["ingest"] / "images").mkdir(exist_ok=True)
        for photo in photos:
            pixels = np.random.default_rng(0).integers(0, 256, (20, 20, 3), np.uint8)
            if before is not None:
                pixels[:4], pixels[-4:], pixels[:, :4], pixels[:, -4:] = before, before, before, before
            write_png(folders["ingest"] / photo.file, pixels)
        (folders["sfm"] / "registration.json").write_text(json.dumps({"test_files": test_files, "georeference": None}))
        model = SimpleNamespace(
            cameras=[CAMERA],
            images=[
                SimpleNamespace(file=f"{i:02d}.png", camera=0, sfm_from_camera=scene.from_camera[i])
                for i in reversed(range(count))
            ],
            xyz=scene.points,
            rgb=np.full((len(scene.points), 3), 7, np.uint8),
            error_px=np.ones(len(scene.points)),
            view=count - 1 - scene.view,
            point=scene.point,
            xy=np.zeros((len(scene.view), 2)),
        )
        monkeypatch.setattr("stages.normalise.scene_frame.read_model", lambda sparse: model)
        return folders

    return build


def run(folders: dict[str, Path], progress, **config):
    return normalise.run(normalise.Config(**config), folders, folders["normalise"], progress)


def test_views_keep_names_poses_and_observations_in_order(inputs, progress) -> None:
    folders = inputs()
    result = run(folders, progress)
    scene, points = read_scene(folders["normalise"]), read_tensors(folders["normalise"] / "points.safetensors")
    assert [view.name for view in scene.views] == [f"ä {i:02d}.jpg" for i in range(17)]
    local = np.einsum(
        "nji,nj->ni",
        np.stack([scene.views[v].scene_from_camera[:, :3] for v in points["view"]]),
        points["xyz"][points["point"]] - np.stack([scene.views[v].scene_from_camera[:, 3] for v in points["view"]]),
    )
    assert len(local) > 1000
    assert (np.abs(local[:, :2]) <= 0.501 * local[:, 2:]).all()  # every point lies in the view that observes it
    assert {name: part.dtype.name for name, part in points.items()} == {
        "xyz": "float32",
        "rgb": "uint8",
        "error_px": "float32",
        "view": "int32",
        "point": "int32",
        "xy": "float32",
    }
    assert all((folders["normalise"] / name).is_file() for name in result.outputs)


def test_the_line_says_what_was_decided(inputs, progress) -> None:
    result = run(inputs(), progress)
    assert result.line == "360° around an object, background unbounded · up from level horizons"
    assert result.facts["train"] + result.facts["test"] == 17


@pytest.mark.parametrize(("altitude_m", "source"), [(408.0, "GPS"), (None, "level standpoints")])
def test_up_follows_gps_heights(inputs, progress, altitude_m, source) -> None:
    """Photos that are not quite level, half of them with places off by 0.1 m of hundreds."""
    folders = inputs(crooked=True)
    photos = read_photos(folders["ingest"])
    located = [replace(photo, latitude=47.0, longitude=8.0, altitude_m=altitude_m) for photo in photos]
    write_photos(folders["ingest"], [*located[:9], *photos[9:]], [], {})
    georeference = {"enu_from_sfm": np.diag([100.0, 100, 100, 1]).tolist(), "error_m": 0.1}
    registration = {"test_files": None, "georeference": georeference}
    (folders["sfm"] / "registration.json").write_text(json.dumps(registration))
    result = run(folders, progress)
    assert result.line.endswith(f"up from {source}")
    assert (result.facts["up"], result.facts["up_known"]) == (source, True)


def test_alpha_makes_the_background_known(inputs, progress) -> None:
    folders = inputs(transparent=17)
    assert "background transparent" in run(folders, progress).line
    scene = read_scene(folders["normalise"])
    assert scene.has_alpha
    assert scene.bounded
    assert progress.notes == []


@pytest.mark.parametrize(
    ("transparent", "has_alpha", "code", "named"),
    [
        (16, True, "opaque-photos", "1 of 17"),
        (1, False, "alpha-ignored", "1 of 17"),
        (9, False, "alpha-ignored", "9 of 17"),  # of the training photos they are half
    ],
)
def test_most_training_photos_decide_on_alpha_and_exceptions_are_named(
    inputs, progress, transparent, has_alpha, code, named
) -> None:
    folders = inputs(transparent=transparent)
    run(folders, progress)
    scene = read_scene(folders["normalise"])
    assert (scene.has_alpha, scene.bounded, progress.codes) == (has_alpha, has_alpha, [f"normalise.{code}"])
    assert progress.names(f"normalise.{code}", named)
    assert [view.mask for view in scene.views] == [
        f"opaque/{i:02d}.png" if not has_alpha and i < transparent else None for i in range(17)
    ]


@pytest.mark.parametrize(
    ("opaque", "around", "code"),
    [
        ((0.0, 0.0, 1.0, 1.0), 0.0, "alpha-ignored"),
        ((0.0, 0.3, 1.0, 1.0), 0.0, "alpha-ignored"),
        ((0.2, 0.3, 0.8, 1.0), 20.0, "alpha-beyond-region"),
    ],
    ids=["empty corners", "no sky", "the distance"],
)
def test_alpha_is_no_background_where_the_scene_goes_on(
    inputs, progress, opaque: Box, around: float, code: str
) -> None:
    folders = inputs(transparent=17, opaque=opaque, around=around)
    assert "background unbounded" in run(folders, progress).line
    scene = read_scene(folders["normalise"])
    assert not scene.has_alpha and not scene.bounded
    assert [view.mask for view in scene.views] == [f"opaque/{i:02d}.png" for i in range(17)]
    assert progress.codes == [f"normalise.{code}"]


@pytest.mark.parametrize("opaque", [None, (0.2, 0.3, 0.8, 1.0), (0.0, 0.3, 1.0, 0.9)])
def test_alpha_is_the_background_of_a_whole_object(inputs, progress, opaque: Box | None) -> None:
    folders = inputs(transparent=17, opaque=opaque)
    run(folders, progress)
    assert read_scene(folders["normalise"]).has_alpha and progress.notes == []


def test_before_a_plain_backdrop_the_object_is_all(inputs, progress) -> None:
    folders = inputs(before=255)
    assert "background plain" in run(folders, progress).line
    scene = read_scene(folders["normalise"])
    assert scene.bounded and not scene.has_alpha and scene.backdrop == (1.0, 1.0, 1.0)
    assert progress.codes == ["normalise.backdrop"]
    assert np.abs(read_tensors(folders["normalise"] / "points.safetensors")["xyz"]).max() < REGION_HALF_SIZE


def test_a_backdrop_with_points_is_none(inputs, progress) -> None:
    folders = inputs(before=0, around=20.0)
    assert "background unbounded" in run(folders, progress).line
    scene = read_scene(folders["normalise"])
    assert not scene.bounded and scene.backdrop is None
    assert progress.codes == ["normalise.backdrop-beyond-region"]


def test_masks_around_an_object_become_its_alpha(inputs, progress) -> None:
    folders = inputs()
    masked = [replace(photo, mask=f"masks/{i:02d}.png") for i, photo in enumerate(read_photos(folders["ingest"]))]
    (folders["ingest"] / "masks").mkdir()
    for i, photo in enumerate(masked):
        mask = np.zeros((400, 400), np.uint8)
        cv2.circle(mask, (200, 200), 125 + i, 255, -1)
        write_png(folders["ingest"] / photo.file, np.repeat(mask[..., None], 3, axis=2))
        write_png(folders["ingest"] / str(photo.mask), mask if i < 16 else np.full_like(mask, 255))
    write_photos(folders["ingest"], masked, [], {})
    run(folders, progress)
    scene = read_scene(folders["normalise"])
    assert scene.has_alpha and scene.bounded and progress.codes == ["normalise.masks-cut-out"]
    assert [(view.mask, view.alpha) for view in scene.views] == [(None, photo.mask) for photo in masked]
    frames = read_json(folders["normalise"] / "transforms.json")["frames"]
    assert [frame["mask_path"] for frame in frames] == [photo.mask for photo in masked]
    run(folders, progress, masks="ignore")
    scene = read_scene(folders["normalise"])
    assert not scene.has_alpha and not scene.bounded
    assert [(view.mask, view.alpha) for view in scene.views] == [(photo.mask, None) for photo in masked]


def test_where_nothing_is_tracked_alpha_is_the_background(inputs, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.stages.normalise.test_normalise.ball", lambda: np.zeros((0, 3)))
    folders = inputs(transparent=17, opaque=(0.0, 0.0, 1.0, 1.0))
    run(folders, progress)
    scene = read_scene(folders["normalise"])
    assert scene.has_alpha and scene.bounded and not any(view.mask for view in scene.views)


@pytest.mark.parametrize(("count", "held_out"), [(3, [0]), (8, [0]), (9, [0, 8]), (17, [0, 8, 16])])
def test_every_eighth_photo_is_held_out_beginning_with_the_first(inputs, progress, count, held_out) -> None:
    folders = inputs(count)
    run(folders, progress)
    views = read_scene(folders["normalise"]).views
    assert [i for i, view in enumerate(views) if view.split == "test"] == held_out


def rig(standpoints: int, views: int) -> list[str]:
    return [f"{i:04d}_{view}.jpg" for i in range(standpoints) for view in range(views)]


@pytest.mark.parametrize(
    ("names", "held_out"),
    [
        ([f"frame_{i:05d}.png" for i in range(20)], [0, 8, 16]),
        ([f"{letter}.png" for letter in "abcdefghij"], [0, 8]),
        ([f"{day}_{i}.jpg" for day, count in (("a", 5), ("b", 12), ("c", 7)) for i in range(count)], [0, 8, 16]),
        (rig(7, 3), [0, 8, 16]),
        (rig(10, 8), [0, 9, 18, 27, 36, 45, 54, 63, 64, 73]),
        (rig(10, 8)[:70] + rig(10, 8)[71:], [0, 9, 18, 27, 36, 45, 54, 63, 64, 73]),  # one is unregistered
        (rig(3, 16), [0, 9, 18, 27, 36, 45]),
        (rig(8, 4)[:30], [0, 9, 18, 27]),
        (rig(2, 8)[:9], [0, 8]),  # of the second standpoint one is left
    ],
)
def test_a_rig_holds_out_different_views(names: list[str], held_out: list[int]) -> None:
    photos = [Photo(name, f"images/{i}.png", 400, 400, 0, None, None, False, 1.0) for i, name in enumerate(names)]
    split = split_photos(photos, 8, None)
    assert [i for i, part in enumerate(split) if part == "test"] == held_out


def test_an_official_split_is_kept(inputs, progress) -> None:
    folders = inputs(9, test_files=["02.png", "05.png"])
    run(folders, progress, test_every=3)
    views = read_scene(folders["normalise"]).views
    assert [view.file for view in views if view.split == "test"] == ["images/02.png", "images/05.png"]


def test_an_official_split_leaves_photos_to_train_on(inputs, progress) -> None:
    folders = inputs(9, test_files=[f"{i:02d}.png" for i in range(9)])
    with refused("normalise.few-training-photos", "0 of 9", "given split"):
        run(folders, progress)


def test_equal_inputs_give_equal_bytes(inputs, progress) -> None:
    folders = inputs()
    outputs = run(folders, progress).outputs
    first = [(folders["normalise"] / name).read_bytes() for name in outputs]
    run(folders, progress)
    assert first == [(folders["normalise"] / name).read_bytes() for name in outputs]


def test_export_and_scene_tell_the_same_poses(inputs, progress) -> None:
    folders = inputs()
    run(folders, progress)
    scene = read_scene(folders["normalise"])
    frames = read_json(folders["normalise"] / "transforms.json")["frames"]
    for i, (view, frame) in enumerate(zip(scene.views, frames, strict=True)):
        assert (frame["file_path"], frame["photo"]) == (view.file, view.name)
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], ring(17)[i][:, 3], atol=1e-9)


def test_a_given_region_replaces_the_automatic_one(inputs, progress) -> None:
    folders = inputs()
    run(folders, progress, roi=(0.5, 0.0, 0.0, 3.0))
    similarity = read_scene(folders["normalise"]).scene_from_sfm
    assert similarity.scale == pytest.approx(0.3)
    np.testing.assert_allclose(similarity.points(np.array([0.5, 0.0, 0.0])), 0, atol=1e-12)


def test_two_photos_are_too_few(inputs, progress) -> None:
    with refused("normalise.few-photos", "2 registered photos", 3):
        run(inputs(2), progress)


def test_a_region_without_size_is_refused(inputs, progress) -> None:
    with refused("normalise.roi-radius", 0):
        run(inputs(), progress, roi=(0.0, 0.0, 0.0, 0.0))


def test_photos_from_one_place_are_refused_with_a_hint(inputs, progress) -> None:
    with refused("normalise.no-scale", "the same position"):
        run(inputs(one_place=True), progress)


def test_rays_within_a_box_match_its_pixels() -> None:
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1)
    rays = np.concatenate([grid, np.ones((8, 8, 1))], axis=-1)  # x is the column, y the row
    found = _within(rays, (0.5, 0.125, 0.76, 0.5))
    assert set(found[:, 0]) == {4, 5, 6} and set(found[:, 1]) == {1, 2, 3}
    assert len(_within(rays, (0.51, 0.51, 0.52, 0.52))) == 1
    np.testing.assert_array_equal(_within(rays, None), rays.reshape(-1, 3))
