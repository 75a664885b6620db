"""The words of the command line: one dataclass per command, read by tyro; dotted flags come from the stage configs."""

import difflib
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeVar, Union, get_args

import tyro
from pydantic import ValidationError
from tyro.constructors import PrimitiveConstructorSpec, PrimitiveTypeInfo

from pipeline.cli.options import UsageError, wrong_options
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import STAGES
from stages.contract import Auto
from stages.render import Config as RenderConfig
from stages.train.config import FIELD_NAMES, PRESET_FIELDS
from stages.train.config import Config as TrainConfig

T = TypeVar("T")

Effects = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="NAME=on|off|auto", help="Turn an effect on or off, or let the photos decide (default: auto)."
    ),
]
More = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="10m",
        help="Continue the finished training for this long (90s, 10m, 1h30m or 500steps), with the recorded options. "
        "Its results so far are kept.",
        help_behavior_hint="",
    ),
]

BudgetOption = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="DURATION",
        help="Wall time for the whole command: 90s, 10m, 1h30m (default: no limit).",
        help_behavior_hint="",
    ),
]


@dataclass
class Common:
    """Options of every command that runs stages."""

    json: bool = False
    """Print one JSON object per line instead of text."""
    debug: bool = False
    """Print the traceback of an error."""
    replan: bool = False
    """Choose again what was chosen automatically, for every stage of a run or for the one that is named."""
    verify: bool = False
    """Check the sha256 of every file of finished results, and rebuild what is damaged."""
    cluster: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="auto|HOST:PORT",
            help="Share independent work with the machines of a Ray cluster; auto: the one of this machine (default: "
            "this machine alone).",
            help_behavior_hint="",
        ),
    ] = None


@dataclass
class RunArguments:
    """Turn photos into cameras, a radiance field, quality figures, a video, a mesh and a report."""

    photos: tyro.conf.Positional[Path]
    """A folder of photos, a video, a transforms.json, or a folder with transforms_train.json."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    common: Annotated[Common, tyro.conf.arg(name="")] = field(default_factory=Common)
    output: Annotated[Auto[Path], tyro.conf.arg(aliases=["-o"])] = None
    """The workspace folder (default: <photos>.nerf in the current folder)."""
    cameras: Auto[Path] = None
    """Poses to import: a transforms.json or a COLMAP model folder (default: structure-from-motion finds them)."""
    match_exposure: Auto[str] = None
    """Render the video with the exposure of this photo (its name), if the effect exposure is on."""
    effect: Effects = ()
    budget: BudgetOption = None
    until: Auto[str] = None
    """Stop after this stage (default: run all)."""
    more: More = None
    from_: Annotated[Auto[str], tyro.conf.arg(name="from")] = None
    """Run this stage and all later ones again, even if they are cached."""
    config: Auto[Path] = None
    """A TOML file with a table of options per stage. Flags override it."""
    view: bool = False
    """Show the training in the browser while it runs."""


@dataclass
class BatchArguments:
    """Run every folder of photos and every video in a folder, one after another, and rank the results on one page."""

    scenes: tyro.conf.Positional[Path]
    """The folder of scenes."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    common: Annotated[Common, tyro.conf.arg(name="")] = field(default_factory=Common)
    output: Annotated[Auto[Path], tyro.conf.arg(aliases=["-o"])] = None
    """The folder for the workspaces and the page (default: <scenes>.batch in the current folder)."""
    effect: Effects = ()
    budget: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="DURATION",
            help="Wall time for all scenes together: 30m, 2h (default: no limit).",
            help_behavior_hint="",
        ),
    ] = None
    until: Auto[str] = None
    """Stop each run after this stage (default: run all)."""
    config: Auto[Path] = None
    """A TOML file with a table of options per stage. Flags override it."""


