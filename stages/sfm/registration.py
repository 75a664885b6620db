"""Which photos are registered, and why the others are not: read from COLMAP's database of features and matches.

Plain SQLite, read-only, and never in a process that has the same database open through pycolmap: two copies of SQLite
in one process undo each other's locks and damage the file (https://sqlite.org/howtocorrupt.html, section 2.2.1).
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from stages.contract import Note, StageError, listed
from stages.ingest.masks import STILL_BACKGROUND_HINT
from stages.io.photos import Photo
from stages.sfm.degeneracy import count_pure_rotations, epipoles_inside, flow_is_radial
from stages.sfm.retry_strategies import MIN_POSE_INLIERS

MIN_REGISTERED = 3  # one to hold out, two to learn from; two views alone fit many wrong scenes
MIN_MODEL_POINTS = 100
MIN_FEATURES = 50
MAX_NAMES = 5
PHOTO_GROUPS = "photo_groups"  # the folder of lists of photos that other sub-models than the best one have
MAX_SAME_VIEW_PX = 1.0
PLANAR_CONFIGS = (4, 5, 6)  # colmap TwoViewGeometry: PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC
PAIR_BASE = 2**31 - 1  # pair_id = PAIR_BASE * first image id + second image id
NEAR_DUPLICATE = "sfm.unregistered-near-duplicate"
OVERLAP_HINT = "Take photos with 60–80% overlap, so that each point is visible in at least three of them."


@dataclass(frozen=True)
class Matches:
    """The verified among ``tried`` pairs of photos; photos are numbered from 0 in order of ``file``.

    ``sizes``: their widths and heights as their cameras have them. ``planar``: a plane or a pure rotation explains the
    pair (COLMAP's PLANAR_OR_PANORAMIC), so it tells nothing of depth; ``homography`` is that map (zero where there is
    none). ``forward``: forward motion, towards something in the picture or away from it. ``shift_px``: median distance
    between matched keypoints.
    """

    keypoints: Int[np.ndarray, "photos"]
    tried: int
    sizes: Int[np.ndarray, "photos 2"]
    pairs: Int[np.ndarray, "pairs 2"]
    planar: Bool[np.ndarray, "pairs"]
    homography: Float[np.ndarray, "pairs 3 3"]
    forward: Bool[np.ndarray, "pairs"]
    shift_px: Float[np.ndarray, "pairs"]


@contextmanager
def _opened(database: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=0.2)) as connection:
        yield connection


def first_database(folder: Path) -> Path:
    """The database of features and matches of the first strategy. COLMAP's version is in its name, for it is not part
    of the key that the stage's folder has."""
    return folder / f"matches-{version('pycolmap')}.db"


def count_done(database: Path) -> tuple[int, int]:
    """How many photos have features and how many pairs are matched; (0, 0) where there is nothing to read yet or
    the database is damaged."""
    try:
        with _opened(database) as db:
            photos = db.execute("SELECT COUNT(*) FROM descriptors").fetchone()[0]
            return photos, db.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]
    except sqlite3.DatabaseError:  # also: not created yet, or locked for a moment
        return 0, 0


def is_sound(database: Path, names: Sequence[str]) -> bool:
    """Whether the database is undamaged and holds exactly these images, or none yet."""
    try:
        with _opened(database) as db:
            if db.execute("PRAGMA quick_check").fetchone() != ("ok",):
                return False
            entered = [name for (name,) in db.execute("SELECT name FROM images ORDER BY image_id")]
    except sqlite3.DatabaseError:
        return False
    return entered in ([], list(names))


def read_matches(database: Path) -> Matches:
    """What feature extraction and matching found."""
    with _opened(database) as db:
        tried = db.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]
        keypoints = db.execute(
            "SELECT COALESCE(rows, 0) FROM images LEFT JOIN keypoints USING (image_id) ORDER BY image_id"
        ).fetchall()
        verified = db.execute(
            "SELECT pair_id, rows, config, data, H, F FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
        ).fetchall()
        sizes = np.array(
            db.execute("SELECT width, height FROM images JOIN cameras USING (camera_id) ORDER BY image_id").fetchall(),
            int,
        ).reshape(-1, 2)
        positions = {
            image_id - 1: np.frombuffer(data, np.float32).reshape(rows, cols)[:, :2]
            for image_id, rows, cols, data in db.execute("SELECT * FROM keypoints WHERE rows > 0")
        }
    pairs = np.array([divmod(pair_id, PAIR_BASE) for pair_id, *_ in verified], int).reshape(-1, 2) - 1
    planar = np.array([config in PLANAR_CONFIGS for _, _, config, *_ in verified], bool)
    forward = epipoles_inside(_matrices([blob for *_, blob in verified]), sizes[pairs])
    shifts = []
    for number, ((first, second), (_, rows, _, data, *_)) in enumerate(zip(pairs, verified, strict=True)):
        matched = np.frombuffer(data, np.uint32).reshape(rows, 2)
        here, there = positions[first][matched[:, 0]], positions[second][matched[:, 1]]
        shifts.append(np.median(np.linalg.norm(there - here, axis=1)))
        if planar[number]:
            forward[number] = flow_is_radial(here, there, sizes[first])
    return Matches(
        keypoints=np.array(keypoints, int).reshape(-1),
        tried=tried,
        sizes=sizes,
        pairs=pairs,
        planar=planar,
        homography=_matrices([blob for *_, blob, _ in verified]),
        forward=forward,
        shift_px=np.array(shifts, float),
    )


