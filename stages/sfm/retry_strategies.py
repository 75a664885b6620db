"""Retry strategies: what structure-from-motion tries while images are unregistered. A fixed list, cheapest first.

Each strategy changes one thing against the first and says so. Its outcome is on disk before the next one begins
(``strategies/`` in the stage's folder), so whatever ends the worker process costs one strategy at most.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from stages.contract import Note
from stages.io.files import write_durably

# Where the model holds all but a few images, initial pair and camera model are right: these few are matched again and
# registered in it. Mapping all images anew waits until so many are missing, of all; one alone may well be a stranger.
MIN_MISSING_TO_START_OVER = 0.1
# Of the photo's longer side: 36 mm in the 35-mm format, where a fisheye of 180 degrees has 16.
MIN_LONG_FOCAL = 1.0
# Camera model selection and final bundle adjustment take 0.8 to 1.6 times as long as mapping
# (docs/experiments/camera_models.md).
FINAL_ADJUSTMENT_FACTOR = 2.0
RELAXED_COST = 2.0  # of matching a pair by the relaxed ratio: its mismatches take longer to verify
# Of extraction from as many pixels, of exact matching of as many features (docs/experiments/few_features.md).
EVEN_CONTRAST_COST, INDEXED_COST = 1.25, 0.2
ADDING = 0.4  # of the time of mapping, that a few images take to be registered in its model
MAX_SECONDS_LIMIT, TIME_GIVEN = "--sfm.max-seconds", "the time it is given (--budget or --sfm.seconds)"
LOG, ABANDONED = "outcomes.json", "abandoned.json"


class MappingOptions(NamedTuple):
    """What incremental mapping asks of its initial pair; the defaults are COLMAP's ``init_*`` options.

    What it asks of every image after it is never lowered: with half as many inliers images of another scene are
    registered, too (tests/end_to_end/test_hard_photos.py).
    """

    init_min_num_inliers: int = 100
    init_min_tri_angle_deg: float = 16.0
    init_max_forward_motion: float = 0.95
    seed_offset: int = 0  # added to the run's seed
    hold_focal: bool = True  # where all pairs together tell the focal lengths, hold these until all images are mapped
    structure_less_fallback: bool = False  # register images by other images where points are too few: slow on outliers


MIN_POSE_INLIERS = 30  # COLMAP's default of abs_pose_min_num_inliers: with fewer a pose is not sure
# A quarter of the angle and half of the inliers: what an initial pair of little baseline still has.
WEAK_INITIAL_PAIR = MappingOptions(50, 4.0, 1.0)
OTHER_SEED = MappingOptions(seed_offset=1, hold_focal=False)


class Strategy(NamedTuple):
    """One way to find the cameras. ``matches``: new ones, those of the best strategy so far ("same"), or with new ones
    of its missing photos ("missing"), whose model is then gone on with; ``mapping``: the options of incremental
    mapping, None for global mapping."""

    name: str
    description: str
    matches: Literal["strict", "consecutive", "missing", "relaxed", "same", "fisheye", "more features"]
    mapping: MappingOptions | None


STRATEGIES = (
    Strategy("default", "", "strict", MappingOptions(structure_less_fallback=True)),
    Strategy(
        "consecutive pairs", "mapping only matches of consecutively taken photos", "consecutive", MappingOptions()
    ),
    Strategy(
        "missing photos",
        "matching them again with a relaxed ratio test and registering them in the model",
        "missing",
        MappingOptions(),
    ),
    Strategy("fisheye", "verifying and mapping again with a fisheye camera model", "fisheye", MappingOptions()),
    Strategy("relaxed ratio test", "matching again with a relaxed ratio test", "relaxed", MappingOptions()),
    Strategy("weaker initial pair", "mapping again from a weaker initial pair", "same", WEAK_INITIAL_PAIR),
    Strategy("other seed", "mapping again with another seed and free focal lengths", "same", OTHER_SEED),
    Strategy("global mapping", "mapping again with global mapping", "same", None),
    Strategy(
        "more features",
        "extracting twice as many features from photos of twice the size and of even contrast",
        "more features",
        WEAK_INITIAL_PAIR,
    ),
)
STRICT = tuple(strategy.name for strategy in STRATEGIES if strategy.matches not in ("missing", "relaxed", "same"))


@dataclass(frozen=True)
class Outcome:
    """What came of a strategy, by its ``name``.

    ``database`` is its file name, ``groups`` the files in each sub-model, best first. Of the best one: number of
    ``points``, mean error, another sub-model that contradicts it (``conflict``), by file why images were ``excluded``,
    whether the sequence of photos is broken in it (``sequence_broken``), whether it fits its verified matches as a
    whole (``fits``), and its comparison with ``global_mapping``. ``seconds`` are those of each phase.
    """

    name: str
    database: str
    groups: list[list[str]] = field(default_factory=list)
    points: int = 0
    reprojection_px: float | None = None
    conflict: dict[str, Any] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    match_graph: dict[str, Any] | None = None
    excluded: dict[str, Note] = field(default_factory=dict)
    sequence_broken: bool = False
    fits: bool = True
    global_mapping: dict[str, Any] | None = None

    @property
    def rank(self) -> tuple[bool, int, int, float]:
        """Greater is better: one that fits, then more registered images, then more points, then a smaller error."""
        if not self.groups:
            return (False, 0, 0, 0.0)
        return (self.fits, len(self.groups[0]), self.points, -(self.reprojection_px or 0.0))


class Skip(NamedTuple):
    """Why a strategy is skipped, in words, and whether it is for want of time."""

    why: str
    for_time: bool = False


class StrategyLog:
    """The ``outcomes`` so far, on disk, and by name why strategies were ``skipped``. ``abandoned`` are, by name, those
    in which the worker process ended."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        outcomes, skipped = read_kept(folder / LOG) or ([], {})
        self.outcomes = [Outcome(**entry | {"excluded": read_notes(entry["excluded"])}) for entry in outcomes]
        self.skipped = {name: Skip(*why) for name, why in skipped.items()}
        self.abandoned = _read_abandoned(folder)

    def model(self, name: str) -> Path:
        """The folder of a strategy's best sub-model."""
        return self.folder / name.replace(" ", "-")

    def left(self) -> tuple[Strategy, ...]:
        """What may still be tried: all after the last strategy tried. What was skipped before that is left out."""
        names = [strategy.name for strategy in STRATEGIES]
        return STRATEGIES[names.index(self.outcomes[-1].name) + 1 :] if self.outcomes else STRATEGIES

    def add(self, outcome: Outcome) -> None:
        """Note an outcome, durably, and the strategies skipped before it."""
        self.outcomes.append(outcome)
        content = [asdict(one) for one in self.outcomes], self.skipped
        write_durably(self.folder / LOG, json.dumps(content).encode())

    def best(self) -> Outcome | None:
        """The best outcome that has a model; of equals the first."""
        return max((one for one in self.outcomes if one.groups), key=lambda one: one.rank, default=None)

    def sequence_broken(self) -> bool:
        """Whether the sequence of photos was broken in a model of strict matches. Relaxed ones, which the strategies of
        the same matches map again, hold enough false ones to break any."""
        return any(one.sequence_broken and one.name in STRICT for one in self.outcomes)

    def report(self) -> list[dict[str, Any]]:
        """What registration.json says of each strategy that was tried or skipped; one of those tried is kept."""
        kept, tried = self.best(), {one.name: one for one in self.outcomes}
        rows = []
        for name in (strategy.name for strategy in STRATEGIES):
            if one := tried.get(name):
                facts = {"points": one.points, "reprojection_px": one.reprojection_px}
                registered = len(one.groups[0]) if one.groups else 0
                rows.append({"strategy": name, "registered": registered, **facts, "kept": one == kept, "skipped": None})
            elif name in self.skipped:
                facts = dict.fromkeys(("registered", "points", "reprojection_px"))
                rows.append({"strategy": name, **facts, "kept": False, "skipped": self.skipped[name].why})
        return rows

    def skipped_for_time(self) -> int:
        """How many strategies were skipped, or cut short, because time was short."""
        tried = {one.name for one in self.outcomes}
        return sum(why.for_time for name, why in self.skipped.items() if name not in tried)


