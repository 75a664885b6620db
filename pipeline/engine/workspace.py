"""A workspace on disk: one folder per stage and key, run.json, the output links, one lock.

``<workspace>/<stage>/<key16>/`` is finished and immutable; ``<key16>.partial/`` is work in progress; ``output/``
links the latest results; ``run.json`` holds the options, the planned settings and the key each stage uses. A folder may
hold other things as well: what this program did not put there it neither replaces nor removes.
"""

import os
import re
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from threading import Lock

from filelock import FileLock, Timeout

from pipeline.engine import manifest_file, run_file
from pipeline.engine.manifest_file import BadManifest, Manifest
from pipeline.engine.run_file import RunFile
from pipeline.engine.stage_list import STAGES
from stages.contract import KEY_LENGTH, StageError
from stages.io.files import sync_file, sync_folder, write_durably

RUN_FILE = run_file.NAME
COPIES = ".copies"  # what in output/ is no link but a copy, one a line: its name, a tab, what of the workspace it shows
LOCK_SECONDS = 0.5  # to wait for the lock: `status` and `view` hold it for an instant, to see whether anybody works
_KEY = re.compile(rf"[0-9a-f]{{{KEY_LENGTH}}}(\.|$)")


def photo_set(photos: Path) -> Path:
    """What PHOTOS are called after: a transforms.json or an images/ folder after its parent."""
    base = Path(os.path.abspath(photos))  # resolves "..", keeps the names of links
    return base.parent if base.suffix.lower() == ".json" or base.name == "images" else base


def default_workspace(photos: Path) -> Path:
    """``photos.nerf`` in the current folder; for a video ``clip.nerf``."""
    base = photo_set(photos)
    if base.is_file():
        base = base.with_suffix("")
    if base.name == "":
        raise StageError(
            "pipeline.no-workspace-name",
            "no workspace name",
            f"{photos} has no name to derive it from",
            "Give one with -o.",
        )
    return Path.cwd() / f"{base.name}.nerf"


