"""How long earlier attempts at a stage took, so that a stage's time is that of all its attempts.

A killed program cannot say when it died; the last file that it wrote tells, or NAME, which is touched as long as the
stage runs (pipeline/heartbeat.py). The machine's own running time, which no one sets, keeps a clock that was put
forward from counting as work.
"""

import json
import time
from pathlib import Path

from stages.files import write_durably

NAME = "attempts.json"


def begin(partial: Path, spent: float) -> None:
    """Note that an attempt begins now in ``partial``, after others that took ``spent`` seconds."""
    write_durably(partial / NAME, json.dumps({"spent": spent, "began": time.time(), "up": time.monotonic()}).encode())


def spent(partial: Path) -> float:
    """Seconds that all attempts in ``partial`` took until their last sign of life; 0 where there was none."""
    try:
        value = json.loads((partial / NAME).read_bytes())
        before, began, up = float(value["spent"]), float(value["began"]), float(value["up"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0.0
    last = max(path.stat().st_mtime for path in partial.rglob("*"))
    passed = time.monotonic() - up  # negative after a restart of the machine, and else more than the attempt took
    return before + max(0.0, min(last - began, passed) if passed >= 0 else last - began)