def read_notes(kept: Mapping[str, Sequence[str]]) -> dict[str, Note]:
    """Notes by name, as JSON gives them back."""
    return {name: Note(*note) for name, note in kept.items()}


def abandon(folder: Path, name: str, why: Skip) -> None:
    """Note, in the parent process, how the worker ended in a strategy that is not to be tried again in this folder."""
    folder.mkdir(parents=True, exist_ok=True)
    abandoned = _read_abandoned(folder) | {name: why}
    write_durably(folder / ABANDONED, json.dumps(sorted(abandoned.items())).encode())


def _read_abandoned(folder: Path) -> dict[str, Skip]:
    return {name: Skip(*why) for name, why in read_kept(folder / ABANDONED)}


def read_kept(path: Path) -> Any:
    """The content of a file in the log's folder, [] where there is none. Raises ValueError where it is damaged."""
    return json.loads(path.read_bytes()) if path.exists() else []


def expected_seconds(strategy: Strategy, outcomes: Sequence[Outcome], rematched: float, enlarged: float) -> float:
    """How long a strategy will take, by what those before it took. ``rematched``: the pairs that it matches again, over
    those that were matched first (a pair that was matched exactly and is no more counts INDEXED_COST); ``enlarged``:
    the pixels that it extracts features from, over the first's.

    Mapping takes as long as it did at most; it is over sooner where nothing more is found. More pixels yield more
    features, at most twice as many, which is four times the matching and twice the mapping.
    """
    first, mapping = outcomes[0].seconds, mapping_seconds(outcomes)
    if strategy.matches == "more features":
        more = min(2.0, max(1.0, enlarged))
        extraction = EVEN_CONTRAST_COST * enlarged * first["features"]
        return extraction + more**2 * rematched * first["matching"] + more * mapping
    relaxed = RELAXED_COST * rematched * first["matching"]
    if strategy.matches == "missing":
        return relaxed + ADDING * mapping
    again = {"same": 0.0, "consecutive": 0.0, "fisheye": first["matching"], "relaxed": relaxed}
    return again[strategy.matches] + mapping


