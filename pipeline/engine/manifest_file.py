"""What a finished stage folder says of itself: ``manifest.json``.

``outputs`` are digested and decide what runs downstream; ``records`` (curves, logs, timings) are checked, but decide
nothing. The file ends with the sha256 of all that it says: a flipped bit is found even in a figure.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.engine.cache_keys import digest, file_sha256
from stages.io.files import first_fault, write_durably

NAME = "manifest.json"
SEAL = "sha256"


class BadManifest(Exception):
    """A manifest that does not parse or does not describe its folder."""


@dataclass(frozen=True)
class Manifest:
    """One finished stage. ``outputs`` and ``records`` map relative paths to {"size", "sha256"}; ``expected`` are the
    expected seconds, None if they could not be estimated or a budget set them."""

    stage: str
    version: int
    key: str
    config: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, dict[str, Any]]
    outputs_digest: str
    records: dict[str, dict[str, Any]]
    facts: dict[str, Any]
    line: str
    seconds: float
    started: str
    machine: dict[str, Any] = field(default_factory=dict)
    expected: float | None = None


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
    """Size and sha256 of every file that ``names`` stand for."""
    return {
        name: {"size": (folder / name).stat().st_size, "sha256": file_sha256(folder / name)}
        for name in files_below(folder, names)
    }


def outputs_digest(outputs: Mapping[str, dict[str, Any]]) -> str:
    """One digest for all outputs: names and content."""
    return digest({name: entry["sha256"] for name, entry in outputs.items()})


def write(folder: Path, manifest: Manifest) -> None:
    """Write ``manifest`` durably into ``folder``."""
    text = json.dumps(sealed(asdict(manifest)), indent=1, sort_keys=True, allow_nan=False)
    write_durably(folder / NAME, (text + "\n").encode())


def read(folder: Path) -> Manifest:
    """The manifest of ``folder``. Raises FileNotFoundError, or BadManifest with the reason."""
    try:
        value = unsealed(json.loads((folder / NAME).read_text("utf-8")))
        text = json.dumps(value, ensure_ascii=False).encode("utf-8", "replace")  # a path need not be Unicode
        manifest = replace(TypeAdapter(Manifest).validate_json(text, strict=True), config=value["config"])
    except FileNotFoundError:
        raise
    except ValidationError as error:
        raise BadManifest(f"{folder / NAME} cannot be used ({first_fault(error)})") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise BadManifest(f"{folder / NAME} cannot be used ({error})") from error
    for name, entry in {**manifest.outputs, **manifest.records}.items():
        if not (isinstance(entry.get("size"), int) and isinstance(entry.get("sha256"), str)):
            raise BadManifest(f"{folder / NAME} lacks size and sha256 of {name[:40]!r}")
    if manifest.outputs_digest != outputs_digest(manifest.outputs):
        raise BadManifest(f"{folder / NAME} contradicts itself: its digest does not match its outputs")
    return manifest


def sealed(value: dict[str, Any]) -> dict[str, Any]:
    """``value`` with the sha256 of itself, as it will be read back."""
    plain = json.loads(json.dumps(value, allow_nan=False))
    return {**plain, SEAL: digest(plain)}


def unsealed(value: dict[str, Any]) -> dict[str, Any]:
    """What :func:`sealed` was given. Raises ValueError where it has changed since."""
    if not isinstance(value, dict) or SEAL not in value:
        raise ValueError("it has no checksum")
    plain = {name: entry for name, entry in value.items() if name != SEAL}
    if digest(plain) != value[SEAL]:
        raise ValueError("it has changed since it was written")
    return plain


def check_outputs(folder: Path, manifest: Manifest, deep: bool = False) -> None:
    """Raise BadManifest unless every output and record is there with its size (``deep``: with its sha256)."""
    for name, entry in {**manifest.outputs, **manifest.records}.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise BadManifest(f"{path} leads out of its folder")
        if not path.is_file():
            raise BadManifest(f"{path} is missing")
        if path.stat().st_size != entry["size"]:
            raise BadManifest(f"{path} has {path.stat().st_size} bytes, but its manifest says {entry['size']}")
        if deep and file_sha256(path) != entry["sha256"]:
            raise BadManifest(f"{path} has changed since it was written")
