"""The stage's work: pairs are matched, photos get the distances that their neighbours agree on, points are fused.

Every pair leaves a file for each of its photos below ``pairs/``, and every photo its depth map as soon as its pairs are
there. Both appear whole or not at all, so a run that was killed continues where it was.
"""

import shutil
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from nerf.runtime.parallel import in_order, take_over_cores, workers
from stages.contract import Inputs, Progress, StageError, StageResult, listed
from stages.depth.consistency import Candidate, agreed, plausible
from stages.depth.files import FOLDER, depth_map_file, read_depth_map, write_depth_map
from stages.depth.photos import KEPT_PHOTOS, TrainingPhotos, one_thread_each, read_training_photos
from stages.depth.point_cloud import ReadMap, fuse, ply_bytes
from stages.depth.rectification import Rectified
from stages.depth.stereo_matching import MAX_VOLUME_BYTES, candidates, cost_volume_bytes
from stages.hardware.cluster import fan_out
from stages.hardware.memory import check_memory
from stages.io.amounts import counted, short_count
from stages.io.files import write_durably, write_json

if TYPE_CHECKING:
    from stages.depth import Config

CPU = torch.device("cpu")
PAIRS = "pairs"  # folder of what pairs say, as long as photos wait for it
MATCHING = 0.8  # of the stage's time
BYTES_PER_PIXEL = 200  # of a rectified pair: directions, coordinates, windows of the refinement
Pairs = Mapping[tuple[int, int], Rectified]


