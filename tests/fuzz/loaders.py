"""Every loader of files that strangers may have made: what it is given, and how it is called.

A loader may answer, or refuse in words (``REFUSALS``). Anything else that it raises is a defect, and so is a case that
takes more than ``SECONDS`` of processor time.
"""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from hypothesis import strategies as st

from pipeline.cli.options import UsageError
from pipeline.engine.manifest_file import BadManifest
from stages.contract import StageError
from stages.ingest.decoding import DecodeError
from tests.fuzz import cameras, pictures, workspaces
from tests.fuzz.inputs import damaged, json_files, one_of, single

REFUSALS = (StageError, UsageError, DecodeError, BadManifest)
SECONDS = 20


class Loader(NamedTuple):
    """``files()``: the content of each file, by name; ``load`` reads them from a folder."""

    files: Callable[[], st.SearchStrategy[dict[str, bytes]]]
    load: Callable[[Path], object]


def attempt(loader: Loader, files: dict[str, bytes]) -> bool:
    """Whether the files were taken; False where they were refused in words. Raises whatever else happens."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        try:
            loader.load(Path(folder))
        except REFUSALS as refusal:
            words = str(refusal)
            assert words.strip(), "a refusal without words"
            assert len(words) < 2000, f"a refusal of {len(words)} letters"
            return False
        return True


LOADERS = {
    "photo": Loader(lambda: single("a.png", pictures.any_picture()), pictures.try_photo),
    "mask": Loader(lambda: single("a.png", pictures.any_picture()), pictures.try_mask),
    "video": Loader(lambda: single("a.mp4", damaged(pictures.clip())), pictures.try_video),
    "transforms": Loader(lambda: single("t.json", json_files(cameras.transforms())), cameras.try_transforms),
    "blender": Loader(cameras.blender, cameras.try_blender),
    "colmap binary": Loader(lambda: one_of(cameras.colmap_models()["bin"]), cameras.try_colmap),
    "colmap text": Loader(lambda: one_of(cameras.colmap_models()["txt"]), cameras.try_colmap),
    "camera path": Loader(lambda: single("path.json", json_files(cameras.transforms())), cameras.try_path),
    "toml": Loader(lambda: single("a.toml", damaged(workspaces.TOML)), workspaces.try_toml),
    "run.json": Loader(lambda: single("run.json", json_files(workspaces.run_file())), workspaces.try_run),
    "manifest.json": Loader(
        lambda: json_files(workspaces.manifest()).map(
            lambda text: {"manifest.json": workspaces.with_seal(text), "a.json": b"{}"}
        ),
        workspaces.try_manifest,
    ),
    "photos.json": Loader(
        lambda: single("photos.json", json_files(json.loads(workspaces.photos_file()))), workspaces.try_photos
    ),
    "scene.json": Loader(lambda: single("scene.json", json_files(cameras.scene().to_json())), workspaces.try_scene),
    "points": Loader(lambda: single("points.safetensors", damaged(workspaces.points())), workspaces.try_points),
    "field": Loader(workspaces.fields, workspaces.try_field),
    "checkpoint": Loader(lambda: one_of(workspaces.checkpoint()), workspaces.try_checkpoint),
}
