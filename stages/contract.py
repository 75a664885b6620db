"""What a stage is and what it declares: all that stages share with the runner.

A stage is a package in this folder and one line in pipeline/engine/stage_list.py. Its ``__init__.py`` has its settings,
``Config``, what it does, ``run``, perhaps ``plan`` and what it tells of its time, and ends with ``STAGE``, a
:class:`Stage`, which says all that the runner has to know of it.

Importing a stage must be cheap: torch, pycolmap, kornia and their like are imported inside ``plan`` and ``run``.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, NamedTuple, Protocol, Self, TypeVar

from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo
from tyro.conf import Suppress, arg

MAX_LETTERS = 600  # of each part of an error
T = TypeVar("T")
# An option that is chosen for the user where it is None. Its help text says how, in the place of "(default: None)".
Auto = Annotated[T | None, arg(help_behavior_hint="")]
KEY_LENGTH = 16  # hex digits of a key that name a stage's folder: 64 bits


class Options(BaseModel):
    """Settings that stand together. Unknown keys, infinities and NaN are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def filled(self, values: Mapping[str, Any]) -> Self:
        """These options with ``values`` where they are None; for nested options, a mapping of theirs."""
        update: dict[str, Any] = {}
        for name, value in values.items():
            given = getattr(self, name)
            if isinstance(given, Options):
                update[name] = given.filled(value)
            elif given is None:
                update[name] = value
        return self.model_copy(update=update)

    @classmethod
    def flags(cls) -> Iterator[tuple[str, FieldInfo]]:
        """Every option that has a flag, nested ones by their dotted names."""
        for name, option in cls.model_fields.items():
            kind = option.annotation
            if isinstance(kind, type) and issubclass(kind, Options):
                yield from ((f"{name}.{inner}", nested) for inner, nested in kind.flags())
            elif Suppress not in option.metadata:
                yield name, option


class StageConfig(Options):
    """Settings of one stage. A ``Path`` enters keys by content."""

    @property
    def time_is_open(self) -> bool:
        """Whether the stage has an option ``seconds`` and nothing says how long it works."""
        return getattr(self, "seconds", 0.0) is None

    @property
    def exempt_from_budget(self) -> bool:
        """Whether these options give the stage a time of its own, which no budget pays for."""
        return False


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

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, str, str]]:
        """As it travels between processes."""
        return type(self), (self.code, self.what, self.why, self.hint)


def bounded(text: str, most: int = MAX_LETTERS) -> str:
    """At most so many letters of it."""
    return text if len(text) <= most else f"{text[:most]}…"


