"""Cache keys: what a stage's result depends on, as a hash.

key = sha256 of canonical JSON {stage, version, config, inputs: {upstream stage: its outputs digest}}. Paths in a
config are replaced by the digest of what they point to, so that photos and workspaces can be moved. Machine,
device, worker counts and times never enter.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from stages.contract import StageError
from stages.ingest.sources import cannot_read
from stages.ingest.sources.camera_files import camera_files


def canonical_json(value: Any) -> bytes:
    """One spelling per value: sorted keys, no spaces, no NaN."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return text.encode("utf-8", "surrogateescape")


def digest(value: Any) -> str:
    """sha256 of a JSON value's canonical form."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def file_sha256(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class ContentIndex:
    """Remembers the sha256 of files by path, size and times, so that an unchanged photo is hashed once.

    Of the times one is that of the last change of the file or of its name, which no program can set (on Windows that
    of its creation): content that was exchanged under its old size and date is noticed. The index is a cache: it lives
    outside all digests and losing it costs only time.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[str, list[Any]] = {}
        self.changed = False
        if path.is_file():
            try:
                known = json.loads(path.read_text("utf-8"))
                if digest(known["files"]) != known["sha256"]:
                    raise ValueError("it has changed since it was written")
                self.known = known["files"]
            except (ValueError, KeyError, TypeError):
                self.changed = True  # a damaged cache is rebuilt, it cannot cause a wrong answer

    def sha256(self, path: Path) -> str:
        """sha256 of one file, from memory where size and mtime still agree. Raises StageError if it cannot be read."""
        try:
            return self._sha256(path)
        except OSError as error:
            raise cannot_read(path, error) from error

    def _sha256(self, path: Path) -> str:
        stat = path.stat()
        name = str(path.resolve())
        identity = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
        known = self.known.get(name)
        if known and known[:-1] == identity:
            return known[-1]
        value = file_sha256(path)
        self.known[name] = [*identity, value]
        self.changed = True
        return value

    def of_files(self, root: Path, files: Iterable[Path]) -> str:
        """Digest of files and their names relative to ``root``; one that is not there counts as missing."""
        found = {file: self.sha256(file) if file.is_file() else "missing" for file in sorted(files)}
        return digest({os.path.relpath(file, root): value for file, value in found.items()})

    def of_path(self, path: Path) -> str:
        """Digest of a file, or of the known cameras in a folder: no other folder is ever an option's value."""
        if path.is_file():
            return self.sha256(path)
        if not path.is_dir():
            raise StageError(
                "pipeline.no-such-file", f"{path} does not exist", "an option names it", "Check the path and run again."
            )
        try:
            return self.of_files(path, camera_files(path))
        except OSError as error:
            raise cannot_read(error.filename or path, error) from error

    def save(self) -> None:
        """Write the index if anything in it changed."""
        if self.changed:
            temporary = self.path.with_suffix(".tmp")
            temporary.write_text(json.dumps({"files": self.known, "sha256": digest(self.known)}), "utf-8")
            temporary.replace(self.path)
            self.changed = False


def config_for_key(
    config: BaseModel, index: ContentIndex, replaced: Mapping[str, str], unkeyed: Iterable[str]
) -> dict[str, Any]:
    """The config as JSON values, every path replaced by its content's digest, without the ``unkeyed`` options.

    ``replaced`` gives digests for fields whose content the caller knows better than :meth:`ContentIndex.of_path`.
    """
    values = config.model_dump(mode="json", exclude=set(unkeyed))
    for name in values:
        value = getattr(config, name)
        if name in replaced:
            values[name] = replaced[name]
        elif isinstance(value, Path):
            values[name] = index.of_path(value)
    return values


def stage_key(stage: str, version: int, config: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """The full key; folders are named by its first KEY_LENGTH digits."""
    return digest({"stage": stage, "version": version, "config": config, "inputs": inputs})
