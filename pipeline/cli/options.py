"""The settings of a run, filled from a TOML file and the command line; what makes no sense is refused."""

import difflib
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import STAGES
from pipeline.engine.workspace import RUN_FILE, Workspace, default_workspace, is_result, lasting, photo_set
from stages.contract import bounded
from stages.effects.effect_list import EFFECTS
from stages.ingest.sources import find_source, is_gone
from stages.train.config import OPTIONS_OF_FIELD

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

MAX_WRONG, MAX_LETTERS = 10, 100  # options in one error, and letters of a name or value in it
WORDS_ALONE = {
    (stage, name): word
    for stage in ("ingest", "sfm")
    for name, word in {"photos": "PHOTOS", "cameras": "--cameras"}.items()
}


class UsageError(Exception):
    """A command line or config file that makes no sense; shown in one line, exit code 2."""


def read_toml(path: Path) -> dict[str, Any]:
    """The options in a TOML file: tables named by stage, the same keys as the flags. Raises UsageError for a file that
    is none, and where photos and cameras stand in it, which are the command's own words."""
    try:
        values = tomllib.loads(path.read_text("utf-8-sig"))  # -sig: Windows writes a byte order mark
    except OSError as error:
        raise UsageError(f"--config {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--config {path} is not TOML: {error}") from error
    for (stage, option), word in WORDS_ALONE.items():
        if isinstance(table := values.get(stage), dict) and option in table:
            raise UsageError(f"--config {path}: a file cannot set {stage}.{option}; give {word} instead")
    return values


def settings_from(values: Mapping[str, Any], origin: str) -> Settings:
    """Validate ``values`` (stage → option → value). Raises UsageError naming every wrong key and its origin."""
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"{origin}: {wrong_options(error)}") from error


def wrong_options(error: ValidationError, *parents: str) -> str:
    """Every wrong option below ``parents`` with what it must be: ``train.steps 0 must be at least 1; …``."""
    wrong = [_wrong_option(bounded(".".join([*parents, *map(str, e["loc"])]), MAX_LETTERS), e) for e in error.errors()]
    more = f"; and {len(wrong) - MAX_WRONG} more" if len(wrong) > MAX_WRONG else ""
    return "; ".join(wrong[:MAX_WRONG]) + more


def _wrong_option(name: str, problem: "ErrorDetails") -> str:
    name = name.replace("_", "-") if name.startswith("--") else name
    if problem["type"] == "extra_forbidden":
        return f"there is no option {name}"
    if problem["type"] == "value_error":
        reason = problem["msg"].removeprefix("Value error, ")
        return reason if reason.startswith("--") else f"{name}: {reason}"  # of several options it names them itself
    must = problem["msg"].removeprefix("Input should ")
    for long, short in (("greater than or equal to", "at least"), ("less than or equal to", "at most")):
        must = must.replace(long, short)
    return f"{name} {bounded(str(problem['input']), MAX_LETTERS)} must {must}"


def with_effects(settings: Settings, choices: Sequence[str]) -> Settings:
    """The settings of all stages with each effect of ``NAME=on|off|auto`` forced, or not any more; the last one wins.

    Raises UsageError for another name or value, with those that there are.
    """
    names = [effect.name for effect in EFFECTS]
    force: dict[str, Any] = dict(settings.effects.force)
    for choice in choices:
        name, _, value = choice.partition("=")
        if name.replace("-", "_") not in names:
            raise UsageError(f"--effect {choice}: no effect {name!r}; there are: {', '.join(names)}")
        if value not in ("on", "off", "auto"):
            raise UsageError(f"--effect {choice}: {name} can be on, off or auto, as in --effect {name}=on")
        force[name.replace("-", "_")] = value
    force = {name: value for name, value in force.items() if value != "auto"}
    return settings.model_copy(update={"effects": settings.effects.model_copy(update={"force": force})})