class Workspace:
    """Paths and durable state of one workspace. Use as a context manager to hold its lock."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lock = FileLock(root / ".lock")
        self._asking = Lock()  # threads that ask at once would take each other for a run

    @classmethod
    def existing(cls, root: Path) -> "Workspace":
        """A workspace that was made before; raises StageError with words if ``root`` is not one, or has links in it."""
        if not (root / RUN_FILE).is_file():
            why = "there is no run.json in it" if root.is_dir() else "there is no such folder"
            hint = "Start one with: pipeline run PHOTOS"
            if photo_set(root).name and root.exists() and ((named := default_workspace(root)) / RUN_FILE).is_file():
                hint = f"The workspace with its name is {named.name}."
            raise StageError("pipeline.no-workspace", f"{root} is not a workspace", why, hint)
        _refuse_links(root)
        return cls(root)

    def __enter__(self) -> "Workspace":
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            _refuse_links(self.root)
            names = [name for stage in STAGES.values() for name in stage.published]
            self._adopt_copies(names)
            self._reject_foreign_files(names)
            self._lock.acquire(timeout=LOCK_SECONDS)
            (self.root / ".lock.pid").write_text(f"{os.getpid()}\n")
        except Timeout:
            why = f"process {self._holder()} holds its lock"
            hint = "Wait for it to end, or give `run` or `demo` another workspace with -o."
            raise StageError("pipeline.workspace-in-use", f"{self.root} is in use", why, hint) from None
        except OSError as error:
            self._lock.release()
            raise self._cannot_write(error) from error
        return self

    def __exit__(self, *_: object) -> None:
        (self.root / ".lock.pid").unlink(missing_ok=True)
        self._lock.release()

    def _cannot_write(self, error: OSError) -> StageError:
        hint = "Make room there, or give a writable folder with -o."
        return StageError("pipeline.cannot-write", f"cannot write to {self.root}", error.strerror or str(error), hint)

    def _holder(self) -> str:
        try:
            return (self.root / ".lock.pid").read_text().strip() or "unknown"
        except OSError:
            return "unknown"

    def running(self) -> str | None:
        """The process that works in it; None where none does, or who asks may not write there and cannot tell."""
        if not (self.root / ".lock.pid").exists():  # a killed process leaves it, so the lock decides
            return None
        try:
            with self._asking, self._lock.acquire(timeout=0):
                return None
        except Timeout:
            return self._holder()
        except OSError:
            return None

    def folder(self, stage: str, key: str) -> Path:
        """Where the finished result of ``stage`` under ``key`` lies."""
        return self.root / stage / key[:KEY_LENGTH]

    def partial(self, stage: str, key: str) -> Path:
        """Where work on it goes on."""
        return self.root / stage / f"{key[:KEY_LENGTH]}.partial"

    def finished(self, stage: str, key: str, deep: bool = False) -> Manifest | None:
        """The manifest of a finished and undamaged result, or None. A damaged one is quarantined as ``.bad``.

        ``deep``: every file is read and compared with its sha256; else sizes are.
        Raises BadManifest after quarantining it, so that the caller can say it aloud; asking again gives None.
        """
        folder = self.folder(stage, key)
        try:
            manifest = manifest_file.read(folder)
            if manifest.key != key:
                raise BadManifest(f"{folder} belongs to another key")
            manifest_file.check_outputs(folder, manifest, deep)
        except FileNotFoundError:
            if folder.exists():
                self._quarantine(folder)
                raise BadManifest(f"{folder} has no manifest") from None
            return None
        except BadManifest:
            self._quarantine(folder)
            raise
        return manifest

    def _quarantine(self, folder: Path) -> None:
        bad = folder.with_name(folder.name + ".bad")
        if bad.exists():
            shutil.rmtree(bad)
        folder.rename(bad)

    def finish(self, partial: Path, folder: Path, manifest: Manifest) -> None:
        """Turn a partial folder into a finished one: sync, write the manifest, drop what it does not list, rename.

        From the manifest on a kill loses nothing: :meth:`complete` does the rest.
        """
        for name in (*manifest.outputs, *manifest.records):
            sync_file(partial / name)
        manifest_file.write(partial, manifest)
        self._tidy(partial, {*manifest.outputs, *manifest.records, manifest_file.NAME})
        if folder.exists():  # a forced run of the same key: the old result makes way at the last moment
            self._quarantine(folder)
        partial.rename(folder)
        sync_folder(folder.parent)

    def complete(self, partial: Path, folder: Path, key: str) -> Manifest | None:
        """Finish a partial folder that was killed after its manifest was written; None where there is none."""
        manifest = _whole(partial)
        if manifest is None or manifest.key != key:
            return None
        self.finish(partial, folder, manifest)
        return manifest

    @staticmethod
    def _tidy(folder: Path, keep: set[str]) -> None:
        for path in sorted(folder.rglob("*"), reverse=True):
            if path.is_dir() and not path.is_symlink():
                if not any(path.iterdir()):
                    path.rmdir()
            elif path.relative_to(folder).as_posix() not in keep:
                path.unlink()

    def read_run(self) -> RunFile:
        """Its run.json; an empty run for a new workspace. Raises StageError where it cannot be used."""
        return run_file.read(self.root)

    def write_run(self, run: RunFile) -> None:
        """Write run.json durably. Raises StageError if it cannot be written."""
        try:
            run_file.write(self.root, run)
        except OSError as error:
            raise self._cannot_write(error) from error

    def link_outputs(self, folder: Path, names: tuple[str, ...]) -> None:
        """Point ``output/<name>`` at the files of a finished folder; copies, made once, where links are not allowed.

        Raises StageError where something else lies there.
        """
        (self.root / "output").mkdir(exist_ok=True)
        self._reject_foreign_files(names)
        for name in names:
            source, shown = folder / name, self._shown(name)
            if source.exists():
                self._show(source, shown)
            else:
                self._take_away(shown)

    def _show(self, source: Path, shown: Path) -> None:
        temporary, copy_of = shown.with_name(f".{shown.name}.tmp"), None
        _remove(temporary)
        try:
            temporary.symlink_to(os.path.relpath(source, shown.parent), target_is_directory=source.is_dir())
        except OSError:  # Windows without the privilege, or a file system without links
            copy_of = source.relative_to(self.root).as_posix()
            if shown.exists() and self._copies().get(shown.name) == copy_of:
                return
            shutil.copytree(source, temporary) if source.is_dir() else shutil.copy2(source, temporary)
        if copy_of is not None or shown.name in self._copies():
            _remove(shown)  # before the note: no kill leaves one result under the name of another
        self._note_copies({shown.name: copy_of})
        temporary.replace(shown)

    def unlink_outputs(self, names: tuple[str, ...]) -> None:
        """Take ``output/<name>`` away, so that nothing there looks more current than it is."""
        for shown in map(self._shown, names):
            if self._is_ours(shown):
                self._take_away(shown)

    def _take_away(self, shown: Path) -> None:
        _remove(shown)
        self._note_copies({shown.name: None})  # what comes to lie there is the user's own

    def _shown(self, name: str) -> Path:
        """Where an output or record is shown."""
        return self.root / "output" / Path(name).name

    def _source_of(self, shown: Path) -> Path:
        """What a name in ``output/`` shows; the name itself where that is not known, or a file of the user's own."""
        if shown.is_symlink():
            up, *inside = Path(os.readlink(shown)).parts
            return self.root.joinpath(*inside) if up == ".." else shown
        copied = self._copies().get(shown.name)
        return self.root / copied if copied else shown

    def _copies(self) -> dict[str, str]:
        """What each copy in ``output/`` shows, by its name, relative to the workspace; "" where that is not known."""
        copies = self.root / COPIES
        lines = copies.read_text("utf-8", "replace").splitlines() if copies.exists() else []
        return {name: source for name, _, source in (line.partition("\t") for line in lines)}

    def _note_copies(self, sources: Mapping[str, str | None]) -> None:
        """What these copies show; None for what is no copy any more."""
        before = self._copies()
        now = {name: source for name, source in {**before, **sources}.items() if source is not None}
        if now != before:
            lines = (f"{name}\t{source}" for name, source in sorted(now.items()))
            write_durably(self.root / COPIES, "\n".join(lines).encode())

    def _adopt_copies(self, names: Iterable[str]) -> None:
        """Where no result in ``output/`` is a link and none is noted as a copy, the workspace was zipped or copied in a
        way that put files in place of its links."""
        results = [shown for shown in map(self._shown, names) if shown.exists()]
        lost = results and not any(shown.is_symlink() for shown in results) and not self._copies()
        if lost and (self.root / RUN_FILE).exists():
            self._note_copies({shown.name: "" for shown in results})

    def _is_ours(self, shown: Path) -> bool:
        return shown.is_symlink() or shown.name in self._copies()

    def _reject_foreign_files(self, names: Iterable[str]) -> None:
        """What lies under the name of a result and is no link or copy of ours would be lost to it."""
        for shown in map(self._shown, names):
            if shown.exists() and not self._is_ours(shown):
                raise StageError(
                    "pipeline.not-a-result",
                    f"{shown} was not made by this program",
                    "a result of the same name would replace it",
                    "Move it elsewhere, or give another folder with -o.",
                )

    def stale_folders(self, keys: dict[str, str], stages: list[str]) -> list[Path]:
        """Stage folders that run.json does not use: other keys, abandoned partials, damaged ones. It uses the result
        that the recorded one goes on from, what the options name as cameras or list of photos, and a partial of the
        key until that is finished."""
        current = {self.folder(stage, key) for stage, key in keys.items()}
        current |= {self.partial(stage, key) for stage, key in keys.items() if _whole(self.folder(stage, key)) is None}
        options = self.read_run().options
        named = (options.get(stage, {}).get(name) for stage, names in run_file.PATHS.items() for name in names)
        files = [Path(os.path.realpath(path)) for path in named if isinstance(path, str)]
        current |= {self.folder(s, after) for s, o in options.items() if isinstance(after := o.get("after"), str)}
        found = (p for stage in stages if (self.root / stage).is_dir() for p in (self.root / stage).iterdir())
        ours = (p for p in found if p.is_dir() and _KEY.match(p.name) and p not in current)  # others are not ours
        return sorted(p for p in ours if not any(path.is_relative_to(os.path.realpath(p)) for path in files))