def _matrices(blobs: Sequence[bytes | None]) -> Float[np.ndarray, "n 3 3"]:
    return np.array([np.frombuffer(blob, float) if blob else np.zeros(9) for blob in blobs]).reshape(-1, 3, 3)


def image_rows(
    names: Sequence[str],
    matches: Matches,
    models: Sequence[Sequence[str]],
    observations: Mapping[str, int],
    supports: Mapping[str, tuple[int, int]],
    conflict: Mapping[str, Any] | None,
    left_out: Mapping[str, Note],
) -> list[dict[str, Any]]:
    """What became of each photo, for registration.json. ``models`` are the names in each sub-model, best first;
    ``supports`` as colmap/unregistered_images.py finds them, ``conflict`` as colmap/model_comparison.py; ``left_out``
    says why a camera cannot be used, by name."""
    contradicted = set(models[conflict["group"]]) if conflict else set()
    entries = []
    for index, name in enumerate(names):
        reason = None if name in models[0] else _reason(index, names, matches, models, supports[name])
        if reason and conflict and name in contradicted:
            reason = _contradiction(models, conflict)
        reason = left_out.get(name, reason)
        entries.append(
            {
                "file": name,
                "registered": name in models[0],
                **told(reason),
                "keypoints": int(matches.keypoints[index]),
                "observations": observations.get(name, 0),
            }
        )
    return entries


def photo_groups(models: Sequence[Sequence[str]]) -> dict[str, list[str]]:
    """By the file that lists them, the photos of further sub-models that may be run by themselves, the largest first:
    of at least MIN_REGISTERED photos, some of which the best one lacks. It is number 1, and has no file."""
    further = [list(model) for model in models[1:] if len(model) >= MIN_REGISTERED and not {*model} <= {*models[0]}]
    ordered = sorted(further, key=lambda model: (-len(model), model))
    return {f"{PHOTO_GROUPS}/{number}.txt": model for number, model in enumerate(ordered, start=2)}


def _where_listed(model: Sequence[str], models: Sequence[Sequence[str]]) -> str:
    file = next((file for file, photos in photo_groups(models).items() if photos == list(model)), None)
    return f" (listed in output/{file})" if file else ""


def told(reason: Note | None) -> dict[str, str | None]:
    """Why a photo is unregistered, as registration.json has it."""
    return {"reason": reason and reason.text, "reason_code": reason and reason.code}


def _contradiction(models: Sequence[Sequence[str]], conflict: Mapping[str, Any]) -> Note:
    shares = f"shares {conflict['shared']} with this model and gives {conflict['different']} of them different poses"
    index: int = conflict["group"]
    others = models[index]
    group = f"it belongs to a group of {len(others)} photos{_where_listed(others, models)} that {shares}"
    return Note("sfm.unregistered-repeated-structure", f"{group}: repeated structure")


def repeated_structure(conflict: Mapping[str, Any], name_of: Mapping[str, str]) -> str:
    """The message about a group of photos that contradicts the others, by the users' own names, and what to do."""
    others, moved = ([name_of[file] for file in conflict[key]] for key in ("others", "photos"))
    return (
        f"repeated structure: {listed(others, MAX_NAMES)} are left out, because they contradict the poses of "
        f"{listed(moved, MAX_NAMES)}. Take photos that lead from one of the similar parts of the scene to the other, "
        "or mask what repeats"
    )


def with_near_duplicates(entries: Sequence[dict[str, Any]], photos: Sequence[Photo]) -> list[dict[str, Any]]:
    """The rows of all ``photos`` in their order: those of matched photos, and of near duplicates, which ingest excludes
    from matching, as which photo."""
    known = {entry["file"]: entry for entry in entries}
    rows = []
    for photo in photos:
        reason = Note(NEAR_DUPLICATE, f"a near-duplicate of {photo.near_duplicate_of}: it adds no baseline")
        duplicate = {
            "file": photo.image_name,
            "registered": False,
            **told(reason),
            "keypoints": 0,
            "observations": 0,
        }
        rows.append(known.get(photo.image_name, duplicate))
    return rows


