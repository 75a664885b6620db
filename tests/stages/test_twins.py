"""What only belongs to a photo is set aside by its name, and no photo is."""

import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stages import ingest
from stages.ingest import Config
from stages.photos import read_photos
from stages.sources import find_source
from stages.twins import is_mask, twins
from tests.stages.test_sources import touch


@pytest.mark.parametrize(
    ("photo", "twin"),
    [
        ("00000000.jpg", "00000000_masked.jpg"),  # BlendedMVS
        ("image/000000.png", "mask/000.png"),  # DTU as NeuS has it
        ("color/12.jpg", "depth/12.png"),  # ScanNet
        ("frame-000000.color.jpg", "frame-000000.depth.png"),  # 7-Scenes
        ("r_0.png", "r_0_depth_0001.png"),  # NeRF-synthetic
        ("r_0.png", "r_0_normal.png"),
        ("r_0.png", "r_0_alpha.png"),
        ("IMG_1.heic", "IMG_1-Mask.PNG"),
        ("a.jpg", "Depth_Maps/a.png"),
        ("left/images/a.jpg", "left/Masks/a_mask.png"),
        ("rgb/left/7.jpg", "normals/left/007.png"),
    ],
)
def test_a_twin_has_the_name_of_its_photo(photo: str, twin: str) -> None:
    others = ["other.jpg", "rgb/8.jpg", "image/1.png"]
    assert twins([photo, twin, *others]) == {twin: photo}
    assert twins([twin, *others]) == {}
    assert is_mask(twin) == ("mask" in twin.lower() and "masked" not in twin)


@pytest.mark.parametrize(
    "names",
    [
        ("a.jpg", "a2.jpg", "a_2.jpg", "a copy.jpg", "unmasked.jpg", "depth.jpg", "a_maskarade.jpg", "a.png"),
        ("mask_on/1.jpg", "mask_off/1.jpg"),  # nothing that they could belong to
        ("depth/1.jpg", "mask/1.jpg"),
        ("rgb/1305031102.175304.png", "depth/1305031102.160407.png"),  # TUM: of no photo by name
        ("normal_light/1.jpg", "flash/1.jpg"),
        ("left/1.jpg", "right/1.jpg", "maskenball/1.jpg", "a/left/1.jpg", "b/mask/2.jpg"),
    ],
)
def test_what_may_be_a_photo_of_its_own_stays(names: tuple[str, ...]) -> None:
    assert twins(names) == {}


parts = st.sampled_from(["a", "b_mask", "mask", "0", "00", "depth", "a_depth", "image", "a.color", "a_mask_depth"])
names_of_files = st.lists(
    st.lists(parts, min_size=1, max_size=3).map(lambda some: "/".join(some) + ".png"), unique=True
)


@given(names_of_files)
def test_every_twin_leads_to_a_photo_that_stays(names: list[str]) -> None:
    found = twins(names)
    assert set(found) <= set(names) >= set(found.values())
    for name in found:
        for _ in names:
            name = found.get(name, name)
        assert name not in found


def test_sources_list_photos_without_their_twins(tmp_path: Path) -> None:
    touch(tmp_path, "image/000000.png", "image/000001.png", "mask/000.png", "mask/001.png", "mask/002.png")
    source = find_source(tmp_path)
    assert [source.name(file) for file in source.files] == ["image/000000.png", "image/000001.png", "mask/002.png"]
    assert source.set_aside == {"mask/000.png": "image/000000.png", "mask/001.png": "image/000001.png"}


def put(file: Path, seed: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)).save(file)


def test_what_is_set_aside_is_said_and_a_mask_can_be_used_as_is_said(tmp_path: Path, progress: Any) -> None:
    for index in range(5):
        put(tmp_path / f"in/image/{index}.png", index)
        mask = np.full((24, 32), 255, np.uint8)
        mask[:, :8] = 0
        (tmp_path / "in/mask").mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / f"in/mask/{index}.png")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == [f"image/{index}.png" for index in range(5)]
    assert progress.notes == [
        "5 files are set aside, named as a mask, depth map or other copy of a photo: mask/0.png (of image/0.png), "
        "mask/1.png (of image/1.png), mask/2.png (of image/2.png) and 2 more",
        "to be used as a mask, whose black is ignored, mask/0.png would have to be masks/image/0.png",
    ]
    (tmp_path / "in/masks/image").mkdir(parents=True)
    shutil.move(tmp_path / "in/mask/0.png", tmp_path / "in/masks/image/0.png")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "again", progress)
    assert [photo.used_share for photo in read_photos(tmp_path / "again")] == [0.75, 1, 1, 1, 1]


@pytest.mark.parametrize(("photos", "masks"), [("images", "mask"), ("frames", "masks"), ("frames", "mask")])
def test_masks_beside_photos_that_are_not_used_are_named(
    photos: str, masks: str, tmp_path: Path, progress: Any
) -> None:
    folder, unused = tmp_path / "in" / photos, tmp_path / "in" / masks
    words = f"masks lie in {unused} and are not used: in {folder / 'masks'} they would be (black is ignored)"
    for index in range(2):
        put(folder / f"{index}.png", index)
    touch(unused, "notes.txt", "of another.png")
    ingest.run(Config(photos=folder), {}, tmp_path / "1", progress)
    assert progress.notes == []
    Image.fromarray(np.eye(24, 32, dtype=np.uint8) * 255).save(unused / "0.png.png")
    ingest.run(Config(photos=folder), {}, tmp_path / "2", progress)
    assert progress.notes == [words]
    unused.rename(folder / "masks")
    ingest.run(Config(photos=folder), {}, tmp_path / "3", progress)
    assert words not in progress.notes[1:] and read_photos(tmp_path / "3")[0].mask is not None


def test_cameras_that_lie_with_photos_are_named_with_what_would_use_them(tmp_path: Path, progress: Any) -> None:
    scene = tmp_path / "my scene"
    for index in range(2):
        put(scene / f"images/{index}.png", index)
    frames = '{"file_path": "images/0.png", "transform_matrix": []}, {"file_path": "x", "transform_matrix": []}'
    (scene / "transforms.json").write_text(f'{{"frames": [{frames}]}}')
    for place, folder in product(("transforms.json", "sparse/0"), ("", "images")):
        if place == "sparse/0":
            touch(scene / place, "cameras.bin", "images.bin", "points3D.bin")
        progress.notes.clear()
        ingest.run(Config(photos=scene / folder), {}, tmp_path / "out" / place / folder, progress)
        assert progress.notes == [
            f"cameras lie in {scene / place} and are not used: --cameras '{scene / place}' would use them"
        ]
        assert find_source(scene / folder, scene / place).cameras == scene / place


@pytest.mark.parametrize("other", ["sparse/1", "x"])
def test_cameras_that_would_not_be_accepted_are_not_named(other: str, tmp_path: Path, progress: Any) -> None:
    for index in range(2):
        put(tmp_path / f"in/images/{index}.png", index)
    if other == "sparse/1":
        for model in "01":
            touch(tmp_path / "in/sparse" / model, "cameras.bin", "images.bin", "points3D.bin")
    for content in ("{", '{"frames": [{"file_path": "images/of another.png", "transform_matrix": []}]}'):
        (tmp_path / "in/transforms.json").write_text(content)
        ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
        assert progress.notes == []
        shutil.rmtree(tmp_path / "out")
