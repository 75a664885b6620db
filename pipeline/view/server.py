"""The server of `pipeline view`: five addresses below an unguessable path, for this machine and this page alone.

Bound to 127.0.0.1, it is not to be reached from other machines. Pages of other origins in the same browser are: what
they could do is stopped by the token in the path, which they do not know; by the Host header, which names their own
host if they let a name of theirs point here (DNS rebinding); and by Origin and Sec-Fetch-Site, which no page can forge.
"""

import math
import os
import secrets
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import IO

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

import stages.sfm.colmap  # noqa: F401 -- a thread could not take back the handler of SIGTERM that pycolmap installs
from pipeline.view.workspace_state import FINISHED, WorkspaceState
from stages.contract import StageError
from stages.viewer.page import page, watching

ADDRESS = "127.0.0.1"
TOKEN_BYTES = 24
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
NICENESS = 10  # the training goes first
LINGER_SECONDS = 10.0  # at most, after the run during which it serves, for pages to get the last field
DRAW_SECONDS = 15.0  # that a page may take to draw its first field on cores that train
OPEN_SECONDS = 4.0  # a page that has not asked for so long is closed: longer than SLOW_POLL_MS in live.js


def listening(port: int | None) -> socket.socket:
    """A socket at this port of this machine alone; None: a free one. Raises StageError where it is taken."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # what is left of connections of an earlier server does not keep the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((ADDRESS, port or 0))
        listener.listen()  # so that whoever is told the address may ask at once
    except OSError as error:
        listener.close()
        why, hint = error.strerror or str(error), "Leave out --port: a free one is found."
        raise StageError("pipeline.view-port", f"cannot serve at port {port}", why, hint) from error
    return listener


class ViewServer:
    """Serves the workspace ``root`` at :attr:`url` as long as :meth:`run` does."""

    def __init__(self, root: Path, port: int | None = None) -> None:
        self.listener, self.token = listening(port), secrets.token_urlsafe(TOKEN_BYTES)
        self.port: int = self.listener.getsockname()[1]
        self.url = f"http://{ADDRESS}:{self.port}/{self.token}/"
        self.state = WorkspaceState(root)
        self.asked, self.served_last = -math.inf, math.inf  # when a page last asked; when one got the last field
        self.has_shown = threading.Event()  # a page has got a field
        self.server = uvicorn.Server(
            uvicorn.Config(
                self.app(),
                log_level="warning",
                access_log=False,
                lifespan="off",
                server_header=False,
                timeout_graceful_shutdown=1,
            )
        )

    def run(self) -> None:
        """Until Ctrl-C, which arrives as KeyboardInterrupt, or :meth:`stop`."""
        # Before the niceness, which is a thread's own on Linux: on cores that train, loading torch would take a minute.
        threading.Thread(target=self._prepare, daemon=True).start()
        if hasattr(os, "nice"):
            os.nice(NICENESS)
        self.server.run(sockets=[self.listener])

    def _prepare(self) -> None:
        """For the end of the training. Of one that runs already a page first gets and draws a field, on these cores."""
        if self.state.training().phase == "training":
            self.has_shown.wait()
            time.sleep(DRAW_SECONDS)
        self.state.prepare()

    def stop(self) -> None:
        """From another thread: end soon."""
        self.server.should_exit = True

    def stop_after(self, stream: IO[bytes]) -> None:
        """End some time after ``stream`` has ended, once pages that are open have the last field."""

        def wait() -> None:
            with suppress(OSError, ValueError):
                stream.read()
            ends = time.monotonic() + LINGER_SECONDS
            while time.monotonic() < min(ends, self.asked + OPEN_SECONDS, self.served_last + OPEN_SECONDS):
                time.sleep(0.1)
            self.stop()

        threading.Thread(target=wait, daemon=True).start()

    def app(self) -> Starlette:
        """The addresses. The token stands in their path: whatever else is asked for is not found."""
        answers = {
            "": (self._page, "GET"),
            "state": (self._state, "GET"),
            "scene": (self._scene, "GET"),
            "field/{name}": (self._field, "GET"),
            "finish": (self._finish, "POST"),
        }
        routes = [Route(f"/{self.token}/{at}", answer, methods=[way]) for at, (answer, way) in answers.items()]
        return Starlette(routes=routes, middleware=[Middleware(BaseHTTPMiddleware, dispatch=self._guarded)])

    async def _guarded(self, request: Request, answer: Callable[[Request], Awaitable[Response]]) -> Response:
        """Refuse what does not come from a page of ours or from a user who opens it."""
        hosts = {f"{name}:{self.port}" for name in (ADDRESS, "localhost")}
        headers = request.headers
        host, origin = headers.get("host", ""), headers.get("origin")
        foreign = origin is not None and origin != f"http://{host}"
        # Whoever has the page's address may go there: so does the file that opens the browser.
        opens = request.url.path == f"/{self.token}/" and headers.get("sec-fetch-dest") == "document"
        foreign |= headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not opens
        foreign |= request.method == "POST" and origin is None
        if len(headers.getlist("host")) != 1 or host not in hosts or foreign:
            response = Response("refused", 403)
        else:
            response = await answer(request)
        response.headers.update(HEADERS)
        return response

    def _page(self, request: Request) -> Response:
        """viewer.html where that is finished, which notices another training; else the page that follows one."""
        file = self.state.finished_page()
        return Response(page("live") if file is None else watching(file.read_text("utf-8")), media_type="text/html")

    def _state(self, request: Request) -> Response:
        self.asked, told = time.monotonic(), self.state.watched()
        if told["field"] != FINISHED:  # the last field is one to come
            self.served_last = math.inf
        return JSONResponse(told)

    def _scene(self, request: Request) -> Response:
        return _packed(self.state.scene())

    def _field(self, request: Request) -> Response:
        name = request.path_params["name"]
        content = self.state.field(name)
        if content is not None:
            self.has_shown.set()
        if content is not None and name == FINISHED:
            self.served_last = time.monotonic()
        return _packed(content)

    def _finish(self, request: Request) -> Response:
        return JSONResponse({"asked": self.state.finish()})


def _packed(content: bytes | None) -> Response:
    if content is None:  # the training has gone on meanwhile, which is no error: browsers would log one
        return Response(status_code=204)
    return Response(content, media_type="application/octet-stream")
