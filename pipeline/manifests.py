"""What a finished stage folder says of itself: ``manifest.json``.

``outputs`` are digested and decide what runs downstream; ``records`` (curves, logs, timings) are only listed.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.keys import digest, file_sha256
from stages.files import first_fault, write_durably

NAME = "manifest.json"


class BadManifest(Exception):
    """A manifest that does not parse or does not describe its folder."""


@dataclass(frozen=True)
class Manifest:
    """One finished stage. ``outputs`` maps relative paths to {"size", "sha256"}."""

    stage: str
    version: int
    key: str
    config: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, dict[str, Any]]
    outputs_digest: str
    records: list[str]
    facts: dict[str, Any]
    line: str
    seconds: float
    started: str
    machine: dict[str, Any] = field(default_factory=dict)


def files_below(folder: Path, names: tuple[str, ...]) -> list[str]:
    """The files that ``names`` (files or folders relative to ``folder``) stand for, sorted, with / separators."""
    found: set[str] = set()
    for name in names:
        path = folder / name
        if path.is_dir():
            found.update(p.relative_to(folder).as_posix() for p in path.rglob("*") if p.is_file())
        elif path.is_file():
            found.add(path.relative_to(folder).as_posix())
        else:
            raise FileNotFoundError(f"the stage declared {name} but did not write it")
    return sorted(found)


def describe_outputs(folder: Path, names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Size and sha256 of every declared output."""
    return {
        name: {"size": (folder / name).stat().st_size, "sha256": file_sha256(folder / name)}
        for name in files_below(folder, names)
    }


def outputs_digest(outputs: Mapping[str, dict[str, Any]]) -> str:
    """One digest for all outputs: names and content."""
    return digest({name: entry["sha256"] for name, entry in outputs.items()})


def write(folder: Path, manifest: Manifest) -> None:
    """Write ``manifest`` durably into ``folder``."""
    text = json.dumps(asdict(manifest), indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_durably(folder / NAME, (text + "\n").encode())


def read(folder: Path) -> Manifest:
    """The manifest of ``folder``. Raises FileNotFoundError, or BadManifest with the reason."""
    try:
        manifest = TypeAdapter(Manifest).validate_json((folder / NAME).read_bytes(), strict=True)
    except FileNotFoundError:
        raise
    except ValidationError as error:
        raise BadManifest(f"{folder / NAME} does not parse ({first_fault(error)})") from error
    if not all(set(entry) == {"size", "sha256"} for entry in manifest.outputs.values()):
        raise BadManifest(f"{folder / NAME} lists outputs without their size and sha256")
    if manifest.outputs_digest != outputs_digest(manifest.outputs):
        raise BadManifest(f"{folder / NAME} contradicts itself: its digest is not that of its outputs")
    return manifest


def check_outputs(folder: Path, manifest: Manifest, deep: bool = False) -> None:
    """Raise BadManifest unless every output is there with its size (``deep``: with its sha256)."""
    for name, entry in manifest.outputs.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise BadManifest(f"{path} leads out of its folder")
        if not path.is_file():
            raise BadManifest(f"{path} is missing")
        if path.stat().st_size != entry["size"]:
            raise BadManifest(f"{path} has {path.stat().st_size} bytes, its manifest says {entry['size']}")
        if deep and file_sha256(path) != entry["sha256"]:
            raise BadManifest(f"{path} has changed since it was written")
