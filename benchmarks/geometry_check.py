"""How many deliberately moved photos the check of poses finds, and how many good ones it blames.

    python -m benchmarks.geometry_check WORKSPACE [--moved 200] [--database FILE.db] [--out FILE.json]

WORKSPACE has a finished stage sfm whose cameras are right. Its photos are matched anew (the database is not kept),
unless a database of the same photos is given. Groups of 1 to 20 neighbours in the order of names are turned by 2 to 30
degrees or shifted by 5 to 500 % of the usual step, until so many photos were moved. What moves points by less than
twice the tolerance in the photo is below the noise and counted apart. Photos that only the moved group links to the
rest are nobody's false alarm: nothing is left that holds them.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.record import Record, add_out
from stages.io.photos import Photo, read_photos
from stages.sfm.colmap.database.extraction import ExtractionOptions, extract_features
from stages.sfm.colmap.database.features import Features, image_similarity, read_vocabulary
from stages.sfm.colmap.database.images import MAPPING_MODEL, fill_database
from stages.sfm.colmap.database.matching import STRICT_RATIO, match_pairs
from stages.sfm.colmap.model_check import ModelCheck, camera_poses, check_model
from stages.sfm.colmap.models import load_native
from stages.sfm.pairs.image_retrieval import CELLS
from stages.sfm.pairs.match_graph import connected, natural_order, pairs_apart
from stages.sfm.pairs.pair_selection import nearest, union
from stages.sfm.pose_check import CONTRADICTION_FACTOR, check_poses

SIZES = (1, 1, 1, 2, 3, 5, 10, 20)


class Move(NamedTuple):
    """A group that was moved: how, how many photos, by how many pixels at the usual depth, how many were found; how
    many others are linked without it, and how many of them were blamed."""

    kind: str
    photos: int
    pixels: float
    found: int
    others: int
    blamed: int


def main() -> None:
    """Move, check, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--moved", type=int, default=200)
    parser.add_argument("--database", type=Path, help="features and matches of these photos")
    add_out(parser)
    asked = parser.parse_args()
    ingest, sfm = (next((asked.workspace / stage).glob("*[0-9a-f]")) for stage in ("ingest", "sfm"))
    checked, poses, depth, names = right_model(ingest, sfm / "sparse", asked.database)
    print(f"{len(names)} photos, {len(checked.matches.pairs)} pairs, tolerance {checked.check.tolerance_px:.2f} px; ")
    print(f"unmoved: {int((~checked.check.passed).sum())} blamed")
    moves = [*moved(checked, poses, depth, natural_order(names), asked.moved)]
    floor = CONTRADICTION_FACTOR * checked.check.tolerance_px
    above = [move for move in moves if move.pixels >= floor]
    photos, found = sum(move.photos for move in above), sum(move.found for move in above)
    others = sum(move.others for move in moves)
    Record(asked.out).add(
        photos=len(names),
        noise_floor_px=round(floor, 2),
        moved_above_noise=photos,
        found_share=round(found / max(1, photos), 3),
        moved_below_noise=sum(move.photos for move in moves) - photos,
        blamed_share=round(sum(move.blamed for move in moves) / others, 4),
    )


def right_model(ingest: Path, sparse: Path, database: Path | None) -> tuple[ModelCheck, np.ndarray, float, list[str]]:
    """The check of the model as it is, poses, usual depth of points and names of its photos."""
    model = load_native(sparse)
    registered = {model.image(i).name for i in model.reg_image_ids()}
    photos = sorted((p for p in read_photos(ingest) if not p.near_duplicate_of), key=lambda photo: photo.file)
    assert {photo.image_name for photo in photos} == registered, "all photos have to be registered"
    with tempfile.TemporaryDirectory() as scratch:
        if database is None:
            database = Path(scratch, "matches.db")
            match(database, ingest / "images", photos)
        checked = check_model(model, database, 0)
    poses = camera_poses(model)
    points = np.array([model.point3D(i).xyz for i in sorted(model.point3D_ids())[::20]])
    depth = float(np.median(np.linalg.norm(points[:, None] - poses[None, :, :, 3], axis=2)))
    return checked, poses, depth, [photo.name for photo in photos]


def match(database: Path, images: Path, photos: Sequence[Photo]) -> None:
    """Match neighbours in the order of names, and the most similar photos."""
    fill_database(database, photos, MAPPING_MODEL)
    extract_features(database, images, photos, ExtractionOptions(1600, 4096))
    order = natural_order([photo.name for photo in photos])
    pairs = union(pairs_apart(order, 1, 5), nearest(image_similarity(database, len(photos), 0), 10))
    features = Features(read_vocabulary(database, len(photos), 0, CELLS))
    match_pairs(database, pairs, 0, STRICT_RATIO, features=features)


def moved(checked: ModelCheck, poses: np.ndarray, depth: float, order: np.ndarray, count: int) -> "Sequence[Move]":
    """Groups moved one after the other, until so many photos were."""
    random, moves = np.random.default_rng(0), []
    step = float(np.median(np.linalg.norm(np.diff(poses[order, :, 3], axis=0), axis=1)))
    focal = float(np.median(checked.matches.focal_px))
    while sum(move.photos for move in moves) < count:
        size = min(int(random.choice(SIZES)), len(poses) // 4)
        begin = int(random.integers(len(poses) - size + 1))
        group = order[begin : begin + size]
        axis = random.normal(size=3)
        axis /= np.linalg.norm(axis)
        wrong = poses.copy()
        if random.random() < 0.5:
            kind, degrees = "turn", float(np.exp(random.uniform(np.log(2), np.log(30))))
            turn, middle = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix(), poses[group, :, 3].mean(axis=0)
            wrong[group, :, :3] = turn @ wrong[group, :, :3]
            wrong[group, :, 3] = (wrong[group, :, 3] - middle) @ turn.T + middle
            pixels = float(np.radians(degrees) * focal)
        else:
            kind, steps = "shift", float(np.exp(random.uniform(np.log(0.05), np.log(5))))
            wrong[group, :, 3] += steps * step * axis
            pixels = steps * step / depth * focal
        failed, others = ~check_poses(checked.matches, wrong).passed, linked_without(group, checked)
        found, blamed = int(failed[group].sum()), int(failed[others].sum())
        moves.append(Move(kind, size, pixels, found, int(others.sum()), blamed))
    return moves


def linked_without(group: np.ndarray, checked: ModelCheck) -> np.ndarray:
    """Which photos agreeing pairs link to most others, none of them of the group."""
    pairs = checked.matches.pairs[checked.check.agrees & ~np.isin(checked.matches.pairs, group).any(axis=1)]
    linked = np.zeros((len(checked.ids), len(checked.ids)), bool)
    linked[tuple(pairs.T)] = linked[tuple(pairs.T[::-1])] = True
    return connected(linked) == 0


if __name__ == "__main__":
    main()
