"""Benchmarks compare with photos as stage evaluate reads them: a mask that cuts out an object is their alpha."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import mesh_looks, score_tiles
from nerf.geometry.normalisation import Similarity
from nerf.geometry.scene import Camera, Scene, View
from stages.io.files import write_json, write_png

SIDE, GREY = 32, 100
LEFT = np.arange(SIDE) < SIDE // 2


@pytest.fixture
def cut_out(tmp_path: Path) -> Scene:
    """A grey photo whose mask leaves its left half, below ``tmp_path``, with a render of it over white."""
    write_png(tmp_path / "images/a.png", np.full((SIDE, SIDE, 3), GREY, np.uint8))
    mask = np.where(np.broadcast_to(LEFT, (SIDE, SIDE)), np.uint8(255), np.uint8(0))
    write_png(tmp_path / "masks/a.png", mask)
    write_png(tmp_path / "renders/a.png", np.repeat(np.where(mask > 0, np.uint8(GREY), np.uint8(255))[..., None], 3, 2))
    view = View("a", "images/a.png", 0, np.eye(4)[:3], 1.0, 2.0, "test", alpha="masks/a.png")
    camera = Camera("PINHOLE", SIDE, SIDE, (30.0, 30.0, 16.0, 16.0))
    return Scene((camera,), (view,), Similarity(1.0, np.eye(3), np.zeros(3)), True, True, "object-centric", True)


def test_meshes_are_compared_with_photos_over_their_background(cut_out: Scene, tmp_path: Path) -> None:
    source: Any = SimpleNamespace(ingest=tmp_path, scene=cut_out, info={"background": [1.0, 1.0, 1.0]})
    photo: Any = SimpleNamespace(view=cut_out.views[0])
    truth, unmasked = mesh_looks.truth_of(source, photo)
    assert unmasked.all()
    assert np.allclose(truth[:, LEFT], GREY / 255) and np.allclose(truth[:, ~LEFT], 1)
    photo.view = replace(photo.view, alpha=None, mask="masks/a.png")
    truth, unmasked = mesh_looks.truth_of(source, photo)
    assert np.allclose(truth, GREY / 255) and (unmasked == LEFT).all()


def test_tiles_are_compared_with_photos_over_their_background(cut_out: Scene, tmp_path: Path) -> None:
    output = tmp_path / "output"
    output.symlink_to(tmp_path)
    write_json(output / "scene.json", cut_out.to_json())
    write_json(output / "metrics.json", {"images": [{"name": "a", "render": "renders/a.png"}], "background": [1, 1, 1]})
    (found,) = score_tiles.maps(tmp_path)
    assert found.error.shape == (SIDE, SIDE) and found.error.max() < 1e-9


def test_no_benchmark_reads_photos_without_their_alpha() -> None:
    files = [*Path(mesh_looks.__file__).parent.rglob("*.py")]
    assert len(files) > 40
    assert not [file.name for file in files if "load_pixels" in file.read_text("utf-8")]