def with_source(settings: Settings, photos: Path, cameras: Path | None) -> Settings:
    """The settings with PHOTOS (and known cameras, if any) filled in. Raises StageError where PHOTOS is unusable,
    UsageError where the photo to render like is none of them or the cameras to render are not there: better now than
    after the training."""
    source = find_source(photos, cameras, settings.ingest.photo_list)
    names, like = [source.name(file) for file in source.files], settings.render.match_exposure
    if like is not None and source.kind != "video" and like not in names:
        near = difflib.get_close_matches(like, names, n=3)
        raise UsageError(
            f"--match-exposure {like}: no photo has that name" + (f"; perhaps {', '.join(near)}" if near else "")
        )
    if (rendered := settings.render.cameras) is not None and not rendered.is_file():
        raise UsageError(f"--render.cameras {rendered}: there is no such file")
    given = None if cameras is None else cameras.absolute()
    imported = None if source.cameras is None else source.cameras.absolute()
    return settings.model_copy(
        update={
            "ingest": settings.ingest.model_copy(update={"photos": photos.absolute(), "cameras": given}),
            "sfm": settings.sfm.model_copy(update={"photos": photos.absolute(), "cameras": imported}),
        }
    )


def check_fitted_poses(settings: Settings) -> None:
    """Raises UsageError where stage evaluate would refuse to fit poses: better now than after the training."""
    field = settings.train.kind
    if settings.evaluate.fit_poses == "on" and not OPTIONS_OF_FIELD[field].tells_ray_gradients:
        what = f"--evaluate.fit-poses on has no effect with the {field} field, which the options of training ask for"
        raise UsageError(f"{what}; give --evaluate.fit-poses auto")


def with_lasting_files(settings: Settings, root: Path) -> Settings:
    """The settings with cameras and a list of photos that the workspace shows in its ``output/`` named where they stay
    (:func:`lasting`): a stage that reads them may be the one whose results are taken out of there before it begins."""
    changed: dict[str, dict[str, Path]] = {}
    for stage, name in (("render", "cameras"), ("ingest", "photo_list")):
        if (file := getattr(getattr(settings, stage), name)) is not None:
            changed[stage] = {name: lasting(file, root)}
    if (cameras := settings.sfm.cameras) is not None and (stays := lasting(cameras, root)) != cameras:
        # Also where the whole output/ was given, in which there may be none the next time.
        for stage in ("sfm", "ingest"):
            changed[stage] = {**changed.get(stage, {}), "cameras": stays}
    options = {stage: getattr(settings, stage).model_copy(update=update) for stage, update in changed.items()}
    return settings.model_copy(update=options)


def check_workspace(root: Path, photos: Path) -> None:
    """Raises UsageError where the workspace, or a folder in it that a run writes to, would lie right among the photos:
    what a run writes is none of them; and where the photos are a result of it, which a run takes out of its
    ``output/`` before it reads them."""
    places = [place for place in (photos, photos / "images") if photos.is_dir() and not (place / RUN_FILE).is_file()]
    real = {os.path.realpath(place) for place in places}
    for name in (*STAGES, "output"):
        if os.path.realpath(root / name) in real:
            what = f"the photos lie in its folder {name}, to which a run writes"
            raise UsageError(f"-o {root}: {what}; give another folder with -o")
    if os.path.realpath(root) in real:
        better = f"leave out -o to write to {default_workspace(photos)}, or give another folder"
        raise UsageError(f"-o {root}: that is a folder of photos; {better}")
    if is_result(photos, root):
        what = f"{photos} is a result in that workspace, which the new run would replace"
        raise UsageError(f"-o {root}: {what}; give another folder with -o")


def check_same_photos(workspace: Workspace, photos: Path) -> None:
    """Raises UsageError where a workspace that nobody named was made from another set of photos that is still there:
    its results would make way for those of PHOTOS. Where the old one is gone, it was moved or renamed."""
    recorded = workspace.read_run().options.get("ingest", {}).get("photos")
    if not isinstance(recorded, str) or is_gone(Path(recorded)) or is_gone(photos):
        return
    before, now = photo_set(Path(recorded)), photo_set(photos)
    if os.path.realpath(before) != os.path.realpath(now):
        name = workspace.root.name
        ways = f"give -o another.nerf to keep them apart, or -o {name} to use it for the new photos"
        raise UsageError(f"{name} was made from {before}, not from {now}; {ways}")
