"""How the runner reports what it does; the displays of the command line (pipeline/cli/terminal.py) are such."""

from pathlib import Path
from typing import Protocol

from stages.contract import StageError


class Display(Protocol):
    """How the runner speaks. ``update`` and ``note`` may be called from any thread; an update before the first stage
    has no line of its own."""

    def headline(self, text: str) -> None: ...

    def begin(self, stage: str) -> None: ...

    def update(self, message: str, done: float | None = None) -> None: ...

    def note(self, code: str, text: str) -> None: ...

    def end(self, stage: str, line: str, seconds: float, cached: bool) -> None: ...

    def failed(self, stage: str, error: StageError) -> None: ...

    def finished(self, message: str, outputs: dict[str, Path]) -> None: ...


class SilentDisplay:
    """Says nothing; for reading a workspace and for calls from Python."""

    def headline(self, text: str) -> None:
        pass

    def begin(self, stage: str) -> None:
        pass

    def update(self, message: str, done: float | None = None) -> None:
        pass

    def note(self, code: str, text: str) -> None:
        pass

    def end(self, stage: str, line: str, seconds: float, cached: bool) -> None:
        pass

    def failed(self, stage: str, error: StageError) -> None:
        pass

    def finished(self, message: str, outputs: dict[str, Path]) -> None:
        pass
