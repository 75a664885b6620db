"""`pipeline view`: a workspace in the browser, with the training that runs in it, by a server of this machine alone.

The server is a program of its own: it reads what the training left for it in files (stages/train/live.py), so either
may end at any time.
"""

import json
import os
import subprocess
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from stages.contract import StageError

NEEDED = ("starlette", "uvicorn")
START_SECONDS = 30.0  # that the server of `run --view` may take to say where it is


def check_installed() -> None:
    """Raises StageError without the packages that serve."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        hint = (
            "Install them with `pip install 'pipeline-nerf[view]'`; output/viewer.html of a finished run needs neither."
        )
        raise StageError(
            "pipeline.view-not-installed", "cannot serve a page", f"not installed: {', '.join(missing)}", hint
        )


def open_browser(url: str) -> None:
    """Show a page, where there is a screen: a text browser would take the terminal away."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


@contextmanager
def beside(root: Path) -> Iterator[str]:
    """While the block runs, a process serves the workspace ``root``, which need not be there yet; yields its address.
    It ends after this program, however that ends, once open pages have the last field.

    Raises StageError where nothing can be served.
    """
    check_installed()
    words = [sys.executable, "-m", "pipeline.view", str(root.absolute())]
    server = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdin is not None and server.stdout is not None
    line = server.stdout.readline()
    if not line:
        hint = "Run without --view; `pipeline view WORKSPACE --debug` says more."
        raise StageError("pipeline.view-ended", "cannot serve a page", "the server ended at once", hint)
    try:
        yield json.loads(line)["url"]
    finally:
        server.stdin.close()  # by which it knows; it does so, too, where this program is killed
        server.stdout.close()
