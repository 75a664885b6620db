"""In which images two models differ, and how far they agree. Call it in a worker process."""

from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nerf.geometry.alignment import align
from stages.sfm.degeneracy import different_poses

# A single image may merely have a bad pose in one of two models: it takes several to say that the models contradict.
MIN_DIFFERENT, MIN_DIFFERENT_FRACTION = 2, 0.2
MAX_DIFFERENT_FRACTION = 0.05  # of the images that two models share, whose poses may differ
# Between two images of a verified pair, from one model to the other, at most. Where drift bends a street to a circle,
# global mapping turned pairs by up to 8 degrees, and scaled them by 7 %.
MAX_STEP_DEG, MAX_STEP_SCALE = 10.0, 1.1


def find_conflict(models: Sequence[pycolmap.Reconstruction]) -> dict[str, Any] | None:
    """The largest sub-model that shares images with the best one (the first) and gives some of them different poses.

    ``group`` is its number, ``shared`` how many images both have, ``different`` how many of them have different poses;
    these are the ``photos``, and ``others`` those that it alone has. Where there are none of the latter nothing is lost
    by it: the poses of the best model have passed the check, and the group has nothing to add.
    """
    if len(models) < 2:
        return None
    best = _poses(models[0])
    centres = np.array(list(best.values()))[:, :, 3]
    extent = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(axis=1).mean()))
    for group, model in enumerate(models[1:], start=1):
        poses = _poses(model)
        if not (shared := sorted(best.keys() & poses.keys())):
            continue
        here, there = (np.array([of[name] for name in shared]) for of in (best, poses))
        different = different_poses(here, there, extent)
        if different.sum() >= max(MIN_DIFFERENT, MIN_DIFFERENT_FRACTION * len(shared)):
            others = sorted(poses.keys() - best.keys())
            moved = [name for name, is_different in zip(shared, different, strict=True) if is_different]
            facts = {"group": group, "shared": len(shared), "different": len(moved), "photos": moved, "others": others}
            return facts if others else None
    return None


def compare_models(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> dict[str, Any]:
    """How far two models of the same images agree, after the similarity on which most of them do.

    ``photos`` is how many both have, ``agree`` how many of them have the same pose in both, ``different`` the files of
    those that do not; ``centre`` and ``degrees`` are mean differences of the former, centres as fractions of the extent
    of the first model's cameras.
    """
    first, second = _poses(model), _poses(other)
    shared = sorted(first.keys() & second.keys())
    facts: dict[str, Any] = {"photos": len(shared), "agree": 0, "different": [], "centre": None, "degrees": None}
    if len(shared) < 3:
        return facts
    here, there = (np.array([of[name] for name in shared]) for of in (first, second))
    extent = float(np.linalg.norm(np.ptp(here[:, :, 3], axis=0)))
    different = different_poses(here, there, extent)
    moved = [name for name, is_different in zip(shared, different, strict=True) if is_different]
    here, there = here[~different], there[~different]
    facts |= {"agree": len(here), "different": moved}
    with suppress(ValueError):  # all in one line: nothing to align by
        first_from_second = align(there[:, :, 3], here[:, :, 3])
        aligned = np.array([first_from_second.pose(pose) for pose in there])
        off = np.linalg.norm(aligned[:, :, 3] - here[:, :, 3], axis=1)
        cosine = (np.einsum("nij,nij->n", aligned[:, :, :3], here[:, :, :3]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        facts |= {"centre": float(off.mean() / extent), "degrees": float(turned.mean())}
    return facts


def disagree(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> bool:
    """Whether two models of the same images give more than a few of them different poses."""
    compared = compare_models(model, other)
    return len(compared["different"]) > MAX_DIFFERENT_FRACTION * compared["photos"]


def linked_share(images: Collection[int], pairs: Collection[tuple[int, int]]) -> float:
    """How many of the ``images`` (ids) ``pairs`` of them link together, as a share of all."""
    number = {image_id: i for i, image_id in enumerate(images)}
    ends = np.array([[number[i], number[j]] for i, j in pairs if i in number and j in number], int).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(len(number), len(number)))
    return float(np.bincount(connected_components(graph, directed=False)[1]).max() / len(number))


def differ_by_drift(
    model: pycolmap.Reconstruction, other: pycolmap.Reconstruction, pairs: Collection[tuple[int, int]]
) -> bool:
    """Whether two models differ by drift alone: what small differences add up to along a path, which only a loop
    could tell. Then ``pairs`` (image ids) that agree with both link nearly all the images they share, and neither the
    angle between a pair's images nor their scale jumps, which matches of two images tell badly or not at all."""
    shared = sorted({*model.reg_image_ids()} & {*other.reg_image_ids()})
    ends = np.array([pair for pair in pairs if {*pair} <= {*shared}], int).reshape(-1, 2)
    if not len(ends):
        return False
    at, (turns, steps) = np.searchsorted(shared, ends), ([], [])
    for of in (model, other):
        poses = np.array([of.image(i).cam_from_world().inverse().matrix() for i in shared])[at]
        turns.append(poses[:, 0, :, :3].transpose(0, 2, 1) @ poses[:, 1, :, :3])
        steps.append(np.linalg.norm(poses[:, 0, :, 3] - poses[:, 1, :, 3], axis=1))
    cosine = (np.einsum("nij,nij->n", *turns) - 1) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        stretched = np.log(steps[1] / steps[0])
    # Of each image's steps together: the length of a single short one is uncertain.
    scale = np.array(
        [np.median(stretched[(at == i).any(axis=1)]) if (at == i).any() else 0 for i in range(len(shared))]
    )
    alike = (cosine > np.cos(np.radians(MAX_STEP_DEG))) & (np.abs(np.diff(scale[at])[:, 0]) < np.log(MAX_STEP_SCALE))
    return linked_share(shared, [(int(i), int(j)) for i, j in ends[alike]]) >= 1 - MAX_DIFFERENT_FRACTION


def _poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """By name, (3, 4) from the image's camera to the model's frame."""
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.cam_from_world().inverse().matrix() for image in images}
