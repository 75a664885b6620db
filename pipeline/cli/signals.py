"""How a command is stopped from outside: Ctrl-C raises KeyboardInterrupt, SIGTERM :class:`Terminated`, and neither gets
lost; a terminal that is closed stops nothing."""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

LATER = 0.05  # seconds
MAX_ENDING_SECONDS = 5.0  # from when it is said that the command was stopped


class Terminated(BaseException):
    """SIGTERM arrived."""


def heed_signals() -> None:
    """From now on, for the whole process."""
    signal.signal(signal.SIGTERM, _terminate)
    if hasattr(signal, "SIGHUP"):  # a run outlives its terminal, and so does what it starts
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    sys.unraisablehook = _send_again


def end_soon(exit_code: int) -> None:
    """The program ends with this exit code within MAX_ENDING_SECONDS, whatever its threads do. Python waits for them at
    its end, and a signal that falls between the start of a pool's thread and the pool's note of it leaves one that
    nothing tells to end."""
    ending = threading.Timer(MAX_ENDING_SECONDS, os._exit, (exit_code,))
    ending.daemon = True
    ending.start()


def go_on(words: Sequence[str]) -> str:
    """What takes up again the work of a command line that was stopped."""
    way = "the same command continues"
    if words[0] == "view":
        return "A running training goes on without it; the same command shows it again."
    if words[0] in ("run", "resume"):  # what was asked for is recorded before any stage begins
        way = "`pipeline resume WORKSPACE` continues"
    elif words[0] == "batch":
        way = "the same command continues with the scene that was stopped"
    elif "--force" in words:
        way = "the same command starts over"
    elif "--replan" in words:
        way = "the same command without --replan continues"
    return f"Finished stages are kept; {way}."


def _terminate(number: int, frame: "FrameType | None") -> None:
    raise Terminated


def _send_again(ignored: "sys.UnraisableHookArgs") -> None:
    """Python has places where it ignores whatever is raised, the end of an import or a finaliser, and a signal may
    arrive in one. It is sent once more, when such a place has been left."""
    number = {KeyboardInterrupt: signal.SIGINT, Terminated: signal.SIGTERM}.get(ignored.exc_type)
    if number is None:
        sys.__unraisablehook__(ignored)
        return
    again = threading.Timer(LATER, _send, (number,))
    again.daemon = True
    again.start()


def _send(number: signal.Signals) -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)  # wakes it, too, where it waits
    else:
        signal.raise_signal(number)