def _reason(
    index: int, names: Sequence[str], matches: Matches, models: Sequence[Sequence[str]], support: tuple[int, int]
) -> Note:
    """Why a photo is unregistered: the first link that is missing between its features and the model."""
    features, (seen, agreeing) = int(matches.keypoints[index]), support
    if not features:
        return Note("sfm.unregistered-no-features", "it has no features: it is blurred, dark or without texture")
    few = f" (it has only {features} features)" if features < MIN_FEATURES else ""
    mine = (matches.pairs == index).any(axis=1)
    if not mine.any():
        return Note("sfm.unregistered-no-match", f"no other photo matches it{few}")
    if others := [model for model in models[1:] if names[index] in model]:
        where = _where_listed(others[0], models)
        group = f"it belongs to a group of {len(others[0])} photos{where} that does not connect to the model"
        return Note("sfm.unregistered-other-group", group)
    partners = matches.pairs[mine].sum(axis=1) - index
    in_model = np.array([names[partner] in models[0] for partner in partners])
    if not in_model.any():
        alone = f"it matches only unregistered photos ({len(partners)} of them){few}"
        return Note("sfm.unregistered-partners", alone)
    if seen >= MIN_POSE_INLIERS and agreeing >= MIN_POSE_INLIERS:
        uncertain = f"its pose is uncertain: {agreeing} of its {seen} matches with points of the model agree on one"
        return Note("sfm.unregistered-uncertain-pose", uncertain)
    if seen >= MIN_POSE_INLIERS:
        agree = f"{agreeing} of {seen} agree on one pose, and at least {MIN_POSE_INLIERS} must"
        return Note("sfm.unregistered-contradictions", f"its matches contradict each other: {agree}")
    pairs = f"all {int(in_model.sum())} of its pairs with registered photos"
    if matches.forward[mine][in_model].all():
        return Note("sfm.unregistered-forward-motion", f"forward motion in {pairs}: too little parallax")
    if matches.planar[mine][in_model].all():
        return Note("sfm.unregistered-rotation-or-plane", f"pure rotation or a planar scene in {pairs}")
    points = f"only {seen} of its features match points of the model; it needs {MIN_POSE_INLIERS}{few}"
    return Note("sfm.unregistered-few-points", points)


def why_no_model(photos: Sequence[Photo], matches: Matches, registered: int, points: int) -> StageError:
    """The error for photos that give no model, with the cause that their pairs show."""
    pairs, verified = matches.tried, len(matches.pairs)
    what = f"the cameras of {len(photos)} photos could not be found"
    if np.median(matches.keypoints) < MIN_FEATURES:
        return StageError(
            "sfm.few-features",
            what,
            f"half of the photos show fewer than {MIN_FEATURES} features",
            "Take sharper, better lit photos, or put something with texture into the scene.",
        )
    if not verified:
        return StageError("sfm.no-overlap", what, f"none of {pairs:,} pairs of photos overlaps", OVERLAP_HINT)
    if np.median(matches.shift_px) < MAX_SAME_VIEW_PX:
        return StageError(
            "sfm.same-view",
            what,
            f"all photos show the same view ({verified:,} of {pairs:,} pairs differ by less than a pixel)",
            f"Move the camera between photos. {STILL_BACKGROUND_HINT}",
        )
    if error := _no_depth(what, photos, matches):
        return error
    why = f"{verified:,} of {pairs:,} pairs of photos overlap, but none of them shows the depth of the scene"
    if registered:
        found = f"only {registered} photos and {points} points were reconstructed"
        why = f"{found}; {verified:,} of {pairs:,} pairs overlap"
    return StageError("sfm.no-model", what, why, OVERLAP_HINT)


def _no_depth(what: str, photos: Sequence[Photo], matches: Matches) -> StageError | None:
    """The error where most pairs are degenerate, by kind."""
    count, planar, forward = len(matches.pairs), int(matches.planar.sum()), int(matches.forward.sum())
    rotations = count_pure_rotations(matches.homography[matches.planar], matches.sizes[matches.pairs[matches.planar]])
    if planar > count / 2 and rotations > planar / 2:
        return StageError(
            "sfm.pure-rotation",
            what,
            f"pure rotation: {rotations:,} of {count:,} matching pairs differ by a rotation alone",
            "Move the camera sideways between photos, by a tenth of the distance to the scene. Do not only turn it.",
        )
    if forward > count / 2:
        return StageError(
            "sfm.forward-motion",
            what,
            f"forward motion: in {forward:,} of {count:,} matching pairs the camera moves towards something in view, "
            "which leaves too little parallax",
            "Step sideways between photos as well, by a tenth of the distance to the scene, or turn the camera aside.",
        )
    if planar > count / 2:
        return StageError(
            "sfm.planar-scene",
            what,
            f"planar scene: one plane explains {planar:,} of {count:,} matching pairs",
            "Include something that stands out from the surface, and photograph it from the side as well.",
        )
    return None
