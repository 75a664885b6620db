"""What PHOTOS may be, and the words for what it may not be."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from stages.contract import StageError
from stages.ingest.auxiliary_files import pair_masks
from stages.ingest.sources import (
    Source,
    find_source,
    is_gone,
    mask_beside,
    photos_beside,
    photos_without_frame,
    unused_cameras,
    unused_masks,
)
from stages.ingest.sources.camera_files import camera_files
from tests.refusals import refused


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def transforms(path: Path, *file_paths: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = [{"file_path": file_path, "transform_matrix": []} for file_path in file_paths]
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return path


def names(source: Source) -> list[str]:
    return [source.name(file) for file in source.files]


def refusal(photos: Path, cameras: Path | None = None) -> StageError:
    with pytest.raises(StageError) as caught:
        find_source(photos, cameras)
    return caught.value


def test_importing_is_cheap() -> None:
    heavy = "{'numpy', 'PIL', 'cv2', 'torch', 'pycolmap'}"
    code = f"import sys, stages.ingest.sources; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_folder_is_listed_recursively_in_order_of_name(tmp_path: Path) -> None:
    touch(tmp_path, "b.jpg", "a.JPG", "sub/c.heic", "sub/deeper/d", "Z.png")
    source = find_source(tmp_path)
    assert (source.kind, source.root, source.cameras) == ("photos", tmp_path, None)
    assert names(source) == ["Z.png", "a.JPG", "b.jpg", "sub/c.heic", "sub/deeper/d"]


def test_what_is_no_photo_is_skipped(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", ".hidden.jpg", "._a.jpg", ".git/x.jpg", "masks/a.png", "notes.txt", "clip.MOV", "a.XMP")
    touch(tmp_path, "photos.nerf/run.json", "photos.nerf/ingest/a.jpg", "sub/masks/a.png")
    assert names(find_source(tmp_path)) == ["a.jpg"]


def test_images_inside_is_the_root(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images_2/a.jpg", "thumb.png")
    transforms(tmp_path / "transforms.json", "images/a.jpg")
    source = find_source(tmp_path)
    assert (source.kind, source.root, names(source)) == ("photos", tmp_path / "images", ["a.jpg"])


def sizes(root: Path, **folders: int) -> None:
    """Photos a, b of so many pixels a side in each folder."""
    for folder, side in folders.items():
        (root / folder).mkdir(parents=True)
        for name in ("a.png", "b.png"):
            Image.new("RGB", (side, side)).save(root / folder / name)


@pytest.mark.parametrize(
    ("folders", "root", "found"),
    [
        ({"images_2": 64, "images_4": 32, "images_8": 16}, "images_2", ["a.png", "b.png"]),
        ({"images_8": 32, "images_16": 16}, "images_8", ["a.png", "b.png"]),
        ({"images_4": 32}, "images_4", ["a.png", "b.png"]),
        (
            {"images_1": 64, "images_2": 64},
            ".",
            ["images_1/a.png", "images_1/b.png", "images_2/a.png", "images_2/b.png"],
        ),
        ({"images_2": 64, "images_4": 32, "more": 64}, ".", None),
    ],
    ids=["without images", "by number", "one", "two cameras", "others beside"],
)
def test_of_reduced_folders_the_largest_is_the_root(
    folders: dict[str, int], root: str, found: list[str] | None, tmp_path: Path
) -> None:
    sizes(tmp_path, **folders)
    source = find_source(tmp_path)
    assert source.root == tmp_path / root
    assert names(source) == (found or sorted(f"{folder}/{name}" for folder in folders for name in ("a.png", "b.png")))


def test_cameras_of_full_photos_serve_reduced_ones(tmp_path: Path) -> None:
    sizes(tmp_path, images_2=64, images_4=32)
    cameras = transforms(tmp_path / "transforms.json", "images/a.png", "images/b.png")
    source = find_source(tmp_path, cameras)
    assert (source.root, names(source)) == (tmp_path / "images_2", ["a.png", "b.png"])
    assert unused_cameras(find_source(tmp_path)) == cameras


def test_images_inside_without_photos_is_not_the_root(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "images/.hidden.jpg", "images/notes.txt")
    source = find_source(tmp_path)
    assert (source.root, names(source), photos_beside(source, tmp_path)) == (tmp_path, ["a.jpg"], 0)


def test_photos_beside_images_are_counted(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images_4/a.jpg", "b.JPG", ".c.jpg", "database.db", "unknown")
    assert photos_beside(find_source(tmp_path), tmp_path) == 1
    assert photos_beside(find_source(tmp_path / "images"), tmp_path / "images") == 0


def test_a_transforms_file_names_its_photos(tmp_path: Path) -> None:
    touch(tmp_path, "images/b.jpg", "images/a.jpg", "images/unused.jpg", "more/c.png")
    cameras = transforms(tmp_path / "transforms.json", "images/b.jpg", "./images/a", "more/c", "images/gone.jpg")
    source = find_source(cameras)
    assert (source.kind, source.root, source.cameras) == ("transforms", tmp_path, cameras)
    assert names(source) == ["images/a.jpg", "images/b.jpg", "images/gone.jpg", "more/c.png"]
    assert source.frames["./images/a"] == "images/a.jpg"
    assert source.frames["more/c"] == "more/c.png"


def test_blender_scenes_keep_train_and_test(tmp_path: Path) -> None:
    touch(tmp_path, "train/r_0.png", "test/r_0.png", "test/r_0_depth.png", "val/r_0.png")
    for split in ("train", "test", "val"):
        transforms(tmp_path / f"transforms_{split}.json", f"./{split}/r_0")
    source = find_source(tmp_path)
    assert (source.kind, source.root, source.cameras) == ("blender", tmp_path, tmp_path)
    assert source.frames == {"./train/r_0": "train/r_0.png", "./test/r_0": "test/r_0.png"}
    assert names(source) == ["test/r_0.png", "train/r_0.png"]
    (tmp_path / "test/r_0.png").unlink()
    assert names(find_source(tmp_path)) == ["train/r_0.png", "val/r_0.png"]
    (tmp_path / "transforms_test.json").unlink()
    assert names(find_source(tmp_path)) == ["train/r_0.png", "val/r_0.png"]


@pytest.mark.parametrize("place", [".", "elsewhere"])
@pytest.mark.parametrize("given", [".", "images"])
def test_a_photo_folder_with_a_transforms_file(tmp_path: Path, place: str, given: str) -> None:
    touch(tmp_path, "set/images/a.jpg", "set/images/b.jpg")
    cameras = transforms(tmp_path / "set" / place / "cameras.json", "images/a.jpg")
    source = find_source(tmp_path / "set" / given, cameras)
    assert (source.kind, source.root, source.cameras) == ("transforms", tmp_path / "set/images", cameras)
    assert names(source) == ["a.jpg"]
    assert source.frames == {"images/a.jpg": "a.jpg"}


def test_frames_of_another_camera_folder_are_not_taken_for_ours(tmp_path: Path) -> None:
    touch(tmp_path, "left/0.jpg", "right/0.jpg")
    cameras = transforms(tmp_path / "transforms.json", "left/0.jpg", "right/0.jpg")
    error = refusal(tmp_path / "left", cameras)
    assert error.code == "ingest.photo-outside" and f"{tmp_path}/right/0.jpg" in error.what


COLMAP = [f"{part}.bin" for part in ("cameras", "images", "points3D")]


@pytest.mark.parametrize("given", ["model", "model/sparse", "model/sparse/0"])
@pytest.mark.parametrize("extension", [".bin", ".txt"])
def test_a_photo_folder_with_a_colmap_model(tmp_path: Path, given: str, extension: str) -> None:
    touch(tmp_path, "photos/a.jpg")
    touch(tmp_path / "model/sparse/0", *(name.replace(".bin", extension) for name in COLMAP))
    source = find_source(tmp_path / "photos", tmp_path / given)
    assert (source.kind, source.cameras) == ("colmap", tmp_path / "model/sparse/0")
    assert names(source) == ["a.jpg"]


def test_our_models_account_names_its_cameras(tmp_path: Path) -> None:
    sparse = touch(tmp_path, "registration.json", *(f"sparse/{name}" for name in COLMAP)) / "sparse"
    assert [file.name for file in camera_files(sparse)] == [*COLMAP, "registration.json"]
    other = sparse.rename(tmp_path / "0")
    assert [file.name for file in camera_files(other)] == COLMAP


def test_of_several_colmap_models_the_largest_that_fits_is_recommended(tmp_path: Path) -> None:
    touch(
        tmp_path, "photos/a.jpg", "photos/b.jpg", *(f"m/sparse/{index}/{name}" for index in (0, 1) for name in COLMAP)
    )
    touch(tmp_path, *(f"m/sparse/2/{name}.txt" for name in ("cameras", "points3D")))
    poses = [f"{i} 1 0 0 0 0 0 0 1 {name}\n" for i, name in enumerate(("b.jpg", "other.jpg", "another.jpg"), 1)]
    (tmp_path / "m/sparse/2/images.txt").write_text("\n".join(poses))
    (touch(tmp_path, "m/sparse/3/cameras.txt") / "m/sparse/3/images.txt").write_text(
        "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 b.jpg\n"
    )
    counts = "0 (sparse/0), 0 (sparse/1), 1 (sparse/2), 2 (sparse/3)"
    with refused("ingest.several-colmap-models", 4, f"{tmp_path}/m", counts, f"--cameras {tmp_path}/m/sparse/3"):
        find_source(tmp_path / "photos", tmp_path / "m")


def test_our_export_finds_photos_by_their_names(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "ä.jpg").write_bytes(b"")
    frame = {"file_path": "images/a-1.jpg", "photo": "ä.jpg", "transform_matrix": []}
    cameras = tmp_path / "transforms.json"
    cameras.write_text(json.dumps({"frames": [frame]}))
    source = find_source(photos, cameras)
    assert (source.files, source.frames) == ((photos / "ä.jpg",), {"images/a-1.jpg": "ä.jpg"})


@pytest.mark.parametrize("linked", [True, False])
def test_a_removed_photo_is_missing_from_our_export(tmp_path: Path, linked: bool) -> None:
    touch(tmp_path, "photos/a.jpg", "kept/a.jpg", "kept/b.jpg", "output/x")
    if linked:
        (tmp_path / "output/images").symlink_to(tmp_path / "kept")
    else:
        shutil.copytree(tmp_path / "kept", tmp_path / "output/images")
    frames = [{"file_path": f"images/{name}", "photo": name, "transform_matrix": []} for name in ("a.jpg", "b.jpg")]
    cameras = tmp_path / "output/transforms.json"
    cameras.write_text(json.dumps({"frames": frames}))
    source = find_source(tmp_path / "photos", cameras)
    assert names(source) == list(source.frames.values()) == ["a.jpg", "b.jpg"]
    assert [file.is_file() for file in source.files] == [True, False]


def test_a_transforms_file_that_was_written_on_windows(tmp_path: Path) -> None:
    touch(tmp_path, "train/0001.png", "train\\0002.png", "train/0002.png")
    written = ["train\\0001", ".\\train\\0002.png", "train\\0002", "gone\\0.png"]
    cameras = transforms(tmp_path / "transforms.json", *written)
    cameras.write_bytes(b"\xef\xbb\xbf" + cameras.read_bytes())
    photos = ["train/0001.png", "train/0002.png", "train\\0002.png", "gone\\0.png"]
    assert list(find_source(cameras).frames.values()) == photos
    cameras.write_text(cameras.read_text("utf-8-sig"), "utf-16")  # as PowerShell redirects
    assert list(find_source(cameras).frames.values()) == photos
    with refused("ingest.outside-folder", "'../secret.jpg'", tmp_path):
        find_source(transforms(tmp_path / "transforms.json", "..\\secret.jpg"))


@pytest.mark.parametrize("file_path", ["../secret.jpg", "/etc/passwd", "images/../../secret", "link/secret.jpg", "a\0"])
def test_frames_may_not_leave_their_folder(tmp_path: Path, file_path: str) -> None:
    touch(tmp_path, "secret.jpg", "scene/images/a.jpg")
    (tmp_path / "scene/link").symlink_to(tmp_path)
    cameras = transforms(tmp_path / "scene/transforms.json", "images/a.jpg", file_path)
    with refused("ingest.outside-folder", repr(file_path), "--cameras FILE"):
        find_source(cameras)
    with refused("ingest.outside-folder", repr(file_path), f"{tmp_path}/scene/images"):
        find_source(tmp_path / "scene", cameras)


@pytest.mark.parametrize(
    ("content", "code", "named"),
    [
        ("{", "not-json", ()),
        ("[1]", "without-frames", ("a list itself",)),
        ('{"frames": {"0": {}}}', "without-frames", ("an object",)),
        ('{"frames": null}', "without-frames", ("None",)),
        ("", "not-json", ("empty",)),
        ("version https://git-lfs.github.com/spec/v1\noid", "not-json", ("git lfs pull",)),
        ("\n<!DOCTYPE html><html>", "not-json", ("web page",)),
        ('{"frames": [],\n}', "not-json", ("line 2", "comma")),
        ('{"name": "M\udcfcller"}', "not-json", ("UTF-8", "byte 11", "0xfc")),
        ('{"frames": []}', "empty", ()),
        ('{"frames": [{"file_path": "a.jpg"}]}', "incomplete-frame", ("frame 0", "transform_matrix", "file_path")),
        ('{"frames": [{"path": 1, "c2w": 2}]}', "incomplete-frame", ("frame 0", "file_path", "path, c2w")),
        ('{"frames": [{"file_path": 3, "transform_matrix": []}]}', "incomplete-frame", ("frame 0", "3")),
        ('{"frames": ["a.jpg"]}', "incomplete-frame", ("frame 0", "'a.jpg'")),
        ("[" * 100_000, "not-json", ()),
    ],
)
def test_a_transforms_file_that_is_none(tmp_path: Path, content: str, code: str, named: tuple[str, ...]) -> None:
    (tmp_path / "transforms.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    with refused(f"io.transforms-{code}", *named):
        find_source(tmp_path / "transforms.json")


def test_a_transforms_file_without_its_photos(tmp_path: Path) -> None:
    touch(tmp_path, "photos/DSC_1.jpg", "photos/DSC_2.jpg")
    cameras = transforms(tmp_path / "transforms.json", "images/frame_1.jpg", "images/frame_2.jpg")
    with refused("ingest.cameras-of-other-photos", 2, "images/frame_1.jpg", f"{tmp_path}/photos", "DSC_1.jpg"):
        find_source(tmp_path / "photos", cameras)


def test_photos_that_no_frame_names_are_listed(tmp_path: Path) -> None:
    others = ["images/c.JPG", "images/sub/d.png", "images/.e.jpg", "images/f.txt", "images/b_mask.png", "thumbs/a.jpg"]
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "images/dynamic_mask_a.png", "images/a_depth.png", *others)
    source = find_source(transforms(tmp_path / "transforms.json", "images/a.jpg", "images/b.jpg", "images/gone.jpg"))
    assert photos_without_frame(source) == ["images/c.JPG"]
    assert photos_without_frame(find_source(tmp_path)) == []


def test_what_systems_keep_is_no_photo(tmp_path: Path) -> None:
    kept = [
        "@eaDir/a.jpg/SYNOPHOTO_THUMB_M.jpg",
        "$RECYCLE.BIN/$R1.jpg",
        "__MACOSX/._a.jpg",
        "#recycle/b.jpg",
        "lost+found/1",
    ]
    touch(tmp_path, "a.jpg", "sub/b.jpg", "sub/@eaDir/b.jpg", *kept)
    assert names(find_source(tmp_path)) == ["a.jpg", "sub/b.jpg"]


def test_a_linked_folder_in_an_empty_one_is_named(tmp_path: Path) -> None:
    touch(tmp_path, "disk/a.jpg", "set/.hidden")
    (tmp_path / "set/photos").symlink_to(tmp_path / "disk")
    error = refusal(tmp_path / "set")
    assert error.code == "ingest.empty-folder" and "photos" in error.why
    assert error.hint.endswith(f"pipeline run {tmp_path}/disk")


def test_words_for_what_cannot_be_used(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "videos/clip.mp4",
        "videos/a/b.MOV",
        "texts/a.txt",
        "texts/b.md",
        "done.nerf/run.json",
        "one/a.JPG",
        "odd/a.xyz",
    )
    (tmp_path / "empty").mkdir()
    cases = {
        "nowhere": ("no-such-photos", "nowhere"),
        "empty": ("empty-folder", "empty"),
        "texts": ("no-photos", f"{tmp_path}/texts", "2 files", ".md, .txt"),
        "videos": ("several-videos", "2 videos", "a/b.MOV, clip.mp4", f"pipeline run {tmp_path}/videos/a/b.MOV"),
        "one/a.JPG": ("single-image", "a.JPG"),
        "odd/a.xyz": ("unknown-input", "a.xyz"),
        "done.nerf": ("workspace-given", "done.nerf", f"pipeline resume {tmp_path}/done.nerf"),
    }
    for given, (code, *named) in cases.items():
        with refused(f"ingest.{code}", *named):
            find_source(tmp_path / given)


def test_words_for_cameras_that_cannot_be_used(tmp_path: Path) -> None:
    touch(tmp_path, "photos/a.jpg")
    cameras = transforms(tmp_path / "transforms.json", "photos/a.jpg")
    assert refusal(tmp_path / "photos", tmp_path / "no").code == "ingest.no-such-cameras"
    assert refusal(tmp_path / "photos", tmp_path / "photos").code == "ingest.no-colmap-model"
    assert refusal(cameras, cameras).code == "ingest.transforms-and-cameras"
    touch(tmp_path, "images.bin", "cameras.txt", "cams.csv")
    for name in ("images.bin", "cameras.txt"):
        with refused("ingest.unknown-cameras", name, f"--cameras {tmp_path}"):
            find_source(tmp_path / "photos", tmp_path / name)
    for name, what, hint in (
        ("cams.csv", "RealityScan", "ns-process-data realitycapture"),
        ("cams.xml", "Metashape", "ns-process-data metashape"),
        ("database.db", "COLMAP's database", "sparse/0"),
        ("bundle.out", "Bundler", "--cameras"),
        ("cams.xyz", "unknown", "--cameras"),
    ):
        with refused("ingest.unknown-cameras", name, what, hint):
            find_source(tmp_path / "photos", touch(tmp_path, name) / name)


def test_files_of_a_colmap_model_may_be_in_capitals(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "m/sparse/Cameras.txt", "m/sparse/IMAGES.TXT", "m/sparse/points3d.txt")
    source = find_source(tmp_path / "images", tmp_path / "m")
    assert source.cameras == tmp_path / "m/sparse"
    assert [file.name for file in camera_files(tmp_path / "m/sparse")] == ["Cameras.txt", "IMAGES.TXT", "points3d.txt"]


def test_what_is_missing_of_a_colmap_model_is_named(tmp_path: Path) -> None:
    touch(tmp_path, "photos/a.jpg", "db/database.db", "half/sparse/0/cameras.txt", "half/sparse/0/rigs.txt", "m/a.ply")
    for folder, there in (
        ("db", "database.db"),
        ("half/sparse/0", " cameras.txt"),
        ("half", "sparse/0/cameras.txt"),
        ("m", "a.ply"),
    ):
        with refused("ingest.no-colmap-model", tmp_path / folder, there):
            find_source(tmp_path / "photos", tmp_path / folder)


@pytest.mark.parametrize("place", ["colmap/sparse/0", "dense/0/sparse", "a/b/c/d"])
def test_a_colmap_model_may_lie_deeper(tmp_path: Path, place: str) -> None:
    touch(tmp_path, "images/a.jpg", *(f"{place}/{name}" for name in COLMAP), "old.nerf/run.json", ".git/x")
    touch(tmp_path, *(f"{hidden}/sfm/{name}" for hidden in ("old.nerf", ".git") for name in COLMAP))
    assert find_source(tmp_path / "images", tmp_path).cameras == tmp_path / place
    unused = unused_cameras(find_source(tmp_path))
    assert unused == (tmp_path / place if place[0] != "a" else None)
    touch(tmp_path, *(f"sparse/0/{name}" for name in COLMAP))
    assert find_source(tmp_path / "images", tmp_path).cameras == tmp_path / "sparse/0"


@pytest.mark.parametrize(("name", "kind"), [("transforms.json", "transforms"), ("transforms_train.json", "blender")])
def test_cameras_may_be_the_folder_of_a_transforms_file(tmp_path: Path, name: str, kind: str) -> None:
    touch(tmp_path, "ds/images/a.jpg", "ds/images/b.jpg")
    given = transforms(tmp_path / "ds" / name, "images/a.jpg")
    source = find_source(tmp_path / "ds", tmp_path / "ds")
    assert (source.kind, source.cameras) == (kind, given if kind == "transforms" else tmp_path / "ds")
    assert names(source) == ["a.jpg"]
    for other in ("transforms.json", "transforms_train.json"):
        transforms(tmp_path / "ds" / other, "images/a.jpg")
    assert refusal(tmp_path / "ds", tmp_path / "ds").code == "ingest.several-cameras"
    touch(tmp_path / "ds/sparse/0", *COLMAP)
    assert find_source(tmp_path / "ds", tmp_path / "ds").cameras == tmp_path / "ds/sparse/0"


@pytest.mark.parametrize("given", ["holiday/clip.MP4", "holiday"])
def test_a_video_or_a_folder_with_nothing_else(tmp_path: Path, given: str) -> None:
    touch(tmp_path, "holiday/clip.MP4", "holiday/notes.txt", "holiday/masks/a.png")
    source = find_source(tmp_path / given)
    assert (source.kind, source.root, names(source)) == ("video", tmp_path / "holiday", ["clip.MP4"])
    assert (source.cameras, source.masks) == (None, ())
    with refused("ingest.cameras-of-video", "clip.MP4"):
        find_source(tmp_path / given, transforms(tmp_path / "t.json", "a.jpg").parent)


@pytest.mark.parametrize(
    ("photos", "masks"),
    [
        ("images", "Masks"),
        ("images_4", "masks_4"),
        ("images_4", "masks"),
        ("images_4", "MASKS_4"),
        ("images", "images/Masks"),
    ],
)
def test_folders_of_masks_by_other_names(tmp_path: Path, photos: str, masks: str) -> None:
    touch(tmp_path, f"{photos}/a.jpg", f"{masks}/a.png")
    assert find_source(tmp_path / photos).masks == (("a.png", tmp_path / masks / "a.png"),)


def test_one_mask_beside_photos_is_found(tmp_path: Path) -> None:
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "Mask.png", "c.jpg")
    source = find_source(tmp_path)
    assert mask_beside(source, tmp_path) == tmp_path / "Mask.png" and photos_beside(source, tmp_path) == 1
    assert mask_beside(find_source(tmp_path / "images"), tmp_path / "images") is None


def test_masks_of_reduced_photos_go_before_others(tmp_path: Path) -> None:
    touch(tmp_path, "images_4/a.jpg", "masks/a.png", "masks_4/a.png", "masks_8/a.png")
    source = find_source(tmp_path / "images_4")
    assert source.masks == (("a.png", tmp_path / "masks_4/a.png"),)


@pytest.mark.parametrize("folder", ["mask_2", "object_masks", "Segmentation", "seg", "alpha"])
def test_folders_beside_photos_that_may_be_of_masks(tmp_path: Path, folder: str) -> None:
    source = find_source(touch(tmp_path, "images/a.jpg", f"{folder}/a.png", "scans/a.png", "depth/a.png"))
    assert source.masks == () and unused_masks(source) == tmp_path / folder


def test_masks_are_listed_by_their_names_without_folder(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg", "left/b.jpg", "masks/a.png", "masks/left/b.jpg.png", "left/masks/b.png", "masks/.x.png")
    touch(tmp_path, "empty/masks/z.png")
    source = find_source(tmp_path)
    assert names(source) == ["a.jpg", "left/b.jpg"]
    assert [(name, file.relative_to(tmp_path).as_posix()) for name, file in source.masks] == [
        ("a.png", "masks/a.png"),
        ("left/b.jpg.png", "masks/left/b.jpg.png"),
        ("left/b.png", "left/masks/b.png"),
    ]


@pytest.mark.parametrize("given", [".", "images"])
def test_masks_may_lie_beside_an_images_folder(tmp_path: Path, given: str) -> None:
    touch(tmp_path, "images/a.jpg", "images/sub/b.jpg", "masks/a.png", "masks/sub/b.png")
    assert [name for name, _ in find_source(tmp_path / given).masks] == ["a.png", "sub/b.png"]
    cameras = transforms(tmp_path / "transforms.json", "images/a.jpg")
    assert {"a.png", "sub/b.png"} <= {name for name, _ in find_source(cameras).masks}


@pytest.mark.parametrize("given", [".", "images"])
def test_a_transforms_file_may_name_masks_which_go_before_others(tmp_path: Path, given: str) -> None:
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "masks/all.png", "masks/a.png")
    masks = {"images/a.jpg": "masks/all.png", "images/b.jpg": "./masks/all", "gone.jpg": "gone.png", "free.jpg": None}
    frames = [{"file_path": name, "mask_path": mask, "transform_matrix": []} for name, mask in masks.items()]
    cameras = tmp_path / "transforms.json"
    cameras.write_text(json.dumps({"frames": frames}))
    source = find_source(cameras) if given == "." else find_source(tmp_path / given, cameras)
    paired, strays = pair_masks(names(source), source.masks)
    assert {name.removeprefix("images/"): mask for name, mask in paired.items()} == {
        "a.jpg": tmp_path / "masks/all.png", "b.jpg": tmp_path / "masks/all.png", "gone.jpg": source.root / "gone.png",
    }  # fmt: skip
    assert strays == [tmp_path / "masks/a.png"]


@pytest.mark.parametrize(
    ("mask", "code", "named"),
    [
        ("../m.png", "ingest.outside-folder", "'../m.png'"),
        ("/m.png", "ingest.outside-folder", "'/m.png'"),
        (3, "io.transforms-mask-path", "frame 0"),
        ("x" * 300, "io.transforms-file-path", "frame 0"),
    ],
)
def test_masks_may_not_leave_their_folder(mask: object, code: str, named: str, tmp_path: Path) -> None:
    frame = {"file_path": "a.jpg", "mask_path": mask, "transform_matrix": []}
    (touch(tmp_path, "a.jpg") / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with refused(code, named):
        find_source(tmp_path / "transforms.json")


@pytest.mark.parametrize("folder", ["images_4", "input", "photos"])
def test_masks_may_lie_beside_other_folders_of_photos(tmp_path: Path, folder: str) -> None:
    touch(tmp_path, f"{folder}/a.jpg", "masks/a.png", "other/a.jpg")
    assert [name for name, _ in find_source(tmp_path / folder).masks] == ["a.png"]
    assert [name for name, _ in find_source(tmp_path).masks] == ["a.png", f"{folder}/a.png"]
    assert find_source(tmp_path / "other").masks == ()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_without_read_permission(tmp_path: Path) -> None:
    touch(tmp_path, "a/b.jpg")
    (tmp_path / "a").chmod(0)
    try:
        assert refusal(tmp_path).code == "ingest.cannot-read"
    finally:
        (tmp_path / "a").chmod(0o755)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_places_that_nobody_gave_need_not_be_readable(tmp_path: Path) -> None:
    touch(tmp_path, "closed/images/a.jpg", "closed/my_masks/a.png")
    closed = tmp_path / "closed"
    for hidden in (closed / "my_masks", closed):
        hidden.chmod(0o311)
    try:
        source = find_source(closed / "images")
        assert names(source) == ["a.jpg"] and source.masks == () and unused_masks(source) is None
    finally:
        for hidden in (closed, closed / "my_masks"):
            hidden.chmod(0o755)


def test_dead_links_are_refused_by_name(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg")
    (tmp_path / "b.jpg").symlink_to("annex/b")
    assert names(find_source(tmp_path)) == ["a.jpg", "b.jpg"] and not is_gone(tmp_path)
    (tmp_path / "a.jpg").unlink()
    with refused("ingest.broken-links", tmp_path, "1 of"):
        find_source(tmp_path)
    assert is_gone(tmp_path)
    touch(tmp_path, "notes.txt")
    (tmp_path / "b.jpg").rename(tmp_path / "b.mp4")
    with refused("ingest.broken-links", tmp_path, "1 of"):
        find_source(tmp_path)


def test_a_dead_linked_folder_is_skipped(tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg")
    (tmp_path / "archive").symlink_to("drive")
    assert names(find_source(tmp_path)) == ["a.jpg"]


def test_a_folder_that_goes_while_it_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, "a/b.jpg")

    def enters(folder: Path) -> bool:
        shutil.rmtree(folder)
        return True

    monkeypatch.setattr("stages.ingest.listing.is_photo_folder", enters)
    with refused("ingest.cannot-read", tmp_path / "a"):
        find_source(tmp_path)


def test_a_name_that_is_not_unicode_can_be_written_down(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"caf\xe9.jpg")).write_bytes(b"x")
    assert names(find_source(tmp_path)) == ["caf\\xe9.jpg"]


@pytest.mark.parametrize(
    ("given", "kind", "count"),
    [("fox", "photos", 50), ("fox/transforms.json", "transforms", 50), ("lego_400", "blender", 125)],
)
def test_real_sets(shared_data: Path, given: str, kind: str, count: int) -> None:
    source = find_source(shared_data / given)
    assert (source.kind, len(source.files)) == (kind, count)
    assert all(file.is_file() for file in source.files)


@pytest.mark.parametrize(
    "name",
    ["cameras.xml", "registration.csv", "a.xmp", "bundle.out", "scene.abc", "scene.blend", "sfm.sfm", "cameras.npz"],
)
def test_cameras_in_forms_that_are_not_read_are_refused(name: str, tmp_path: Path) -> None:
    touch(tmp_path, "photos/a.jpg", name)
    with refused("ingest.unknown-cameras", name):
        find_source(tmp_path / "photos", tmp_path / name)


@pytest.mark.parametrize("given", ["keyframes", "keyframes/images", "keyframes/corrected_images"])
def test_a_polycam_folder_gives_its_photos_without_their_maps(given: str, tmp_path: Path) -> None:
    kinds = {"images": "jpg", "corrected_images": "jpg", "cameras": "json", "corrected_cameras": "json"}
    kinds |= {"depth": "png", "confidence": "png"}
    touch(tmp_path, "mesh_info.json", *(f"keyframes/{kind}/{i}.{kinds[kind]}" for kind in kinds for i in (11, 22)))
    source = find_source(tmp_path / given)
    assert (source.kind, names(source)) == ("photos", ["11.jpg", "22.jpg"])
    assert source.root.name == ("corrected_images" if "corrected" in given else "images")


def test_cameras_of_polycam_are_not_read(tmp_path: Path) -> None:
    cameras = touch(tmp_path, "images/11.jpg", "cameras/11.json") / "cameras"
    (cameras / "11.json").write_text(json.dumps({"fx": 50.0, "t_00": 1.0}))
    with refused("io.transforms-without-frames", "11.json"):
        find_source(tmp_path, cameras / "11.json")
    with refused("ingest.no-colmap-model", "cameras"):
        find_source(tmp_path, cameras)
