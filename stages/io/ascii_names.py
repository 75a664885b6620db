"""Names that every program can open: ASCII files for photos of any name, and names for a shell."""

import hashlib
import os
import re
import shlex
import unicodedata
from collections.abc import Sequence

# Folders without dots, so that no folder can have the name of a file; no leading dash or dot anywhere.
_SAFE_NAME = re.compile(r"(?:\w[\w-]*/)*\w[\w.-]*", re.ASCII)
_OWN_SUFFIXES = {".jpg": (".jpg", ".jpeg"), ".png": (".png",)}


def ascii_files(names: Sequence[tuple[str, str]]) -> list[str]:
    """A file name of letters, digits and ``-_./`` for each (photo name, suffix of the stored file).

    A name that is safe already is kept. Others are transliterated and end in a hash of the name. No two differ
    only in case or in their suffix, so that anything made of one photo can be called after its stem.
    """
    wanted = [_safe_file(name, suffix) for name, suffix in names]
    order = sorted(range(len(names)), key=lambda index: (wanted[index] != names[index][0], index))
    files, stems = [""] * len(names), set[str]()
    for index in order:
        stem, suffix = os.path.splitext(wanted[index])
        salt = 0
        while (candidate := stem if salt == 0 else f"{stem}-{_hash(names[index][0], salt)}").lower() in stems:
            salt += 1
        stems.add(candidate.lower())
        files[index] = candidate + suffix
    return files


def _safe_file(name: str, suffix: str) -> str:
    stem, own_suffix = os.path.splitext(name)
    suffix = own_suffix if own_suffix.lower() in _OWN_SUFFIXES[suffix] else suffix
    if _SAFE_NAME.fullmatch(name) and len(name) <= 150:
        return stem + suffix
    plain = unicodedata.normalize("NFKD", stem).encode("ascii", "ignore").decode()
    parts = [re.sub(r"[^\w-]+", "_", part).lstrip("-")[:40] or "_" for part in plain.split("/")[-3:]]
    return f"{'/'.join(parts)}-{_hash(name, 0)}{suffix}"


def _hash(name: str, salt: int) -> str:
    return hashlib.sha256(f"{salt}/{name}".encode()).hexdigest()[:8]


def shell_quoted(name: str) -> str:
    """As a shell takes it; the bytes of a name that is not Unicode, which no text holds, as in ``$'caf\\xe9'``."""
    escaped = name.replace("\\", r"\\").replace("'", r"\'")
    text = os.fsencode(escaped).decode("utf-8", "backslashreplace")
    return shlex.quote(name) if text == escaped else f"$'{text}'"
