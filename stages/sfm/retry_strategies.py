"""What structure-from-motion tries while photos have no place: a fixed list, cheapest first. Runs in the child.

Each attempt changes one thing against the first and says so. What came of it is on disk before the next one begins
(``attempts/`` in the stage's folder), so that whatever ends the process costs one attempt at most.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from stages.io.files import write_durably

# Another beginning maps all photos anew, new features or another idea of the lens cost as much as the first attempt:
# they wait until so many are missing. Where the model holds all but a few, its beginning and its lens are not at fault.
WORTH_STARTING_OVER = 0.1  # of all; for features and the lens two at least, since one may well be a stranger
# Nor is mapping again, minutes of many photos, for a blurred one among them: the others show what it shows.
WORTH_ANOTHER = 0.02
# The lens is chosen and everything adjusted in 0.8 to 1.6 times the time of mapping
# (docs/experiments/camera_models.md).
FINISHING = 2.0
NO_TIME, OUT_OF_TIME = "too little was left of", "ran out of time"
GIVEN_UP, GIVEN = "--sfm.max-seconds", "the time it is given (--budget or --sfm.seconds)"
JOURNAL, ABANDONED = "journal.json", "abandoned.json"


class Effort(NamedTuple):
    """What incremental mapping asks of its first pair; as it stands, COLMAP's defaults.

    What it asks of every photo after it is never lowered: with half as many matches photos of another scene, too, find
    a place (tests/end_to_end/test_hard_photos.py).
    """

    matches: int = 100
    angle_deg: float = 16.0
    forward_motion: float = 0.95  # share of the pair's motion along its view
    seed: int = 0  # added to the run's
    without_structure: bool = False  # place photos by other photos where points are too few: minutes on false matches


FEWEST_MATCHES = 30  # of a photo with points of the model, for its place to be sure; COLMAP's default
# A quarter of the angle and half of the matches: what a first pair with little baseline still has.
WEAK_START = Effort(50, 4.0, 1.0)
OTHER_SEED = Effort(seed=1)


class Attempt(NamedTuple):
    """One way to get at cameras. ``matches``: new ones, or those of the best attempt so far ("same"); ``effort`` of
    incremental mapping, None for global mapping."""

    name: str
    words: str
    matches: Literal["strict", "row", "loose", "same", "fisheye", "rich"]
    effort: Effort | None


ATTEMPTS = (
    Attempt("first", "", "strict", Effort(without_structure=True)),
    Attempt("in order", "mapping by matches of photos taken one after the other alone", "row", Effort()),
    Attempt("fisheye", "verifying and mapping again, as if through a fisheye lens", "fisheye", Effort()),
    Attempt("looser matching", "matching them again, less strictly", "loose", Effort()),
    Attempt("weaker start", "mapping again, asking less of the first pair", "same", WEAK_START),
    Attempt("other seed", "mapping again, with another seed", "same", OTHER_SEED),
    Attempt("all at once", "mapping again, all photos at once", "same", None),
    Attempt("more features", "searching twice as many features at twice the size", "rich", WEAK_START),
)


@dataclass(frozen=True)
class Tried:
    """What came of an attempt: the file name of its database, the files in each sub-model, best first, and of the best
    one its points, its mean error, where another one contradicts it (``conflict``), by file why photos were excluded
    from it, whether the row of photos fell apart in it (``folded``), and how a ``second_opinion`` compares. ``seconds``
    are those of each phase."""

    name: str
    database: str
    groups: list[list[str]] = field(default_factory=list)
    points: int = 0
    reprojection_px: float | None = None
    conflict: dict[str, Any] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    match_graph: dict[str, Any] | None = None
    excluded: dict[str, str] = field(default_factory=dict)
    folded: bool = False
    second_opinion: dict[str, Any] | None = None

    @property
    def rank(self) -> tuple[int, int, float]:
        """Greater is better: more registered photos, then more points, then a smaller error."""
        return (len(self.groups[0]), self.points, -(self.reprojection_px or 0.0)) if self.groups else (0, 0, 0.0)


class Journal:
    """The attempts so far, on disk, and why others were ``passed`` over, by their names. ``model(name)`` is where an
    attempt's best sub-model is kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        tried, passed = read_kept(folder / JOURNAL) or ([], {})
        self.tried = [Tried(**entry) for entry in tried]
        self.passed: dict[str, str] = passed
        self.abandoned: dict[str, str] = dict(read_kept(folder / ABANDONED))  # by attempt, what became of it

    def model(self, name: str) -> Path:
        """The folder of an attempt's best sub-model."""
        return self.folder / name.replace(" ", "-")

    def left(self) -> tuple[Attempt, ...]:
        """What may still be tried: all after the last attempt made. What was passed over before that is left out."""
        names = [attempt.name for attempt in ATTEMPTS]
        return ATTEMPTS[names.index(self.tried[-1].name) + 1 :] if self.tried else ATTEMPTS

    def add(self, tried: Tried) -> None:
        """Note an attempt, durably, and those passed over before it."""
        self.tried.append(tried)
        content = [asdict(one) for one in self.tried], self.passed
        write_durably(self.folder / JOURNAL, json.dumps(content).encode())

    def best(self) -> Tried | None:
        """The best attempt that led to a model; of equals the first."""
        return max((tried for tried in self.tried if tried.groups), key=lambda tried: tried.rank, default=None)

    def account(self) -> list[dict[str, Any]]:
        """What registration.json says of each attempt that was made or passed over; one of those made is kept."""
        kept, made = self.best(), {tried.name: tried for tried in self.tried}
        rows = []
        for name in (attempt.name for attempt in ATTEMPTS):
            if one := made.get(name):
                facts = {"points": one.points, "reprojection_px": one.reprojection_px}
                registered = len(one.groups[0]) if one.groups else 0
                rows.append({"attempt": name, "registered": registered, **facts, "kept": one == kept, "passed": None})
            elif name in self.passed:
                facts = dict.fromkeys(("registered", "points", "reprojection_px"))
                rows.append({"attempt": name, **facts, "kept": False, "passed": self.passed[name]})
        return rows


