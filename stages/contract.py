"""What a stage is: the few types that every stage shares with the runner and nothing else.

A stage is a module of this package with

* ``INPUTS: tuple[str, ...]``: the stages whose finished folders it reads;
* optionally ``OPTIONAL_INPUTS: tuple[str, ...]``: stages whose finished folders it reads where they are there: they
  are no part of its key and are not brought up to date for it, nor given to it where damaged, so no output may depend
  on them;
* ``VERSION: int``: raised whenever the same config and inputs would give other outputs than before;
* ``RESUMES: bool``: whether it can go on from its own half-written folder (otherwise it starts clean);
* ``PUBLISHED: tuple[str, ...]``: the outputs or records shown in ``<workspace>/output/``;
* optionally ``NOT_HASHED: tuple[str, ...]``: options that cannot change the result and so do not enter the key;
* ``Config``: its settings, a :class:`StageConfig`;
* ``run(config, inputs, folder, progress) -> StageResult``: reads ``inputs[stage]`` (finished folders), writes
  into ``folder`` and nowhere else, raises :class:`StageError` for everything a user can act on;
* optionally ``plan(config, inputs, progress) -> Config``: replaces every ``None`` ("choose for me") by a value,
  where it must by timing a piece of the work. It is called once, before the stage's first run; the answer is kept
  in run.json and enters the stage's key, so a run that was killed goes on with the same choice.

Importing a stage must be cheap: torch, pycolmap, kornia and their like are imported inside ``run``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import BaseModel, ConfigDict
from tyro.conf import Suppress

MOST_LETTERS = 600  # of each part of an error
KEY_LENGTH = 16  # hex digits of a key that name a stage's folder: 64 bits


class StageConfig(BaseModel):
    """Settings of one stage. Unknown keys, infinities and NaN are refused. A ``Path`` enters keys by content."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# A path that the command line fills in from PHOTOS and --cameras; no dotted flag is offered for it.
SourcePath = Annotated[Path, Suppress]
OptionalSourcePath = Annotated[Path | None, Suppress]


class StageError(Exception):
    """A failure the user can act on: what happened, why, and what to try next (one sentence each).

    ``code`` is its name for programs, as in ``sfm.no-overlap``: it stays where the sentences are reworded. Each
    sentence is cut where it is very long: it may quote a file, in which a name may have any length.
    """

    def __init__(self, code: str, what: str, why: str, hint: str) -> None:
        self.code = code
        self.add_note(f"code: {code}")  # for who reads the traceback of --debug
        self.what, self.why, self.hint = (bounded(part) for part in (what, why, hint))
        super().__init__(f"{self.what}: {self.why}. {self.hint}")


def bounded(text: str, most: int = MOST_LETTERS) -> str:
    """At most so many letters of it."""
    return text if len(text) <= most else f"{text[:most]}…"


def listed(names: Sequence[str], most: int) -> str:
    """``a, b and 3 more``: at most so many of them, and how many others there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


class Progress(Protocol):
    """How a stage speaks while it works. Both calls are cheap and may be made from any thread."""

    def update(self, message: str, done: float | None = None) -> None:
        """Replace the live line; ``done`` is the finished share in [0, 1], None where it is unknown."""
        ...

    def note(self, message: str) -> None:
        """Print a line that stays: a decision and its reason, or a warning."""
        ...


@dataclass(frozen=True)
class StageResult:
    """What a stage hands back once its files are written.

    ``outputs`` and ``records`` are paths relative to the stage's folder; a folder stands for all files below it.
    Outputs are digested and decide what runs downstream, so they hold no time stamp, timing or absolute path;
    those go into records. ``facts`` are plain JSON values for summary.json and the report; ``line`` is the
    stage's one-line summary for the user.
    """

    outputs: tuple[str, ...]
    line: str
    records: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)


Inputs = Mapping[str, Path]