@dataclass
class StageArguments:
    """Bring one stage of a workspace up to date, with the recorded options and the given flags."""

    workspace: tyro.conf.Positional[Path]
    """The workspace folder."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    common: Annotated[Common, tyro.conf.arg(name="")] = field(default_factory=Common)
    cameras: Auto[Path] = None
    """Only for render: a file with the cameras to render, such as output/transforms.json."""
    match_exposure: Auto[str] = None
    """Only for render: render with the exposure of this photo (its name)."""
    effect: Effects = ()
    budget: Auto[str] = None
    """Only for tradeoff: how long the study may take, such as 30m."""
    more: More = None
    force: bool = False
    """Run the stage again, even if it is cached."""


@dataclass
class ResumeArguments:
    """Repeat the recorded run: finished stages are kept, an interrupted one continues."""

    workspace: tyro.conf.Positional[Path]
    common: Annotated[Common, tyro.conf.arg(name="")] = field(default_factory=Common)
    view: bool = False
    """Show the training in the browser while it runs."""


@dataclass
class ViewArguments:
    """Show a workspace in the browser, and follow the training that runs in it. Ctrl-C leaves the training alone."""

    workspace: tyro.conf.Positional[Path]
    port: Auto[int] = None
    """The port of this machine at which the page is served (default: a free one)."""
    json: bool = False
    """Print the address as a JSON object."""


@dataclass
class StatusArguments:
    """Show the state of each stage (cached, stale, partial, failed, never) and its result in one line."""

    workspace: tyro.conf.Positional[Path]
    json: bool = False
    """Print one JSON array instead of text."""
    verify: bool = False
    """Check the sha256 of every file of finished results; exit code 1 if one is damaged."""


@dataclass
class ExplainArguments:
    """Say whether a stage would run, and why."""

    stage: tyro.conf.Positional[str]
    workspace: tyro.conf.Positional[Path]


@dataclass
class CleanArguments:
    """Delete results that the recorded options do not use."""

    workspace: tyro.conf.Positional[Path]
    dry_run: bool = False
    """List them without deleting them."""


@dataclass
class DoctorArguments:
    """Print versions, device, threads and free disk space, and run a five-second numerical self-test."""

    selftest: bool = False
    """Also measure every formula of docs/NUMERICS.md on this device, in under a minute."""
    bench: bool = False
    """Also measure matrix multiplication, random reads and copying, and the training speed they allow, in 5 s."""


@dataclass
class DemoArguments:
    """Render photos of a synthetic scene, run all stages on them and compare the result with the truth."""

    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    common: Annotated[Common, tyro.conf.arg(name="")] = field(default_factory=Common)
    effect: Effects = ()
    budget: BudgetOption = None
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """The folder for photos and workspace."""


COMMANDS: dict[str, type] = {
    "run": RunArguments,
    "batch": BatchArguments,
    "resume": ResumeArguments,
    "view": ViewArguments,
    "status": StatusArguments,
    "explain": ExplainArguments,
    "clean": CleanArguments,
    "doctor": DoctorArguments,
    "demo": DemoArguments,
}


TYPES = tyro.constructors.ConstructorRegistry()
FLAG = re.compile("--[a-zA-Z].*|-[a-zA-Z]")  # to tyro no word like that is a value


@TYPES.primitive_rule
def _chosen_or_given(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """An option that is chosen where it is None shows what may be given. "None" is read, too: it leaves the choice open
    again."""
    types = get_args(info.type)
    if NoneType not in types:
        return None
    given: Any = Union[tuple(one for one in types if one is not NoneType)]  # noqa: UP007 -- of a list of types
    spec = tyro.constructors.ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(given, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None

    def read(words: list[str]) -> Any:
        if words == ["None"]:
            return None
        if spec.choices and words[0] not in spec.choices:
            raise ValueError(f"{words[0]!r} is not one of {', '.join(spec.choices)}")
        return spec.instance_from_str(words)

    return PrimitiveConstructorSpec(
        nargs=spec.nargs,
        metavar=spec.metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )


def parse(kind: type[T], command: str, words: Sequence[str]) -> T:
    """Parse ``words``; options of stages that they do not name have their defaults.

    Raises UsageError with every wrong word in a sentence of its own, SystemExit(0) after ``--help``.
    """
    default: Any = kind(**dict.fromkeys(_positional(kind), tyro.MISSING))
    _check_none_is_empty(command, words)
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            parsed, unknown = tyro.cli(
                kind,
                prog=f"pipeline {command}",
                args=list(words),
                default=default,
                registry=TYPES,
                return_unknown_args=True,
            )
    except SystemExit as ending:
        if ending.code in (None, 0):
            raise
        wrong = _what_is_wrong(ending, said.getvalue())
        if wrong.startswith("Missing from"):
            wrong = f"too few words: {_usage(kind, command)}"
        raise UsageError(_unknown_option(kind, command, words) or f"{wrong} (pipeline {command} --help)") from ending
    if unknown:
        raise UsageError(_unknown_option(kind, command, words) or _surplus_word(kind, unknown[0]))
    return parsed


def _positional(kind: type) -> list[str]:
    """The words of a command that stand without a flag."""
    return [name for name in ("stage", "photos", "scenes", "workspace") if name in kind.__annotations__]


def _usage(kind: type, command: str, given: Mapping[str, str] | None = None) -> str:
    """``pipeline explain STAGE WORKSPACE``: a command with its words, where they are not ``given``."""
    words = ((given or {}).get(name, name.upper()) for name in _positional(kind))
    return " ".join(["pipeline", command, *words])


def _unknown_option(kind: type, command: str, words: Sequence[str]) -> str | None:
    """The first option in ``words`` that the command does not have, and what may be meant; None where it has all."""
    known = _flags(kind)
    for flag in (word.partition("=")[0] for word in takewhile(lambda word: word != "--", words)):
        if FLAG.fullmatch(flag) and flag.replace("_", "-") not in known:
            meant = _what_is_meant(kind, command, flag, words)
            return f"pipeline {command} has no option {flag}{meant} (pipeline {command} --help)"
    return None


def _what_is_meant(kind: type, command: str, flag: str, words: Sequence[str]) -> str:
    """What an option may mean that the command does not have: a word without a flag, another command, or an option
    that is spelt nearly like it."""
    name = "workspace" if flag in ("-o", "--output") else flag.removeprefix("--")
    if name in _positional(kind):
        value = _given(words, flag) or "-"
        value = name.upper() if value.startswith("-") else value
        return f"; give the {name} without it: {_usage(kind, command, {name: value})}"
    others = [other for other, its in {**COMMANDS, "STAGE": StageArguments}.items() if flag in _flags(its)]
    if others:
        return f"; it belongs to {', '.join(f'`pipeline {other}`' for other in others)}"
    own = sorted(_flags(kind))
    near = [one for one in own if one.endswith(f".{name}")] or difflib.get_close_matches(flag, own, cutoff=0.8)
    return f"; perhaps {', '.join(near)}" if near else ""


def _surplus_word(kind: type, word: str) -> str:
    if "photos" in _positional(kind) and Path(word).is_file():  # as a shell gives them for *.jpg
        return f"{word} is one file too many; give the folder that holds the photos"
    return f"{word} is one word too many"


def _flags(kind: type) -> set[str]:
    """Every spelling of every option of a command."""
    found = {"-h", "--help"}
    for name, annotation in kind.__annotations__.items():
        given, *metadata = get_args(annotation) if hasattr(annotation, "__metadata__") else (annotation,)
        if given is Settings:
            found |= {flag for stage in STAGES for flags in _flags_of(stage).values() for flag in flags}
        elif given is Common:
            found |= _flags(Common)
        elif name not in _positional(kind):
            found |= _spellings(name, given, metadata)
    return found


def _flags_of(stage: str) -> dict[str, set[str]]:
    """Every spelling of each option of a stage, by its dotted name."""
    return {
        name: _spellings(f"{stage}.{name}", option.annotation, option.metadata)
        for name, option in STAGES[stage].config.flags()
    }


def _spellings(name: str, kind: Any, metadata: Iterable[Any]) -> set[str]:
    """An option's flags: its own, what turns a switch off, and its other names."""
    *parents, last = next((entry.name for entry in metadata if getattr(entry, "name", None)), name).split(".")
    ends = (last, f"no-{last}") if kind is bool else (last,)
    aliases = {alias for entry in metadata for alias in getattr(entry, "aliases", None) or ()}
    return aliases | {"--" + ".".join([*parents, end]).replace("_", "-") for end in ends}


