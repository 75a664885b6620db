"""`pipeline view`: a workspace in the browser, with the training that runs in it, by a server of this machine alone.

The server is a program of its own: it reads what the training left for it in files (stages/train/live.py), so either
may end at any time.
"""

import atexit
import html
import json
import os
import subprocess
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from stages.contract import StageError
from stages.hardware.child_process import child_environment

NEEDED = ("starlette", "uvicorn")
COMMAND = ["-P", "-m", "pipeline.view"]  # -P: nothing that lies in the current folder is taken for a module
START_SECONDS = 30.0  # that the server of `run --view` may take to say where it is


def check_installed() -> None:
    """Raises StageError without the packages that serve."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        install = "`pip install -c constraints.txt '.[view]'` in the clone"
        hint = f"Install them with {install}; output/viewer.html of a finished run needs neither."
        raise StageError(
            "pipeline.view-not-installed", "cannot serve a page", f"not installed: {', '.join(missing)}", hint
        )


def open_browser(url: str, root: Path) -> None:
    """Show a page of the workspace ``root``, where there is a screen: a text browser would take the terminal away."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(redirect_file(url, root).as_uri())


def redirect_file(url: str, root: Path) -> Path:
    """A file of the user's own that leads to ``url``, until this program ends. The address itself would stand on the
    browser's command line, which `ps` shows to everybody. It lies in the workspace ``root`` where that can be written:
    browsers in a sandbox see no other program's temporary files."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        number, name = tempfile.mkstemp(".html", ".view-", root.absolute())
    except OSError:
        number, name = tempfile.mkstemp(".html", ".view-")
    file = Path(name)
    atexit.register(file.unlink, missing_ok=True)
    with open(number, "w", encoding="utf-8") as stream:  # 0600, as mkstemp made it
        stream.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={html.escape(url)}">\n')
    return file


@contextmanager
def serve_during(root: Path) -> Iterator[str]:
    """While the block runs, a process serves the workspace ``root``, which need not be there yet; yields its address.
    It ends after this program, however that ends, once open pages have the last field.

    Raises StageError where nothing can be served.
    """
    check_installed()
    words = [sys.executable, *COMMAND, str(root.absolute())]
    server = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=child_environment(), text=True)
    assert server.stdin is not None and server.stdout is not None
    try:
        yield _address_of(server)
    finally:
        server.stdin.close()  # by which it knows; it does so, too, where this program is killed
        server.stdout.close()


def _address_of(server: "subprocess.Popen[str]") -> str:
    """What it says. Raises StageError where it ends before, or says nothing in START_SECONDS."""
    overtime = threading.Timer(START_SECONDS, server.kill)
    overtime.start()
    assert server.stdout is not None
    line = server.stdout.readline()
    late = not overtime.is_alive()
    overtime.cancel()
    if not line:
        server.wait()
        why = f"the server did not start within {START_SECONDS:.0f} s" if late else "the server ended at once"
        hint = "Run without --view; output/viewer.html shows the result of a finished run."
        raise StageError("pipeline.view-ended", "cannot serve a page", why, hint)
    return json.loads(line)["url"]