def mapping_seconds(outcomes: Sequence[Outcome]) -> float:
    """How long incremental mapping took at most."""
    incremental = {strategy.name for strategy in STRATEGIES if strategy.mapping}
    return max(one.seconds["mapping"] for one in outcomes if one.name in incremental)


def exceeds_time(expected: float, outcomes: Sequence[Outcome], left: float) -> bool:
    """Whether a strategy would not leave the time for the final bundle adjustment of its model, or of the best so
    far."""
    return expected + FINAL_ADJUSTMENT_FACTOR * mapping_seconds(outcomes) > left


class Situation(NamedTuple):
    """What the strategies so far have left.

    ``missing`` of ``images`` are unregistered, and ``alone`` of these are in no other sub-model either. ``linked``:
    their matches with registered images, or with each other if none is registered, are enough to register one.
    ``planar``: there is no model, and nearly all pairs are planar or pure rotations. ``sequence_broken``: the sequence
    of photos is broken in a model. ``misfit``: the best model does not fit its matches, so all images count as missing.
    ``long_lenses``: EXIF tells of every photo a focal length beyond MIN_LONG_FOCAL.
    """

    missing: int
    alone: int
    images: int
    linked: bool
    planar: bool
    camera_model_is_given: bool
    sequence_broken: bool = False
    misfit: bool = False
    long_lenses: bool = False


def reason_against(strategy: Strategy, now: Situation) -> str | None:
    """Why a strategy cannot help or is not worth its time, None if it should be tried."""
    if now.planar and strategy.matches != "relaxed":
        return "the photos show no depth"
    if now.sequence_broken and strategy.matches != "consecutive":
        return "the scene has repeated structure"
    if now.misfit and strategy.matches in ("relaxed", "more features"):
        return "there are enough matches, but the cameras do not fit them"
    if strategy.matches == "same" and not now.linked:
        return "the missing photos share too few matches with the others"
    if strategy.matches == "fisheye" and now.camera_model_is_given:
        return "the camera model is given"
    if strategy.matches == "fisheye" and now.long_lenses:
        return "no fisheye has focal lengths as long as EXIF tells"
    worth = MIN_MISSING_TO_START_OVER * now.images
    if strategy.matches == "missing":
        if now.missing == now.images:
            return "there is no model that photos could be added to"
        too_many = now.missing >= max(2, worth)
        return f"{now.missing} of {now.images} photos are too many to add to a model" if too_many else None
    if strategy.matches not in ("consecutive", "same"):  # these cost as much as the first strategy, or nearly
        worth = max(2, worth)
    if now.missing < worth:
        return f"starting over is not worth it for {now.missing} of {now.images} photos"
    from_nothing = strategy.matches in ("fisheye", "more features")
    if from_nothing and not now.linked and now.alone < worth:  # neither camera model nor features are what they lack
        return "the missing photos form models of their own and share too few matches with the others"
    return None