def lasting(path: Path, root: Path) -> Path:
    """``path``, absolute; where the workspace at ``root`` shows it in ``output/``, which the next run takes it out of,
    the file or folder of the finished stage itself. What other workspaces show is theirs to keep."""
    path, output = path.absolute(), os.path.realpath(root / "output")
    for shown in (path, *path.parents):
        if os.path.realpath(shown.parent) == output and (root / RUN_FILE).is_file():
            return Workspace(root.absolute())._source_of(shown) / path.relative_to(shown)
    return path


def is_result(path: Path, root: Path) -> bool:
    """Whether ``path`` lies in a result of the workspace at ``root``, shown in its ``output/`` or where it stays."""
    inside = Path(os.path.relpath(os.path.realpath(lasting(path, root)), os.path.realpath(root))).parts
    return len(inside) > 1 and inside[0] in STAGES and _KEY.match(inside[1]) is not None


def _whole(folder: Path) -> Manifest | None:
    """The manifest of a result that is whole, by its sizes; None where there is none."""
    try:
        manifest = manifest_file.read(folder)
        manifest_file.check_outputs(folder, manifest)
    except (FileNotFoundError, BadManifest):
        return None
    return manifest


def _refuse_links(root: Path) -> None:
    """What is written and removed below ``root`` must lie there: only what ``output/`` holds may be links, and what
    folders of others hold, which need not even be readable (``lost+found`` of a disk)."""
    ours = (root, *map(root.joinpath, STAGES))
    for path in (path for folder in ours if folder.is_dir() for path in folder.iterdir()):
        if path.is_symlink():
            raise StageError(
                "pipeline.link",
                f"{path} is a link",
                "a stage writes and removes files there, and a link may lead anywhere",
                "Replace the link with the folder itself. Only the whole workspace may be a link.",
            )


def _remove(path: Path) -> None:
    """A folder vanishes at one go: what a kill leaves of it has another name, and goes the next time."""
    gone = path.with_name(f".{path.name}.gone")
    if gone.is_dir():
        shutil.rmtree(gone)
    if path.is_dir() and not path.is_symlink():
        path.rename(gone)
        shutil.rmtree(gone)
    else:
        path.unlink(missing_ok=True)
