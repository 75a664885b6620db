"""Images whose poses contradict their matches: deregistered, registered again, left out if that does not help.

Call it in a worker process. model_check.py says which they are.
"""

import shutil
from collections.abc import Container, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from stages.contract import Note
from stages.sfm.colmap.database.copies import copy_without_pairs, keep_inliers
from stages.sfm.colmap.database.correspondences import read_pair_matches
from stages.sfm.colmap.database.files import changed_copy
from stages.sfm.colmap.mappers import map_incrementally
from stages.sfm.colmap.model_check import ModelCheck, camera_poses, fragments_sequence
from stages.sfm.colmap.models import load_native, write_native
from stages.sfm.pairs.match_graph import ORDER_OVERLAP
from stages.sfm.pose_check import consistent_matches, outside_main_segment


def copy_consistent_matches(
    model: pycolmap.Reconstruction, database: Path, copy: Path, trusted: Container[tuple[int, int]]
) -> None:
    """Copy the database with only the verified matches that are consistent with a model which those of ``trusted``
    pairs (image ids, the lower first) made."""
    with changed_copy(database, copy) as db:
        ids, matches = read_pair_matches(db, model, 0, most=None)
        pairs = np.array(ids)[matches.pairs].tolist()  # the lower id first, as COLMAP numbers pairs
        kept = consistent_matches(matches, camera_poses(model), np.array([(i, j) in trusted for i, j in pairs], bool))
        bounds = np.searchsorted(matches.pair, np.arange(len(pairs) + 1))
        mine = {(i, j): kept[bounds[k] : bounds[k + 1]] for k, (i, j) in enumerate(pairs)}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            keep = mine.get((first, second), np.zeros(0, bool))
            if (first, second) not in trusted or len(keep):
                keep_inliers(db, (first, second), geometry, keep)


def drop_outside_main_segment(
    model: pycolmap.Reconstruction,
    checked: ModelCheck,
    sequence: Sequence[int],
    supported: Container[tuple[int, int]] | None = None,
) -> dict[str, Note]:
    """Deregister images outside the longest segment of a broken capture ``sequence`` (image ids, none where it is not
    known): by name why. Every step but the ``supported`` ones (image ids, the lower first) breaks it, where these are
    given."""
    just_beside = supported is not None or fragments_sequence(checked, sequence)
    neighbours = "photos taken just before or after" if just_beside else "photos taken between it and the others"
    numbers = checked.numbers(sequence)
    holding = supported and {
        (first, second)
        for first, second in pairwise(numbers.tolist())
        if (min(ids := (checked.ids[first], checked.ids[second])), max(ids)) in supported
    }
    outside = outside_main_segment(numbers, checked.matches, checked.check, ORDER_OVERLAP, holding)
    ids = [image_id for image_id, is_outside in zip(checked.ids, outside, strict=True) if is_outside]
    deregister(model, ids)
    why = Note("sfm.unregistered-outside-sequence", f"{neighbours} contradict its pose: repeated structure")
    return {model.image(image_id).name: why for image_id in ids}


def deregister(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> None:
    """Deregister images; what only they saw goes with them."""
    for image_id in image_ids:
        model.deregister_frame(model.image(image_id).frame_id)
    model.update_point_3d_errors()


def restricted(model: pycolmap.Reconstruction, image_ids: Iterable[int]) -> pycolmap.Reconstruction:
    """A copy of the model in which these images alone are registered."""
    part = pycolmap.Reconstruction(model)
    deregister(part, sorted({*model.reg_image_ids()}.difference(image_ids)))
    return part


def register_again(
    model: pycolmap.Reconstruction,
    checked: ModelCheck,
    database: Path,
    images: Path,
    scratch: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """The model with the images that failed deregistered and, where possible, registered again.

    Pairs of images that passed and contradict the poses are outliers of matching: mapping goes on without them.
    """
    begin, models = scratch / "begin", scratch / "models"
    shutil.rmtree(scratch, ignore_errors=True)
    failed = checked.failed()
    write_native(begin, model)
    reduced = load_native(begin)
    deregister(reduced, failed)
    write_native(begin, reduced)
    clean, passed = scratch / "clean.db", checked.check.passed
    mistakes = checked.matches.pairs[checked.check.contradicts & passed[checked.matches.pairs].all(axis=1)]
    copy_without_pairs(database, clean, np.array(checked.ids)[mistakes].tolist())
    found = map_incrementally(clean, images, models, options, begin=begin)
    best = found[0] if found else reduced
    shutil.rmtree(scratch, ignore_errors=True)
    return best if best.num_reg_images() >= reduced.num_reg_images() else reduced