def _check_none_is_empty(command: str, words: Sequence[str]) -> None:
    """Raises UsageError for what a shell makes of a variable that is not set: as a path it would be this folder."""
    for before, word in pairwise([f"pipeline {command}", *words]):
        if not word or (word.startswith("-") and word.endswith("=")):
            raise UsageError(f"nothing is given after {word or before}")


def with_flags(settings: Settings, parsed: Settings, command: str, words: Sequence[str]) -> Settings:
    """``settings`` (recorded, or from a file) with the options of stages that ``words`` name, as :func:`parse` read
    them, and without those that these replace. Raises UsageError where they do not go together."""
    left = {"train": _without_replaced(settings.train, words), "render": _one_path(settings.render, command, words)}
    settings = settings.model_copy(update=left)
    named = {(stage, name) for stage in STAGES for name in _named_options(stage, words)}
    for stage in {stage for stage, _ in named}:
        values = getattr(settings, stage).model_dump()
        for name in (name for of, name in named if of == stage):
            *parents, option = name.split(".")
            table, given = values, getattr(parsed, stage)
            for parent in parents:
                table, given = table.setdefault(parent, {}), getattr(given, parent)
            table[option] = getattr(given, option)
        try:
            settings = settings.model_copy(update={stage: STAGES[stage].config.model_validate(values)})
        except ValidationError as error:
            raise UsageError(f"{wrong_options(error, f'--{stage}')} (pipeline {command} --help)") from error
    return settings


