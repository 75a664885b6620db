"""Which file is whose mask, how it is made to fit, and what COLMAP and training get of it."""

import json
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from stages import ingest
from stages.ingest.auxiliary_files import pair_masks
from stages.ingest.decoding import DecodeError
from stages.ingest.masks import _same_shape, are_of_stored_pixels, read_mask, write_feature_masks
from stages.ingest.orientation import upright
from stages.ingest.sources import find_source
from stages.io.files import write_png
from stages.io.photos import Photo, read_photos
from stages.io.pixels import load_mask
from tests.stages.ingest.photo_files import exif_with
from tests.stages.ingest.test_ingest import mask_for, picture, put

WIDTH, HEIGHT = 48, 32


def ignoring(x: int, y: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Black right of x and below y."""
    mask = np.full((height, width), 255, np.uint8)
    mask[y:, x:] = 0
    return mask


def saved(folder: Path, pixels: np.ndarray, name: str = "m.png") -> Path:
    Image.fromarray(pixels).save(folder / name)
    return folder / name


def refused_as(code: str, file: Path, *values: str) -> bool:
    """Whether a mask is refused by this code, and the values are named."""
    with pytest.raises(DecodeError) as error:
        read_mask(file, WIDTH, HEIGHT, 1)
    return error.value.code == code and all(value in error.value.reason for value in (file.name, *values))


def test_masks_are_called_after_their_photos() -> None:
    names = ["a.jpg", "b.jpg", "left/a.jpg", "ö d.heic", "e.png", "images/f.jpg", "g.jpg"]
    files = ["a.png", "b.jpg.PNG", "left/a.jpg.png", "ö d.png", "e.png", "f.png", "x.png", "g.txt"]
    found, strays = pair_masks(names, [(file, Path("masks", file)) for file in files])
    assert found == {name: Path("masks", file) for name, file in zip(names, files[:6], strict=False)}
    assert strays == [Path("masks/x.png"), Path("masks/g.txt")]


def test_accents_of_masks_may_be_composed_in_another_way() -> None:
    apart = unicodedata.normalize("NFD", "ä")
    files = [("ä.png", Path("1")), (f"{apart}ö.jpg.png", Path("2")), (f"{apart}.png", Path("3"))]
    assert pair_masks([f"{apart}ö.jpg"], files)[0] == {f"{apart}ö.jpg": Path("2")}
    assert pair_masks(["äö.jpg"], files) == ({"äö.jpg": Path("2")}, [Path("1"), Path("3")])
    assert pair_masks(["ä.jpg", f"{apart}.jpg"], files)[0] == {"ä.jpg": Path("1"), f"{apart}.jpg": Path("3")}
    assert pair_masks(["\u00c5.jpg"], [("\u212b.png", Path("1")), ("A\u030a.png", Path("2"))])[0] == {}


def test_of_two_masks_of_one_photo_one_is_a_stray() -> None:
    found, strays = pair_masks(["a.jpg"], [("a.jpg.png", Path("1")), ("a.png", Path("2")), ("a.png", Path("3"))])
    assert (found, strays) == ({"a.jpg": Path("1")}, [Path("2"), Path("3")])


@pytest.mark.parametrize("kind", ["1", "L", "RGB", "RGBA", "P", "16"])
def test_black_is_ignored_whatever_the_kind_of_picture(kind: str, tmp_path: Path) -> None:
    mask = ignoring(20, 10)
    image = Image.fromarray(mask)
    if kind == "16":
        image = Image.fromarray(mask.astype(np.uint16) * 257)
    elif kind != "L":
        image = image.convert(kind)
    image.save(tmp_path / "m.png")
    found = read_mask(tmp_path / "m.png", WIDTH, HEIGHT, 1)
    assert np.array_equal(found.pixels, mask)
    assert (found.turned, found.resized) == (False, False)


@pytest.mark.parametrize("used", [1, 255])
def test_what_is_used_may_be_one_or_white(used: int, tmp_path: Path) -> None:
    mask = np.where(ignoring(10, 20) > 0, np.uint8(used), np.uint8(0))
    np.testing.assert_array_equal(read_mask(saved(tmp_path, mask), WIDTH, HEIGHT, 1).pixels, ignoring(10, 20))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("values", [(1, 1), (1, 2), (7, 100)])
def test_of_labels_all_but_zero_is_used(bits: int, values: tuple[int, int], tmp_path: Path) -> None:
    """As COLMAP and nerfstudio have it."""
    labels = np.where(np.arange(WIDTH) < 20, *values).astype(np.uint8 if bits == 8 else np.uint16)
    file = saved(tmp_path, np.where(ignoring(30, 20) > 0, labels, labels.dtype.type(0)))
    found = read_mask(file, WIDTH, HEIGHT, 1)
    np.testing.assert_array_equal(found.pixels, ignoring(30, 20))
    assert not found.grey


def test_what_compression_leaves_of_black_is_no_label(tmp_path: Path) -> None:
    file = tmp_path / "m.jpg"
    Image.fromarray(np.random.default_rng(0).integers(0, 9, (HEIGHT, WIDTH), np.uint8)).save(file)
    assert refused_as("ingest.mask-empty", file)


def test_a_picture_that_is_cut_out_masks_by_its_alpha(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    cut = read_mask(saved(tmp_path, np.dstack([picture, ignoring(20, 10)])), WIDTH, HEIGHT, 1)
    np.testing.assert_array_equal(cut.pixels, ignoring(20, 10))
    assert not cut.grey
    assert read_mask(saved(tmp_path, picture), WIDTH, HEIGHT, 1).grey
    assert not read_mask(saved(tmp_path, ignoring(20, 10)), WIDTH, HEIGHT, 1).grey


def test_masks_may_say_that_they_are(tmp_path: Path) -> None:
    strange = ["d_mask.png", "e_mask.png", "mask_e.png", "masks.png"]
    files = ["a_mask.png", "mask_b.png", "left/c.mask.jpg", "d.png", "dynamic_mask_f.png", *strange]
    named = [(name, tmp_path / name) for name in files]
    paired, strays = pair_masks(["a.jpg", "b.jpg", "left/c.jpg", "d.jpg", "e.jpg", "f.jpg"], named)
    of = {"a.jpg": "a_mask.png", "b.jpg": "mask_b.png", "left/c.jpg": "left/c.mask.jpg", "d.jpg": "d.png"}
    of["f.jpg"] = "dynamic_mask_f.png"
    assert paired == {photo: tmp_path / mask for photo, mask in of.items()}
    assert strays == [tmp_path / name for name in strange]


def test_masks_may_be_jpegs(tmp_path: Path) -> None:
    paired, strays = pair_masks(["a.jpg", "b.jpg"], [("a.jpg", tmp_path / "a.jpg"), ("b.jpg.JPG", tmp_path / "b.JPG")])
    assert paired == {"a.jpg": tmp_path / "a.jpg", "b.jpg": tmp_path / "b.JPG"} and strays == []
    paired, strays = pair_masks(["a.jpg"], [("a.jpg", tmp_path / "a.jpg"), ("a.png", tmp_path / "a.png")])
    assert paired == {"a.jpg": tmp_path / "a.png"} and strays == [tmp_path / "a.jpg"]


@pytest.mark.parametrize("white", [255, 100, 1])
def test_white_is_ignored_in_masks_of_instant_ngp(tmp_path: Path, white: int) -> None:
    mask = np.where(ignoring(10, 20) > 0, 0, white).astype(np.uint8)
    found = read_mask(saved(tmp_path, mask, "dynamic_mask_a.png"), WIDTH, HEIGHT, 1)
    np.testing.assert_array_equal(found.pixels, ignoring(10, 20))


def test_masks_may_be_called_in_capitals(tmp_path: Path) -> None:
    named = [(name, tmp_path / name) for name in ("A.JPG.PNG", "left/B.png", "C.png", "c.PNG", "D.png")]
    paired, strays = pair_masks(["a.jPg", "left/b.jpg", "c.jpg", "d.jpg", "D.JPG"], named)
    of = {"a.jPg": "A.JPG.PNG", "left/b.jpg": "left/B.png", "c.jpg": "c.PNG", "D.JPG": "D.png"}
    assert paired == {photo: tmp_path / mask for photo, mask in of.items()}
    assert strays == [tmp_path / "C.png"]


def test_what_losses_leave_of_black_ignores_nothing(tmp_path: Path) -> None:
    white = np.zeros((8 * HEIGHT, 8 * WIDTH), np.uint8)
    white[:80, 100:] = 255
    Image.fromarray(white).save(tmp_path / "dynamic_mask_a.jpg", quality=60)
    assert ((np.asarray(Image.open(tmp_path / "dynamic_mask_a.jpg")) > 0) != (white > 0)).any()
    found = read_mask(tmp_path / "dynamic_mask_a.jpg", 8 * WIDTH, 8 * HEIGHT, 1)
    np.testing.assert_array_equal(found.pixels, 255 - white)


@pytest.mark.parametrize("kind", ["photos", "transforms"])
def test_masks_of_instant_ngp_lie_beside_their_photos(kind: str, tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg", "dynamic_mask_a.png", "dynamic_mask_gone.png"):
        (tmp_path / name).write_bytes(b"x")
    source = find_source(tmp_path)
    if kind == "transforms":
        frames = [{"file_path": name, "transform_matrix": []} for name in ("a.jpg", "b.jpg")]
        (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
        source = find_source(tmp_path / "transforms.json")
    names = [source.name(file) for file in source.files]
    assert names == ["a.jpg", "b.jpg"]
    assert pair_masks(names, source.masks)[0] == {"a.jpg": tmp_path / "dynamic_mask_a.png"}


def test_half_bright_is_used_and_transparent_ignored(tmp_path: Path) -> None:
    grey = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    grey[:, :10, :3], grey[:, 10:20, :3] = 127, 128
    grey[:, 20:30, :3] = [0, 0, 200]  # a colour is not black
    grey[:, 30:40, 3] = 0
    found = read_mask(saved(tmp_path, grey), WIDTH, HEIGHT, 1).pixels
    assert [int(value) for value in found[0, 5::10]] == [0, 255, 255, 0, 255]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_of_the_stored_shape_is_turned(orientation: int, tmp_path: Path) -> None:
    mask = ignoring(20, 10)
    stored = {
        5: mask.T,
        6: mask.T[::-1],
        7: mask.T[::-1, ::-1],
        8: mask.T[:, ::-1],
    }.get(orientation, mask)
    found = read_mask(saved(tmp_path, np.ascontiguousarray(stored)), WIDTH, HEIGHT, orientation)
    assert np.array_equal(found.pixels, mask)
    assert found.turned == (orientation >= 5)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_ambiguous_masks_follow_others_of_their_set(orientation: int, tmp_path: Path) -> None:
    square = ignoring(20, 10, WIDTH, WIDTH)
    found = read_mask(saved(tmp_path, square), WIDTH, WIDTH, orientation, stored=True)
    assert np.array_equal(found.pixels, np.asarray(upright(Image.fromarray(square), orientation)))
    assert found.turned == found.ambiguous == (orientation != 1)
    Image.fromarray(square).save(tmp_path / "own.png", exif=exif_with(orientation))
    own = read_mask(tmp_path / "own.png", WIDTH, WIDTH, orientation, stored=True)
    assert np.array_equal(own.pixels, found.pixels) and not (own.turned or own.ambiguous)


@pytest.mark.parametrize(
    ("orientation", "size", "turned", "noted"),
    [(6, (32, 24), True, False), (6, (24, 32), False, False), (4, (32, 24), False, True)],
)
def test_masks_of_half_turned_photos_follow_their_shapes(
    orientation: int, size: tuple[int, int], turned: bool, noted: bool, tmp_path: Path, progress: Any
) -> None:
    folder = tmp_path / "in"
    mask_for(folder, "masks/0.png", 8)
    mask_for(folder, "masks/1.png", 8, size)
    for index, one in enumerate((3, orientation)):
        picture(index).save(folder / f"{index}.jpg", exif=exif_with(one))
    ingest.run(ingest.Config(photos=folder), {}, tmp_path / "out", progress)
    mask = np.asarray(Image.open(tmp_path / "out" / str(read_photos(tmp_path / "out")[0].mask)))
    assert np.array_equal(mask[0] == 0, np.arange(32) >= 24 if turned else np.arange(32) < 8)
    assert progress.names("ingest.ambiguous-masks", "2 photos", "0.jpg, 1.jpg") == noted


def test_masks_of_both_kinds_tell_nothing_of_others(tmp_path: Path) -> None:
    photos = [tmp_path / f"{index}.jpg" for index in range(3)]
    for file in photos:
        picture(0).save(file, exif=exif_with(6))
    flat = saved(tmp_path, ignoring(5, 5, 32, 24), "flat.png")
    high = saved(tmp_path, ignoring(5, 5, 24, 32), "high.png")
    assert are_of_stored_pixels([(photos[0], flat), (photos[1], tmp_path / "none.png")]) is True
    assert are_of_stored_pixels([(photos[0], high), (photos[2], high)]) is False
    assert are_of_stored_pixels([(photos[0], high), (photos[2], flat)]) is None


@pytest.mark.parametrize(("factor", "turned"), [(0.5, False), (2, False), (2, True)])
def test_a_mask_of_another_size_is_resized(factor: float, turned: bool, tmp_path: Path) -> None:
    mask = ignoring(int(20 * factor), int(10 * factor), int(WIDTH * factor), int(HEIGHT * factor))
    file = saved(tmp_path, np.ascontiguousarray(np.rot90(mask)) if turned else mask)
    found = read_mask(file, WIDTH, HEIGHT, 6 if turned else 1)
    assert np.array_equal(found.pixels, ignoring(20, 10))
    assert (found.turned, found.resized) == (turned, True)


@example(6000, 4000, 1600 / 6000)
@given(st.integers(100, 6000), st.integers(100, 6000), st.floats(0.1, 2))
def test_any_reduction_rounded_to_pixels_keeps_its_shape(width: int, height: int, scale: float) -> None:
    reduced = max(1, round(width * scale)), max(1, round(height * scale))
    assert _same_shape(reduced, (width, height)) and _same_shape((width, height), reduced)
    assert not _same_shape((reduced[0] + width // 2 + 2, reduced[1]), (width, height)) or width > 50 * height


def test_an_unusable_mask_refuses_its_photo(tmp_path: Path) -> None:
    assert refused_as("ingest.mask-shape", saved(tmp_path, ignoring(5, 5, 40, 40)), "40×40", "48×32")
    assert refused_as("ingest.mask-shape", saved(tmp_path, ignoring(5, 5, HEIGHT, WIDTH)))
    black = saved(tmp_path, np.zeros((HEIGHT, WIDTH), np.uint8))
    assert refused_as("ingest.mask-empty", black, "0 of 255")
    hidden = np.dstack([np.zeros((HEIGHT, WIDTH, 3), np.uint8), ignoring(5, 5)])
    assert refused_as("ingest.mask-empty", saved(tmp_path, hidden), "0 of 255", "transparent")
    (tmp_path / "t.png").write_text("text")
    assert refused_as("ingest.mask-unusable", tmp_path / "t.png")


def photo(name: str, mask: str | None = None, has_alpha: bool = False) -> Photo:
    return Photo(name, f"images/{name}", WIDTH, HEIGHT, 0, None, None, has_alpha, 1.0, mask=mask)


def test_features_lie_where_nothing_is_ignored_or_transparent(tmp_path: Path) -> None:
    rgba = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    rgba[:5, :, 3] = 0
    rgba[5, :, 3] = 1
    write_png(tmp_path / "images/s/a.png", rgba)
    write_png(tmp_path / "images/c.png", rgba)
    write_png(tmp_path / "masks/s/a.png.png", ignoring(20, 10))
    write_png(tmp_path / "masks/b.jpg.png", ignoring(30, 20))
    photos = [
        photo("s/a.png", "masks/s/a.png.png", True),
        photo("b.jpg", "masks/b.jpg.png"),
        photo("c.png", None, True),
    ]
    assert write_feature_masks(tmp_path, [*photos, photo("d.jpg")], tmp_path / "out")
    written = {file.relative_to(tmp_path / "out").as_posix() for file in (tmp_path / "out").rglob("*.png")}
    assert written == {"s/a.png.png", "b.jpg.png", "c.png.png"}
    both = ignoring(20, 10)
    both[:5] = 0
    assert np.array_equal(np.asarray(Image.open(tmp_path / "out/s/a.png.png")), both)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "out/b.jpg.png")), ignoring(30, 20))
    assert not write_feature_masks(tmp_path, [photo("d.jpg")], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_reduced_mask_keeps_only_wholly_used_pixels(tmp_path: Path) -> None:
    file = saved(tmp_path, ignoring(21, 0))
    assert np.array_equal(load_mask(file, WIDTH, HEIGHT), ignoring(21, 0) > 0)
    assert np.array_equal(load_mask(file, 12, 8), np.broadcast_to(np.arange(12) < 5, (8, 12)))
    assert np.array_equal(load_mask(file, 7, 3), np.broadcast_to(np.arange(7) < 3, (3, 7)))  # 3 / 7 of 48 is 20.6


def test_alpha_and_mask_combine_into_one_mask(tmp_path: Path, progress: Any) -> None:
    folder = put(tmp_path / "in", "a.jpg")
    alpha = np.full((24, 32), 255, np.uint8)
    alpha[:6], alpha[6] = 127, 128
    for name in ("b.png", "c.png"):
        Image.fromarray(np.dstack([np.asarray(picture(ord(name[0]))), alpha])).save(folder / name)
    mask_for(folder, "masks/c.png", 8)
    result = ingest.run(ingest.Config(photos=folder), {}, tmp_path / "out", progress)
    assert result.outputs == ("images", "photos.json", "masks", "opaque")
    photos = read_photos(tmp_path / "out")
    assert [(photo.used_share, photo.opaque_share) for photo in photos] == [(1, 1), (1, 0.75), (0.75, 0.5625)]
    for photo, columns in zip(photos[1:], (0, 8), strict=True):
        file = f"opaque/{photo.name}.png"
        assert photo.opaque_mask == file
        opaque = np.asarray(Image.open(tmp_path / "out" / file))
        wanted = np.where(alpha > 127, 255, 0)
        wanted[:, :columns] = 0
        assert np.array_equal(opaque, wanted)