def listed(names: Sequence[str], most: int) -> str:
    """``a, b and 3 more``: at most so many of them, and how many others there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def shown(name: str) -> str:
    """A name as it may be printed: nothing in it can steer a terminal."""
    return name if name.isprintable() else repr(name)


class Note(NamedTuple):
    """A line that stays: a decision and its reason, a warning, or why a photo is missing; ``code`` is its name for
    programs, as of errors."""

    code: str
    text: str


class Progress(Protocol):
    """How a stage speaks while it works. Both calls are cheap and may be made from any thread."""

    def update(self, message: str, done: float | None = None) -> None:
        """Replace the live line; ``done`` is the finished share in [0, 1], None where it is unknown."""
        ...

    def note(self, code: str, text: str) -> None:
        """Print a :class:`Note`."""
        ...


class SilentProgress:
    """A :class:`Progress` that says nothing."""

    def update(self, message: str, done: float | None = None) -> None:
        """Say nothing."""

    def note(self, code: str, text: str) -> None:
        """Say nothing."""


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


# --- what a stage declares about its time

# Seconds that a core takes to decode a million pixels and to shrink or examine them. Decoding alone takes 0.01 to 0.02
# for JPEG, 0.03 for PNG (fox, banana, fountain_p11), all of stage ingest 0.03; large photos take longer.
READING_SECONDS = 0.04


def reading_seconds(megapixels: float, cores: int) -> float:
    """Seconds that it takes to decode photos of so many million pixels in all, which several stages do once each."""
    return READING_SECONDS * megapixels / cores


class Photos(NamedTuple):
    """The photos before any is decoded: how many, how large each is in millions of pixels, and how many have masks."""

    number: int
    megapixels: float
    masked: int = 0

    def reading_seconds(self, cores: int) -> float:
        """Seconds that it takes to decode all of them once."""
        return reading_seconds(self.number * self.megapixels, cores)


class Workload(NamedTuple):
    """What is known before a run begins, for stages to estimate their time.

    ``facts(stage, key)`` gives what a finished stage told of itself: under that key, or with None the one that the run
    will find; None where there is none, or where the run makes another. ``partial(stage)`` is the folder that the run
    resumes the stage from; None where it begins anew.
    """

    photos: Photos
    cores: int
    options: Mapping[str, Any]
    facts: Callable[[str, str | None], Mapping[str, Any] | None]
    partial: Callable[[str], Path | None] = lambda _: None


class BudgetLeft(NamedTuple):
    """What is left of a budget of ``total`` seconds as a stage begins: ``free`` of them once all that the later stages
    are expected to take is set apart, ``reserved`` of these for the least that flexible ones can do with; ``reading``
    are the seconds to decode the photos."""

    total: float
    free: float
    reserved: float
    reading: float


def _as_given(wall: float, reading: float) -> float:
    return wall


class Flexible(NamedTuple):
    """How a stage that fills the time it is given takes part in a budget."""

    share: float  # of the time that is free, beside the shares of the other flexible stages
    min_seconds: float  # less is worth nothing
    max_seconds: float = math.inf  # that stages before it leave for it
    max_share: float = 0.35  # of the whole budget, where all before it is there already
    reads_photos: bool = False  # whether decoding them comes on top of ``min_seconds``
    work: Callable[[float, float], float] = _as_given  # its option ``seconds`` by wall time and time to decode photos


# --- what a stage declares

C = TypeVar("C", bound=StageConfig)


@dataclass(frozen=True, kw_only=True)
class Stage(Generic[C]):
    """All that a stage declares."""

    name: str
    """Of its package, its command and its table of options."""
    inputs: tuple[str, ...]
    """The stages whose finished folders it reads."""
    more_inputs: Callable[[C], tuple[str, ...]] = lambda _: ()
    """Further inputs that its options ask for, treated as ``inputs`` are: they run first and enter the key."""
    dispensable: tuple[str, ...] = ()
    """Those of its inputs that may fail. Without the result of one it runs all the same, under another key; a run goes
    on when a stage fails that all later ones can do without."""
    optional_inputs: tuple[str, ...] = ()
    """Stages whose finished folders it reads if they happen to be there. They do not run for it, do not enter its key,
    and are withheld where damaged: no output may depend on them."""
    version: int
    """Raised whenever the same config and inputs would give other outputs than before."""
    exit_code: int
    """Of a command that this stage ends with an error."""
    resumes: bool = False
    """Whether it can go on from its own half-written folder; otherwise it starts clean."""
    published: tuple[str, ...]
    """The outputs or records shown in ``<workspace>/output/``."""
    config: type[C]
    """Its settings."""
    not_hashed: tuple[str, ...] = ()
    """Options that cannot change the result and so do not enter the key."""
    plan: Callable[[C, Inputs, Progress], C] | None = None
    """Replaces every ``None`` ("choose for me") by a value, where it must by timing a piece of the work. It is called
    once, before the stage's first run; the answer is kept in run.json and enters the stage's key, so a run that was
    killed continues with the same choice."""
    run: Callable[[C, Inputs, Path, Progress], StageResult]
    """``run(config, inputs, folder, progress)`` reads ``inputs[stage]`` (finished folders), writes its results into
    ``folder`` alone, and raises :class:`StageError` for everything a user can act on. ``config`` is planned. Two
    exceptions: ``--more`` reads the finished training that it continues, which is no input, from the same workspace
    (stages/train/continuation.py), and pixel stores, a cache, lie beside ingest's folder (stages/io/pixel_store.py)."""
    on_request: bool = False
    """It runs only where it is named, or where an option of another stage asks for it (``more_inputs``), and no budget
    pays for it."""
    summary: bool = False
    """It shows the whole run: of its ``inputs`` it takes what is there, with records and timings, and the account of a
    budget; it is brought up to date after whichever stage was run alone."""
    expected_seconds: Callable[[C, Workload], float | None] = lambda *_: None
    """What it takes without a budget, or what is left of that where it resumes; None where nobody can tell."""
    flexible: Flexible | None = None
    """It fills whatever seconds a budget gives it."""
    budget_seconds: Callable[[BudgetLeft], float] | None = None
    """For a stage that is not flexible but has a share of a budget: its option ``seconds`` there."""
    limiting_seconds: Callable[[Mapping[str, Any]], float | None] = lambda _: None
    """For a stage whose ``seconds`` have a limit without a budget as well: what that limit follows from in the options
    of all stages, None for no limit."""
    less_memory: str = ""
    """What may be given where memory is short: "a larger --train.downscale"."""

    def inputs_of(self, config: C) -> tuple[str, ...]:
        """The stages whose finished folders it reads under these options."""
        return (*self.inputs, *self.more_inputs(config))

    @property
    def has_share(self) -> bool:
        """Whether a budget gives it seconds, all or some of those that it takes."""
        return self.flexible is not None or self.budget_seconds is not None

    def fills_its_time(self, config: C) -> bool:
        """Whether it takes what a budget gives it."""
        return self.flexible is not None and config.time_is_open

    def is_exempt(self, config: C) -> bool:
        """Whether it is charged to no run's budget."""
        return self.on_request or config.exempt_from_budget


def plan_stage(stage: Stage[C], config: C, inputs: Inputs, progress: Progress) -> C:
    """``config`` with every "choose for me" answered, by the stage's ``plan``; as it is for a stage without one."""
    return config if stage.plan is None else stage.plan(config, inputs, progress)


def run_stage(stage: Stage[C], config: C, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Plan and run a stage without a workspace: ``inputs`` are finished folders, ``folder`` an empty one."""
    return stage.run(plan_stage(stage, config, inputs, progress), inputs, folder, progress)