def _named_options(stage: str, words: Sequence[str]) -> Iterator[str]:
    """The dotted names of the stage's options that ``words`` give, which may be spelt with underscores."""
    given = {word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")}
    return (name for name, flags in _flags_of(stage).items() if not flags.isdisjoint(given))


def _without_replaced(recorded: TrainConfig, words: Sequence[str]) -> TrainConfig:
    """The recorded options of training without what those in ``words`` stand in place of: the budgets beside the one
    given, and all that belongs to the other field than the one given."""
    replaced = set[str]()
    if given := {option for option in ("steps", "seconds", "preset") if _gives(words, f"--train.{option}")}:
        # A preset is a budget, too, unless one is counted; and a new training does not go on from another.
        replaced |= {"steps", "seconds", "after", "more_steps", "more_seconds"} - given
    if (wanted := _given(words, "--train.field")) in FIELD_NAMES:
        replaced |= {*FIELD_NAMES} - {wanted}
        replaced |= {"preset"} if PRESET_FIELDS.get(recorded.preset or "", wanted) != wanted else set()
    return recorded.model_copy(update={name: TrainConfig.model_fields[name].default for name in replaced})


def _one_path(recorded: RenderConfig, command: str, words: Sequence[str]) -> RenderConfig:
    """The recorded options of rendering without what those in ``words`` stand in place of: a path and its length, or
    cameras from a file."""
    own = ("--cameras",) if command == "render" else ()  # of a run they are those of the photos
    replaced = {"path": None, "frames": None} if _gives(words, "--render.cameras", *own) else {}
    if _gives(words, "--render.path", "--render.frames"):
        replaced["cameras"] = None
    return recorded.model_copy(update=replaced)


def _what_is_wrong(ending: SystemExit, box: str) -> str:
    """The problem in one line: pydantic's findings where an option was refused, else what tyro put into its box."""
    fault = ending.__context__
    if fault is not None and isinstance(refused := fault.__cause__ or fault.__context__, ValidationError):
        return wrong_options(refused, "--" + str(fault.args[1]).removeprefix("settings."))
    # Drawn with lines where the terminal has them, else indented by two; the title is neither.
    lines = [line.strip(" │") for line in box.splitlines() if line.startswith(("│", "  "))]
    words = " ".join(line for line in lines if line.strip("─-"))
    for end in ("Got errors:", "Argument helptext:", "For full helptext"):
        words = words.split(end)[0]
    words = re.sub(r"invalid literal for int\(\) with base 10: ('.*')", r"\1 is not a whole number", words)
    words = re.sub(r"Could not find valid parse for arguments: \[(.*)\]", r"\1 cannot be read", words)
    words = re.sub(r"could not convert string to float: ('.*')", r"\1 is not a number", words)
    return " ".join(words.split()).removeprefix("Error parsing ").rstrip(".")


def _gives(words: Sequence[str], *options: str) -> bool:
    """Whether ``words`` give a value for one of the options, None being the way to leave it open."""
    return any(_given(words, option) not in (None, "None") for option in options)


def _given(words: Sequence[str], option: str) -> str | None:
    """What ``words`` give for an option, spelt as there; None where they do not name it."""
    for word, following in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if name == option:
            return value if equals else following
    return None


def overview(stages: Sequence[str]) -> str:
    """The text of ``pipeline --help``."""
    commands = [(name, (kind.__doc__ or "").strip()) for name, kind in COMMANDS.items()]
    lines = [f"  {name:<10} {text}" for name, text in commands]
    return "\n".join(
        [
            "usage: pipeline COMMAND …   (details: pipeline COMMAND --help)",
            "",
            "  pipeline run photos/       photos in; cameras, radiance field, video, mesh and report out",
            "",
            *lines,
            "",
            f"To run one stage of a workspace: pipeline STAGE WORKSPACE ({', '.join(stages)})",
        ]
    )