def abandon(folder: Path, name: str, why: str) -> None:
    """Note, in the parent, what became of an attempt that is not to be made again in this folder."""
    folder.mkdir(parents=True, exist_ok=True)
    abandoned = dict(read_kept(folder / ABANDONED)) | {name: why}
    write_durably(folder / ABANDONED, json.dumps(sorted(abandoned.items())).encode())


def left_out_for_time(account: Sequence[Mapping[str, Any]]) -> int:
    """How many attempts of a :meth:`Journal.account` were not made, or not to their end, because time was short."""
    return sum((row["passed"] or "").startswith((NO_TIME, f"it {OUT_OF_TIME}")) for row in account)


def read_kept(path: Path) -> Any:
    """What is kept in a file of the journal's folder, [] where there is none. Raises ValueError where it is damaged."""
    return json.loads(path.read_bytes()) if path.exists() else []


def expected_seconds(attempt: Attempt, tried: Sequence[Tried], missing: float, chosen_pairs: bool) -> float:
    """How long an attempt will take, by what those before it took. ``missing``: the share of photos without a place.

    Mapping takes as long as it did at most; it is over sooner where nothing more is found. New features are searched on
    four times the pixels and are twice as many, which is four times the products of matching and twice the mapping.
    """
    first = tried[0].seconds
    mapping = max(one.seconds["mapping"] for one in tried)
    if attempt.matches == "rich":
        return 4 * (first["features"] + first["matching"]) + 2 * mapping
    # A missing photo's pairs are matched again, or where pairs were chosen as many as the first time.
    again = {"same": 0.0, "row": 0.0, "fisheye": 1.0, "loose": 1.0 if chosen_pairs else 1 - (1 - missing) ** 2}
    return again[attempt.matches] * first["matching"] + mapping


def time_against(expected: float, tried: Sequence[Tried], left: float) -> bool:
    """Whether an attempt would not leave the time in which its model, or the best one so far, is adjusted."""
    return expected + FINISHING * max(one.seconds["mapping"] for one in tried) > left


class Situation(NamedTuple):
    """What the attempts so far have left: ``missing`` of ``photos`` have no place, and ``alone`` of these none in any
    other sub-model either; ``linked``: their matches with photos that have a place, or if none has any with each other,
    are enough for one; ``flat``: there is no model, and a plane or a turn explains next to all pairs; ``folded``: the
    row of photos fell apart in a model."""

    missing: int
    alone: int
    photos: int
    linked: bool
    flat: bool
    lens_is_given: bool
    folded: bool = False


def reason_against(attempt: Attempt, now: Situation) -> str | None:
    """Why an attempt cannot help or is not worth its time, None if it should be made."""
    if now.flat and attempt.matches != "loose":
        return "the photos tell nothing of depth"
    if now.folded and attempt.matches != "row":
        return "parts of the scene look alike, which these do not mend"
    if attempt.matches == "same" and not now.linked:
        return "the missing photos share too little with the others"
    if attempt.matches == "fisheye" and now.lens_is_given:
        return "the camera model is given"
    if now.missing < WORTH_ANOTHER * now.photos:
        return f"{now.missing} of {now.photos} photos missing is not worth mapping again"
    from_nothing = attempt.matches in ("fisheye", "rich")
    worth = max(2 * from_nothing, WORTH_STARTING_OVER * now.photos)
    if attempt.matches != "loose" and now.missing < worth:
        return f"{now.missing} of {now.photos} photos missing is not worth starting over"
    if from_nothing and not now.linked and now.alone < worth:  # neither the lens nor features are what they lack
        return "the missing photos fit together among themselves and share too little with the others"
    return None
