"""Which photos show a plain backdrop, and which a scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerf.geometry.scene import Split
from stages.io.files import write_png
from stages.io.photos import Photo
from stages.normalise.backdrop import Backdrop, find_backdrop

COUNT, SIDE = 20, 120
Paint = Callable[[np.random.Generator, int], np.ndarray]


def found(folder: Path, paint: Paint, seed: int = 0, changed: dict[str, object] | None = None) -> Backdrop | None:
    """The backdrop of photos that are painted one by one; every fifth is a test photo."""
    random, photos = np.random.default_rng(seed), []
    (folder / "images").mkdir(exist_ok=True)
    for i in range(COUNT):
        write_png(folder / f"images/{i}.png", np.clip(paint(random, i), 0, 255).astype(np.uint8))
        photos.append(Photo(f"{i}.png", f"images/{i}.png", SIDE, SIDE, 0, None, None, False, 1.0))
    photos[0] = replace(photos[0], **changed or {})
    split: list[Split] = ["train" if i % 5 else "test" for i in range(COUNT)]
    return find_backdrop(folder, photos, split)


def textured(random: np.random.Generator) -> np.ndarray:
    """Something with grey values of all sizes, (SIDE, SIDE, 3)."""
    rough, fine = random.uniform(20, 235, (8, 8, 3)), random.normal(0, 15, (SIDE, SIDE, 3))
    return np.kron(rough, np.ones((SIDE // 8, SIDE // 8, 1))) + fine


def before(colour: list[float], noise: float = 0.0, touching: int = 0) -> Paint:
    """An object before one colour; in every ``touching``-th photo it reaches the lower edge."""

    def paint(random: np.random.Generator, number: int) -> np.ndarray:
        photo = np.full((SIDE, SIDE, 3), 1.0) * colour
        end = SIDE if touching and number % touching == 0 else 80
        photo[40:end, 30:90] = textured(random)[40:end, 30:90]
        return photo + random.normal(0, noise, photo.shape)

    return paint


def overcast(random: np.random.Generator, number: int) -> np.ndarray:
    """A building before a white sky."""
    photo = textured(random)
    photo[:70] = 255
    photo[30:70, 20:100] = textured(random)[30:70, 20:100]
    return photo


def lit_table(random: np.random.Generator, number: int) -> np.ndarray:
    """An object on a white table, which light falls on from the left."""
    photo = np.ones((SIDE, SIDE, 3)) * np.linspace(250, 190, SIDE)[None, :, None]
    photo[40:80, 30:90] = textured(random)[40:80, 30:90]
    return photo


def changing_light(random: np.random.Generator, number: int) -> np.ndarray:
    """A grey backdrop in photos of different exposure."""
    return before([100 + 8 * number] * 3)(random, number)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("colour", [[0, 0, 0], [255, 255, 255], [20, 200, 60]])
def test_one_colour_behind_an_object_is_a_backdrop(tmp_path: Path, colour: list[float], seed: int) -> None:
    backdrop = found(tmp_path, before(colour, noise=2.0, touching=4), seed)
    assert backdrop is not None and 0.9 < backdrop.share < 1
    assert np.allclose(backdrop.colour, np.array(colour) / 255, atol=2 / 255)
    assert [box is None for box in backdrop.opaque] == [i % 5 == 0 for i in range(COUNT)]
    assert np.allclose(backdrop.opaque[1] or 0, [0.25, 1 / 3, 0.75, 2 / 3], atol=1.01 / SIDE)
    assert (backdrop.opaque[4] or [0])[-1] == 1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("paint", [lambda random, _: textured(random), overcast, lit_table, changing_light])
def test_a_scene_around_is_no_backdrop(tmp_path: Path, paint: Paint, seed: int) -> None:
    assert found(tmp_path, paint, seed) is None


def test_photos_between_those_looked_at_first_count_too(tmp_path: Path) -> None:
    plain = before([0, 0, 0])
    assert found(tmp_path, lambda random, i: plain(random, i) if i % 2 else textured(random)) is None


@pytest.mark.parametrize("changed", [{"mask": "masks/0.png"}, {"has_alpha": True}])
def test_masks_and_alpha_come_before_a_backdrop(tmp_path: Path, changed: dict[str, object]) -> None:
    assert found(tmp_path, before([0, 0, 0]), changed=changed) is None
