"""One stage to be brought up to date: what decides its key, and why that may not be known."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.contract import Stage, StageConfig


class DamagedInputs(Exception):
    """A stage was about to read files that are not what was written; they have been quarantined."""


class NotReady(Exception):
    """A stage's key cannot be known yet: ``upstream`` (or the stage itself) has no current result or plan. ``asked``:
    the digest of what the stage's plan would answer, where it is the plan that is missing."""

    def __init__(self, upstream: str, asked: str = "") -> None:
        super().__init__(upstream)
        self.upstream, self.asked = upstream, asked


@dataclass(frozen=True)
class Job:
    """One stage with everything that decides its key."""

    stage: Stage
    config: StageConfig
    key_config: dict[str, Any]
    inputs: dict[str, str]  # upstream stage -> outputs digest
    folders: dict[str, Path]  # upstream stage -> finished folder
    key: str
