"""How long structure-from-motion has taken so far, over all runs of it that were cut short. Runs in the child."""

import json
import threading
import time
from contextlib import suppress
from pathlib import Path

from stages.io.files import write_durably
from stages.sfm.retry_strategies import read_kept

NAME = "clock.json"
BEAT = 5.0  # seconds between what is kept: whatever ends the process takes no more than these with it


class Clock:
    """Seconds of each phase and of everything together, those of earlier runs with the same file included.

    ``earlier``: the seconds of all runs before this one.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._lock = file, threading.Lock()
        self.total, self.phases = read_kept(file) or (0.0, {})
        self.earlier: float = self.total
        self._phase: str | None = None
        self._counted = time.monotonic()

    def begin(self, phase: str, anew: bool) -> None:
        """A phase begins; unless it begins ``anew``, it goes on where an earlier run left it."""
        with self._lock:
            self._count()
            self._phase = phase
            if anew:
                self.phases[phase] = 0.0

    def end(self) -> float:
        """The phase is over: the seconds that it took."""
        with self._lock:
            self._count()
            assert self._phase, "one has begun"
            phase, self._phase = self._phase, None
            return self.phases[phase]

    def keep(self) -> None:
        """Write down what was counted until now."""
        with self._lock:
            self._count()
            write_durably(self.file, json.dumps([self.total, self.phases]).encode())

    def keep_always(self) -> None:
        """Write it down again and again, as long as the process lives."""
        threading.Thread(target=self._beat, daemon=True).start()

    def _beat(self) -> None:
        while True:
            time.sleep(BEAT)
            with suppress(OSError):  # a full disk is said by those whose files matter
                self.keep()

    def _count(self) -> None:
        now = time.monotonic()
        passed, self._counted = now - self._counted, now
        self.total += passed
        if self._phase is not None:
            self.phases[self._phase] = self.phases.get(self._phase, 0.0) + passed