def estimate_depth(config: "Config", inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write a depth map for each training photo, depth.json and points.ply."""
    assert config.downscale is not None, "plan() chooses it"
    take_over_cores()
    photos = read_training_photos(inputs, config.downscale)
    pairs, left_out = photos.pairs(config.neighbours)
    if not pairs:
        raise _no_pairs(photos, left_out)
    _say_left_out(photos, pairs, left_out, progress)
    _check_memory(pairs)
    with one_thread_each():
        match_pairs(photos, pairs, folder, progress)
        progress.update("fusing points", MATCHING)
        read = depth_maps(photos, folder)
        facts, known = _facts(photos, read)
        if not known:
            raise _nothing_agrees(len(pairs))
        cloud = fuse(
            photos, read, known, lambda done: progress.update("fusing points", MATCHING + (1 - MATCHING) * done)
        )
    write_durably(folder / "points.ply", ply_bytes(cloud, photos.scene.scene_from_sfm.inverse()))
    facts |= {"pairs": len(pairs), "pairs_left_out": len(left_out), "points": len(cloud.points)}
    neighbours = {
        view.name: _names(photos, others) for view, others in zip(photos.views, _neighbours(photos, pairs), strict=True)
    }
    write_json(folder / "depth.json", facts | {"neighbours": neighbours})
    shutil.rmtree(folder / PAIRS)
    return StageResult(outputs=(FOLDER, "points.ply", "depth.json"), line=_line(photos, facts), facts=facts)


# --- pairs


def match_pairs(photos: TrainingPhotos, pairs: Pairs, folder: Path, progress: Progress) -> None:
    """Match what is not there yet, and write the depth map of each photo once all of its pairs are."""
    for name in (FOLDER, PAIRS):
        (folder / name).mkdir(exist_ok=True)
    neighbours = _neighbours(photos, pairs)
    waiting = {number: set(others) for number, others in enumerate(neighbours)}
    for number in range(len(photos.views)):
        if depth_map_file(folder, photos.views[number].file).exists():
            del waiting[number]
        elif not waiting[number]:
            _write_agreed(photos, number, [], folder)
    to_do = [
        _PairToMatch(pair, geometry, tuple(number for number in pair if number in waiting))
        for pair, geometry in pairs.items()
        if waiting.keys() & set(pair)
    ]
    here = partial(in_order, device=CPU)
    for done, pair in enumerate(fan_out(partial(_match, photos, folder), to_do, here), 1):
        for number, other in (pair, pair[::-1]):
            if number in waiting:
                waiting[number].discard(other)
                if not waiting[number]:
                    _write_agreed(photos, number, neighbours[number], folder)
                    del waiting[number]
        progress.update(f"matched {done:,} of {len(to_do):,} pairs of photos", MATCHING * done / len(to_do))


def depth_maps(photos: TrainingPhotos, folder: Path) -> ReadMap:
    """The depth maps that :func:`match_pairs` wrote, by the photos' numbers."""
    return lru_cache(KEPT_PHOTOS)(lambda number: read_depth_map(depth_map_file(folder, photos.views[number].file)))


def _neighbours(photos: TrainingPhotos, pairs: Pairs) -> list[list[int]]:
    """Of each photo with which others it is matched, in order."""
    found = [set[int]() for _ in photos.views]
    for one, other in pairs:
        found[one].add(other)
        found[other].add(one)
    return [sorted(others) for others in found]


class _PairToMatch(NamedTuple):
    """Two photos, their rectified geometry, and which of them depth is ``wanted`` of."""

    pair: tuple[int, int]
    geometry: Rectified
    wanted: tuple[int, ...]


def _match(photos: TrainingPhotos, folder: Path, task: _PairToMatch) -> tuple[int, int]:
    """Write what a pair says of its photos, unless that is there; the pair."""
    one, other = task.pair
    missing = [n for n in task.wanted if not _side_file(folder, n, one + other - n).exists()]
    if not missing:
        return task.pair
    viewpoints = photos.viewpoints[one], photos.viewpoints[other]
    with one_thread_each():
        found = candidates(task.geometry, viewpoints, (photos.pixels(one), photos.pixels(other)))
    for number, neighbour, candidate in ((one, other, found[0]), (other, one, found[1])):
        if number in missing:
            write_side(_side_file(folder, number, neighbour), candidate)
    return task.pair


def _side_file(folder: Path, number: int, neighbour: int) -> Path:
    return folder / PAIRS / f"{number:05d}-{neighbour:05d}"


def write_side(path: Path, candidate: Candidate) -> None:
    """What one neighbour says of a photo, whole or not at all."""
    write_durably(path, np.stack(candidate).astype("<f4").tobytes())


def read_side(path: Path, shape: tuple[int, int]) -> Candidate:
    """The inverse of :func:`write_side`."""
    return Candidate(*np.frombuffer(path.read_bytes(), "<f4").reshape(3, *shape))


def _write_agreed(photos: TrainingPhotos, number: int, neighbours: list[int], folder: Path) -> None:
    width, height = photos.viewpoints[number].size
    files = [_side_file(folder, number, one) for one in neighbours]
    depth = agreed([read_side(file, (height, width)) for file in files], (height, width))
    depth = plausible(depth, photos.sparse_depths(number))
    write_depth_map(depth_map_file(folder, photos.views[number].file), depth)
    for file in files:
        file.unlink()


# --- messages


def _check_memory(pairs: Pairs) -> None:
    """Raises StageError where as many pairs as there are cores do not fit into memory."""
    sizes = [
        BYTES_PER_PIXEL * (pair.width + pair.disparities) * pair.height + min(cost_volume_bytes(pair), MAX_VOLUME_BYTES)
        for pair in pairs.values()
    ]
    why = "matching a pair of photos on each core at this size takes"
    check_memory(workers() * max(sizes), "the depth maps", why, "Give a larger --depth.downscale.")


def _names(photos: TrainingPhotos, numbers: list[int]) -> list[str]:
    return [photos.views[number].name for number in numbers]


def _no_pairs(photos: TrainingPhotos, left_out: Mapping[tuple[int, int], str]) -> StageError:
    reasons = sorted(set(left_out.values()))
    why = (
        f"of the overlapping ones {' or '.join(reasons)}"
        if reasons
        else "no two photos show the same surface from two positions"
    )
    return StageError(
        "depth.no-pairs",
        f"no pair of the {len(photos.views)} training photos gives depth",
        why,
        "Take photos a few degrees apart around the scene.",
    )


def _nothing_agrees(pairs: int) -> StageError:
    return StageError(
        "depth.nothing-agrees",
        "no depth was found",
        f"no two of {pairs:,} pairs of photos agree on any point",
        "Check the cameras, or add photos: each point needs three photos and some texture.",
    )


def _say_left_out(
    photos: TrainingPhotos, pairs: Pairs, left_out: Mapping[tuple[int, int], str], progress: Progress
) -> None:
    if left_out:
        (one, other), why = next(iter(left_out.items()))
        first = f"{photos.views[one].name} and {photos.views[other].name}: {why}"
        progress.note("depth.pairs-left-out", f"no depth from {counted(len(left_out), 'pair')} of photos ({first})")
    alone = [number for number, others in enumerate(_neighbours(photos, pairs)) if len(others) < 2]
    if alone:
        which = listed(_names(photos, alone), 3)
        why = "fewer than two photos show the same surface from a few degrees aside"
        progress.note("depth.photos-alone", f"no depth for {len(alone)} of {len(photos.views)} photos: {why} ({which})")


def _facts(photos: TrainingPhotos, read: ReadMap) -> tuple[dict[str, Any], int]:
    """Size, coverage, and how far off the sparse points are, which are measured otherwise; and how many pixels of all
    depth maps are known."""
    coverage, sigma, off, known = dict[str, float](), [], [], 0
    for number, view in enumerate(photos.views):
        depth = read(number)
        coverage[view.name] = round(depth.coverage, 4)
        off.append(photos.sparse_depths(number).disagreement(depth))
        sigma.append(float(np.median(depth.sigma[depth.distance > 0])) if depth.coverage else np.nan)
        known += int(np.count_nonzero(depth.distance))
    off = np.concatenate(off)
    off = off[np.isfinite(off)]
    facts = {
        "photos": len(photos.views),
        "size": list(max((viewpoint.size for viewpoint in photos.viewpoints), key=max)),
        "downscale": photos.downscale,
        "coverage": round(float(np.mean(list(coverage.values()))), 4),
        "sigma": round(float(np.nanmedian(sigma)), 6) if known else None,
        "off_sparse": round(float(np.median(off)), 6) if len(off) else None,
        "coverage_by_photo": coverage,
    }
    return facts, known


def _line(photos: TrainingPhotos, facts: Mapping[str, Any]) -> str:
    width, height = facts["size"]
    one_size = len({viewpoint.size for viewpoint in photos.viewpoints}) == 1
    size = f"{width}×{height}" if one_size else f"of up to {max(width, height)} pixels a side"
    off = f", {facts['off_sparse']:.2%} off the sparse points" if facts["off_sparse"] is not None else ""
    return (
        f"{facts['photos']} photos {size}, depth at {facts['coverage']:.0%} of the pixels{off} · "
        f"{short_count(facts['points'])} points"
    )
