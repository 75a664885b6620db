"""What only belongs to a photo is set aside by its name, and no photo is."""

import shutil
import unicodedata
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
from stages.ingest.auxiliary_files import ALL_PHOTOS, Stored, auxiliary_files, depth_maps, is_mask
from stages.ingest.sources import find_source, unused_masks
from stages.io.photos import read_photos
from tests.stages.ingest.test_sources import touch


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
        ("rgb/7.jpg", "normal/7.png"),
        ("images/7.jpg", "confidence/7.png"),  # Polycam
        ("rgb/7.png", "conf/7.png"),
        ("color/7.jpg", "label-filt/7.png"),  # ScanNet
        ("rgb/7.png", "semantic_class/7.png"),
        ("a/7.jpg", "a/Instances/7.tif"),
        ("rgb/7.jpg", "segmentation/7.png"),
        ("rgb/7.jpg", "depth_5m/7.png"),
        ("rgb/7.jpg", "depth_5/7.jpg"),
    ],
)
def test_a_twin_has_the_name_of_its_photo(photo: str, twin: str) -> None:
    others = ["other.jpg", "rgb/8.jpg", "image/1.png"]
    assert auxiliary_files([photo, twin, *others]) == {twin: photo}
    assert auxiliary_files([twin, *others]) == {}
    assert is_mask(twin) == ("mask" in twin.lower() and "masked" not in twin)


@pytest.mark.parametrize(
    "names",
    [
        ("a.jpg", "a2.jpg", "a_2.jpg", "a copy.jpg", "unmasked.jpg", "depth.jpg", "a_maskarade.jpg", "a.png"),
        ("mask_on/1.jpg", "mask_off/1.jpg"),  # nothing that they could belong to
        ("depth/1.jpg", "mask/1.jpg"),
        ("rgb/1305031102.175304.png", "depth/1305031102.160407.png"),  # TUM: of no photo by name
        ("normal_light/1.jpg", "flash/1.jpg"),
        ("normal_light/1.png", "flash/1.png"),
        ("wide/1.jpg", "normal/1.jpg", "tele/1.jpg", "wide/2.heic", "normal/2.HEIC"),
        ("IMG_1.jpg", "IMG_1_normal.jpg", "IMG_1_bright.jpg"),
        ("surface/1.jpg", "depth_5m/1.jpg", "Depth-7.5-metres/1.JPG", "depth10ft/1.heic", "1.jpg"),
        ("front/1.jpg", "label/1.jpg", "confirmed/1.png", "instanced/1.png"),
        ("left/1.jpg", "right/1.jpg", "maskenball/1.jpg", "a/left/1.jpg", "b/mask/2.jpg"),
    ],
)
def test_what_may_be_a_photo_of_its_own_stays(names: tuple[str, ...]) -> None:
    assert auxiliary_files(names) == {}


colours, maps = ["a", "0", "00", "image", "a.color"], ["a_depth", "a_mask_depth", "a_normal", "b_mask"]
parts = st.sampled_from([*colours, *maps, "depth", "mask", "normal", "conf", "label"])
endings = st.sampled_from([".png", ".jpg"])
names_of_files = st.lists(
    st.builds(lambda some, kind: "/".join(some) + kind, st.lists(parts, min_size=1, max_size=3), endings), unique=True
)


@given(names_of_files)
def test_every_twin_leads_to_a_photo_that_stays(names: list[str]) -> None:
    found = auxiliary_files(names)
    assert set(found) <= set(names) >= set(found.values()) - {ALL_PHOTOS}
    for name in found:
        for _ in names:
            name = found.get(name, name)
        assert name not in found
    assert len(found) < max(1, len(names))


@pytest.mark.parametrize("name", ["mask.png", "Masks.PNG", "camera_mask.png"])
def test_one_mask_of_all_photos_is_no_photo(name: str) -> None:
    assert auxiliary_files(["a.jpg", "b.jpg", name]) == {name: ALL_PHOTOS}
    assert auxiliary_files([name]) == {}


def test_a_map_belongs_to_a_photo() -> None:
    maps = [f"{folder}/1.png" for folder in ("conf", "depth", "instance", "label", "normal", "semantics")]
    assert auxiliary_files([*maps, "rgb/1.jpg"]) == dict.fromkeys(maps, "rgb/1.jpg")
    assert auxiliary_files([*maps[:3], "label/1.jpg"]) == dict.fromkeys(maps[:3], "label/1.jpg")
    assert auxiliary_files(maps) == {}


def test_sources_list_photos_without_their_twins(tmp_path: Path) -> None:
    touch(tmp_path, "image/000000.png", "image/000001.png", "mask/000.png", "mask/001.png", "mask/002.png")
    source = find_source(tmp_path)
    assert [source.name(file) for file in source.files] == ["image/000000.png", "image/000001.png", "mask/002.png"]
    assert source.excluded == {"mask/000.png": "image/000000.png", "mask/001.png": "image/000001.png"}


def put(file: Path, seed: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)).save(file)


def test_unused_files_are_told_and_used_when_asked(tmp_path: Path, progress: Any) -> None:
    for index in range(5):
        put(tmp_path / f"in/image/{index}.png", index)
        mask = np.full((24, 32), 255, np.uint8)
        mask[:, :8] = 0
        (tmp_path / "in/mask").mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / f"in/mask/{index}.png")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [photo.name for photo in read_photos(tmp_path / "out")] == [f"image/{index}.png" for index in range(5)]
    assert progress.codes == ["ingest.excluded", "ingest.mask-elsewhere"]
    named = "mask/0.png (of image/0.png), mask/1.png (of image/1.png), mask/2.png (of image/2.png) and 2 more"
    assert progress.names("ingest.excluded", "5 files", named)
    assert progress.names("ingest.mask-elsewhere", "mask/0.png", "masks/image/0.png")
    (tmp_path / "in/masks/image").mkdir(parents=True)
    shutil.move(tmp_path / "in/mask/0.png", tmp_path / "in/masks/image/0.png")
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "again", progress)
    assert [photo.used_share for photo in read_photos(tmp_path / "again")] == [0.75, 1, 1, 1, 1]


