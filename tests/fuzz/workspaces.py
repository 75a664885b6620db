"""Settings, and what lies in a workspace: JSON and tensors; valid ones, and how each is read."""

import contextlib
import hashlib
import json
import tempfile
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from safetensors.numpy import save

from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from pipeline.cli.commands import _reader
from pipeline.cli.options import read_toml, settings_from
from pipeline.engine import manifest_file, status
from pipeline.engine.manifest_file import Manifest, outputs_digest, sealed
from pipeline.engine.run_file import VERSION
from pipeline.engine.settings import Settings
from stages.contract import StageError
from stages.io.field_files import load_field, save_field
from stages.io.files import read_scene, read_tensors
from stages.io.photos import read_frame_names, read_photos, write_photos
from stages.train.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from tests.fuzz.cameras import photos_of
from tests.fuzz.inputs import json_files, one_of
from tests.refusals import unheard

TOML = b"""[train]
steps = 500
preset = "draft"
learning_rate = 0.01
[normalise]
roi = [0.0, 1.0, 2.0, 3.0]
[sfm]
camera_params = [500.0, 320.0, 240.0, 0.1]
[mesh]
formats = ["ply", "glb"]
"""


def try_toml(folder: Path) -> None:
    settings_from(read_toml(folder / "a.toml"), "--config a.toml")


def try_run(folder: Path) -> None:
    with contextlib.chdir(folder):  # where relative paths in it lead
        status.all_statuses(*_reader(folder), deep=False)


@cache
def run_file() -> dict[str, Any]:
    """A valid run.json."""
    options = Settings().model_dump(mode="json")
    keys = dict.fromkeys(options, "0" * 64)
    return {
        "version": VERSION,
        "options": options,
        "plans": {"train": {"0": {"steps": 5}}},
        "keys": keys,
        "stages": ["ingest"],
    }


@cache
def manifest() -> dict[str, Any]:
    """A valid manifest.json of one output."""
    outputs = {"a.json": {"size": 2, "sha256": hashlib.sha256(b"{}").hexdigest()}}
    digest = outputs_digest(outputs)
    return asdict(Manifest("mesh", 1, "0" * 64, {}, {}, outputs, digest, {}, {}, "line", 1.0, "2026", {}))


def with_seal(text: bytes) -> bytes:
    """An object with the seal that it would have: what is behind the seal is to be read, too."""
    try:
        value = json.loads(text)
        return json.dumps(sealed(value)).encode() if isinstance(value, dict) else text
    except (ValueError, RecursionError):
        return text


def try_manifest(folder: Path) -> None:
    manifest_file.check_outputs(folder, manifest_file.read(folder), deep=True)


def try_photos(folder: Path) -> None:
    for photo in read_photos(folder):
        assert not Path(photo.file).is_absolute() and ".." not in Path(photo.file).parts
    read_frame_names(folder)


@cache
def photos_file() -> bytes:
    """A valid photos.json."""
    with tempfile.TemporaryDirectory() as folder:
        write_photos(Path(folder), photos_of({"a": "p0.png", "b": "p1.png"}), [], {"a": "p0.png"})
        return (Path(folder) / "photos.json").read_bytes()


def try_scene(folder: Path) -> None:
    read_scene(folder)


def try_points(folder: Path) -> None:
    read_tensors(folder / "points.safetensors")


@cache
def points() -> bytes:
    """A valid points.safetensors."""
    return save({"xyz": np.zeros((3, 3), np.float32), "rgb": np.zeros((3, 3), np.uint8), "view": np.arange(3)})


@cache
def field() -> dict[str, bytes]:
    """A valid, tiny trained field."""
    model = VanillaNerf(VanillaSettings(depth=2, width=8, position_frequencies=2, direction_frequencies=1), seed=0)
    effects = {"exposure": {"p0.png": [0.1, 0.0, 0.0]}}
    info = {"background": [1, 1, 1], "downscale": 1.0, "steps": 5, "rays": 50, "effects": effects}
    with tempfile.TemporaryDirectory() as folder:
        save_field(Path(folder), model, info)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def fields() -> st.SearchStrategy[dict[str, bytes]]:
    valid = field()
    settings = json_files(json.loads(valid["field.json"]))
    return st.one_of(one_of(valid), settings.map(lambda text: {**valid, "field.json": text}))


def try_field(folder: Path) -> None:
    load_field(folder)


@cache
def checkpoint() -> dict[str, bytes]:
    """A valid checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder), Checkpoint(7, {"w": torch.zeros(3)}, {"lr": 0.1}))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def try_checkpoint(folder: Path) -> None:
    if latest_checkpoint(folder, unheard) is None:
        raise StageError("train.no-state", "no checkpoint", "the only one is damaged", "-")
