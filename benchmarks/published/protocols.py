"""The protocols of three tables of the literature, and in what a folder at hand deviates from them.

* ``blender`` (Mildenhall et al. 2020): 800 × 800, 100 training and 200 test photos, over white.
* ``llff`` (the same): photos at a quarter of 4032 × 3024, every eighth by name held out from the first on.
* ``mip360`` (Barron et al. 2022): indoor scenes at half, outdoor ones at a quarter of their size, held out likewise.

All of them give cameras, so no protocol counts the time of structure from motion. PSNR and SSIM are means over the
test photos of each one's own, at the protocol's size whatever size was trained.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from nerf.geometry.scene import Scene

BLENDER_SIZE, LLFF_SIZE = (800, 800), (1008, 756)
BLENDER_PHOTOS = {"train": 100, "test": 200}


def _reduced(names: str, factor: int) -> dict[str, int]:
    return dict.fromkeys(names.split(), factor)


SCENES: Mapping[str, Mapping[str, int]] = {
    "blender": _reduced("chair drums ficus hotdog lego materials mic ship", 1),
    "llff": _reduced("fern flower fortress horns leaves orchids room trex", 4),
    "mip360": _reduced("bonsai counter kitchen room", 2) | _reduced("bicycle flowers garden stump treehill", 4),
}
"""Of each table its scenes, and by how much photos as taken are reduced."""
MIP360_PHOTOS = {"bonsai": 292}  # as far as they are known here
MAX_REDUCED_SIDE = 1600  # no photo of these tables is larger once it is reduced


class Case(NamedTuple):
    """A scene of a table in a folder: its ``photos`` and ``cameras`` (None: photos have them, or we find them), and by
    how much photos are reduced when they are scored."""

    table: str
    scene: str
    photos: Path
    cameras: Path | None
    downscale: int


def find_case(table: str, folder: Path) -> Case:
    """What a folder holds, whose name begins with the scene's. Raises SystemExit for one that is no such scene."""
    folder = folder.absolute()
    names = [name for name in SCENES[table] if folder.name.lower().split("_")[0] == name]
    if not names:
        raise SystemExit(
            f"{folder} is no scene of {table}: a folder is called {', '.join(SCENES[table])}, or fern_NOTE"
        )
    scene, factor = names[0], SCENES[table][names[0]]
    if table == "blender":
        if not (folder / "transforms_test.json").is_file():
            raise SystemExit(f"{folder} has no transforms_test.json, so nobody knows its test photos")
        return Case(table, scene, folder, None, 1)
    reduced = folder / f"images_{factor}"
    photos = reduced if reduced.is_dir() else folder / "images"
    if not photos.is_dir():
        raise SystemExit(f"{folder} has neither {reduced.name} nor images")
    cameras = folder / ("poses_bounds.npy" if table == "llff" else "sparse")
    taken = photos.name == "images" and _longer_side(photos) > MAX_REDUCED_SIDE
    return Case(table, scene, photos, cameras if cameras.exists() else None, factor if taken else 1)


def _longer_side(photos: Path) -> int:
    """Of the first photo of a folder, pixels."""
    for file in sorted(photos.iterdir()):
        if file.suffix.lower() in (".jpg", ".jpeg", ".png"):
            with Image.open(file) as photo:
                return max(photo.size)
    raise SystemExit(f"{photos} holds no JPEG and no PNG")


def deviations(case: Case, scene: Scene, scored_size: tuple[int, int]) -> list[str]:
    """In what a run deviates from the protocol, in words; empty: in nothing."""
    found, counts = [], {split: len(scene.of_split(split)) for split in ("train", "test")}
    wanted = {"blender": BLENDER_SIZE, "llff": LLFF_SIZE}.get(case.table)
    size = "{} × {}".format(*scored_size)
    if wanted is not None and scored_size != wanted:
        found.append(f"photos of {size} instead of {wanted[0]} × {wanted[1]}")
    if case.table == "blender":
        found += [f"{counts[s]} {s} photos instead of {n}" for s, n in BLENDER_PHOTOS.items() if counts[s] != n]
        return found
    if case.table == "mip360" and case.downscale == 1 and case.photos.name == "images":
        found.append(f"photos of {size}, reduced by others than the authors")
    if case.downscale > 1:
        found.append(f"photos reduced here, to {size}")
    photos = sum(counts.values())
    if case.table == "mip360" and photos != (all_of_them := MIP360_PHOTOS.get(case.scene, photos)):
        found.append(f"{photos} of {all_of_them} photos")
    if case.cameras is None:
        found.append("cameras of our own structure from motion instead of the set's")
    return found