def put_depth(file: Path, seed: int, kind: type) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    depth = np.random.default_rng(seed).integers(0, 60000, (24, 32))
    Image.fromarray((depth / 60000 if kind is np.float32 else depth).astype(kind)).save(file)


@pytest.mark.parametrize(
    ("photo", "depth", "kind"),
    [
        ("frame00000{}.png", "deep00000{}.png", np.uint16),  # side by side, as Replica has it
        ("rgb/rgb_{}.png", "depth/depth_{}.png", np.uint16),
        ("rgb/1.{}1.png", "depth/1.{}2.png", np.uint16),  # time stamps of two sensors, as TUM has them
        ("a/{}.png", "lowres_depth/{}.tif", np.uint16),  # ARKitScenes
        ("a/{}.png", "b/{}.tif", np.float32),
    ],
)
def test_depth_maps_are_told_by_their_values(photo: str, depth: str, kind: type, tmp_path: Path, progress: Any) -> None:
    for index in range(4):
        put_depth(tmp_path / "in" / depth.format(index), 9 + index, kind)
        put(tmp_path / "in" / photo.format(index), index)
    ingest.run(Config(photos=tmp_path / "in"), {}, tmp_path / "out", progress)
    assert [one.name for one in read_photos(tmp_path / "out")] == [photo.format(index) for index in range(4)]
    named = [depth.format(index) for index in range(4)]
    assert progress.codes == ["ingest.depth-maps"]
    assert progress.names("ingest.depth-maps", "4 files", f"{named[0]}, {named[1]}, {named[2]} and 1 more")


def kinds(deep: int, grey: int, colour: int) -> dict[str, Stored]:
    found: dict[str, Stored] = {}
    for index in range(deep + grey + colour):
        found[str(index)] = "deep grey" if index < deep else "grey" if index < deep + grey else "colour"
    return found


@pytest.mark.parametrize(("deep", "grey", "colour", "aside"), [
    (10, 0, 10, 10), (10, 0, 9, 10), (3, 10, 10, 3), (10, 0, 8, 0), (10, 10, 8, 0), (10, 10, 0, 0), (0, 5, 5, 0),
])  # fmt: skip
def test_deep_grey_photos_count_among_fewer_in_colour(deep: int, grey: int, colour: int, aside: int) -> None:
    assert depth_maps(kinds(deep, grey, colour)) == {str(index) for index in range(aside)}


@pytest.mark.parametrize(("photos", "masks"), [("images", "mask"), ("frames", "masks"), ("frames", "mask")])
def test_masks_beside_photos_that_are_not_used_are_named(
    photos: str, masks: str, tmp_path: Path, progress: Any
) -> None:
    folder, unused = tmp_path / "in" / photos, tmp_path / "in" / masks
    for index in range(2):
        put(folder / f"{index}.png", index)
    touch(unused, "notes.txt", "of another.png")
    ingest.run(Config(photos=folder), {}, tmp_path / "1", progress)
    assert progress.notes == []
    Image.fromarray(np.eye(24, 32, dtype=np.uint8) * 255).save(unused / "0.png.png")
    ingest.run(Config(photos=folder), {}, tmp_path / "2", progress)
    assert progress.codes == ["ingest.unused-masks"]
    assert progress.names("ingest.unused-masks", unused, folder / "masks")
    unused.rename(folder / "masks")
    ingest.run(Config(photos=folder), {}, tmp_path / "3", progress)
    assert progress.codes.count("ingest.unused-masks") == 1 and read_photos(tmp_path / "3")[0].mask is not None


def test_cameras_beside_photos_are_named_with_their_option(tmp_path: Path, progress: Any) -> None:
    scene = tmp_path / "my scene"
    for index in range(2):
        put(scene / f"images/{index}.png", index)
    frames = '{"file_path": "images/0.png", "transform_matrix": []}, {"file_path": "x", "transform_matrix": []}'
    (scene / "transforms.json").write_text(f'{{"frames": [{frames}]}}')
    for place, folder in product(("transforms.json", "sparse/0"), ("", "images")):
        if place == "sparse/0":
            touch(scene / place, "cameras.bin", "images.bin", "points3D.bin")
        progress.clear()
        ingest.run(Config(photos=scene / folder), {}, tmp_path / "out" / place / folder, progress)
        assert progress.codes == ["ingest.unused-cameras"]
        assert progress.names("ingest.unused-cameras", f"--cameras '{scene / place}'")
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


@pytest.mark.parametrize(
    ("photo", "mask"),
    [("ä.jpg", unicodedata.normalize("NFD", "ä.png")), ("a.jpg", "a.PNG"), ("left/a.jpg", "left/a.jpg.png")],
)
def test_unused_masks_are_told_with_the_names_needed(photo: str, mask: str, tmp_path: Path) -> None:
    touch(tmp_path, f"frames/{photo}", f"masks/{mask}", "masks/another.png")
    assert unused_masks(find_source(tmp_path / "frames")) == tmp_path / "masks"
    assert not unused_masks(find_source(touch(tmp_path, "other/b.jpg") / "other"))
