"""How poses of cameras stand in a file: from which frame to which, and where a camera's axes point.

Nothing in a file tells a mistaken convention, but its photos do: verified matches agree with the poses under the right
one alone. So where given poses contradict their photos, all others are tried, and the one that fits is named: of all
poses, in a right-handed world or a left-handed one, with quaternions that end in w, or of some poses alone.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from stages.io.transforms_export import OPENGL_FROM_OPENCV
from stages.sfm.pairs.match_graph import connected
from stages.sfm.pose_check import PairMatches, agreement

AXES: dict[str, Float[np.ndarray, "3 3"]] = {"opencv": np.eye(3), "opengl": OPENGL_FROM_OPENCV}
# Of OpenCV's x, y and z, and their opposites.
_WAYS = (("right", "left"), ("down", "up"), ("forward", "back"))
MIN_PAIRS = 3  # verified pairs, for there to be any evidence
SAME_POSE_WITHIN = 1e-6  # relatively: what floats of 32 bits make of two copies
MIN_FIT = 0.8  # of the verified pairs agree, where a convention fits


class PoseConvention(NamedTuple):
    """What the matrix of a camera is, "world-from-camera" or "camera-from-world", and whose axes it has, "opencv" or
    "opengl"; None: as its format has it."""

    direction: str | None
    axes: str | None

    def with_defaults(self, of_format: "PoseConvention") -> "PoseConvention":
        """What is None, as the format has it."""
        return PoseConvention(self.direction or of_format.direction, self.axes or of_format.axes)


AS_DECLARED = PoseConvention(None, None)
OF_TRANSFORMS = PoseConvention("world-from-camera", "opengl")
OF_COLMAP = PoseConvention("camera-from-world", "opencv")
OF_LLFF = PoseConvention("world-from-camera", "opencv")  # as stages/sfm/imported/llff.py turns its axes


def inverse(pose: Float[np.ndarray, "... 3 4"]) -> Float[np.ndarray, "... 3 4"]:
    """Of rigid transforms."""
    rotation = np.swapaxes(pose[..., :3], -1, -2)
    return np.concatenate([rotation, -rotation @ pose[..., 3:]], axis=-1)


def world_from_camera(matrix: Float[np.ndarray, "3 4"], convention: PoseConvention) -> Float[np.ndarray, "3 4"]:
    """The pose, with OpenCV axes, of a rigid matrix that stands in a file under this convention."""
    pose = inverse(matrix) if convention.direction == "camera-from-world" else matrix
    axes = AXES[convention.axes or "opencv"]
    return np.concatenate([pose[:, :3] @ axes, pose[:, 3:]], axis=1)


class Fit(NamedTuple):
    """A convention under which poses agree with their photos: whether it has the other ``direction`` than they were
    read with, and the rotation from OpenCV's camera axes to those of the poses as they were read; a reflection where
    their world is left-handed, too. ``scalar_last``: their quaternions are x, y, z, w. ``of``: the numbers of the only
    photos whose poses are of this convention; none: all are."""

    other_direction: bool
    turn: list[list[float]]
    agreeing: int
    pairs: int
    scalar_last: bool = False
    of: Sequence[int] = ()

    @property
    def mirrored(self) -> bool:
        """Whether the world of the poses is left-handed."""
        return bool(np.linalg.det(self.turn) < 0)


def best_fit(matches: PairMatches, poses: Float[np.ndarray, "photos 3 4"], of_quaternions: bool = False) -> Fit | None:
    """The convention under which most verified pairs agree with ``poses``; None where under none of them most do.
    ``of_quaternions``: somebody may have written their quaternions in another order."""
    attempts = [_fits(matches, poses, turns) for turns in (RIGHT_HANDED, LEFT_HANDED)]
    if of_quaternions:
        attempts.append(f._replace(scalar_last=True) for f in _fits(matches, _scalar_last(poses), RIGHT_HANDED))
    return next(filter(None, map(_best, attempts)), None)


def fit_of_some(
    matches: PairMatches, poses: Float[np.ndarray, "photos 3 4"], agrees: Bool[np.ndarray, "pairs"]
) -> Fit | None:
    """The convention of those photos, the smaller part, whose poses agree with none of the others as ``agrees`` has it
    for each pair; None where they are of none, or of several."""
    edges = np.zeros((len(poses), len(poses)), bool)
    edges[tuple(matches.pairs[agrees].T)] = True
    others = np.flatnonzero(connected(edges)).tolist()
    if not 0 < 2 * len(others) < len(poses):
        return None
    best = _best(_fits(matches, poses, RIGHT_HANDED, others))
    as_read = best is not None and not best.other_direction and np.array_equal(best.turn, np.eye(3))
    return None if as_read else best


def _best(fits: Iterable[Fit]) -> Fit | None:
    best = max(fits, key=lambda fit: fit.agreeing / max(1, fit.pairs))
    return best if best.pairs >= MIN_PAIRS and best.agreeing >= MIN_FIT * best.pairs else None


def _fits(
    matches: PairMatches,
    poses: Float[np.ndarray, "photos 3 4"],
    turns: Sequence[Float[np.ndarray, "3 3"]],
    of: Sequence[int] = (),
) -> Iterator[Fit]:
    """Each direction with each of the ``turns``, of all photos, or of those numbered ``of``, whose pairs then count."""
    which = np.isin(np.arange(len(poses)), of) if of else np.ones(len(poses), bool)
    among = np.logical_or(*which[matches.pairs].T)
    for other_direction, turn in product((False, True), turns):
        turned = poses.copy()
        turned[which] = inverse(poses[which]) if other_direction else poses[which]
        turned[which, :, :3] = turned[which, :, :3] @ turn
        yield Fit(other_direction, turn.tolist(), *agreement(matches, turned, among), of=of)


def _scalar_last(poses: Float[np.ndarray, "photos 3 4"]) -> Float[np.ndarray, "photos 3 4"]:
    """Poses of which the quaternions of camera_from_world, (x, y, z, w), were read as (w, x, y, z)."""
    camera_from_world = inverse(poses)
    read = Rotation.from_matrix(camera_from_world[:, :, :3]).as_quat(scalar_first=True)
    meant = Rotation.from_quat(read).as_matrix()
    return inverse(np.concatenate([meant, camera_from_world[:, :, 3:]], axis=2))


def _axis_turns() -> Iterator[Float[np.ndarray, "3 3"]]:
    """The 48 rotations and reflections that take axes to axes."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        yield turn


RIGHT_HANDED = [turn for turn in _axis_turns() if np.linalg.det(turn) > 0]
LEFT_HANDED = [turn for turn in _axis_turns() if np.linalg.det(turn) < 0]


def found_convention(fit: Fit, read_as: PoseConvention) -> tuple[str, Float[np.ndarray, "3 3"]]:
    """Direction of the matrices in the file, and what takes OpenCV's camera axes to the file's, of poses that were read
    under a convention. A turn of the world, the same for all poses, makes no difference."""
    if not fit.other_direction:
        return read_as.direction or "world-from-camera", AXES[read_as.axes or "opencv"] @ np.array(fit.turn)
    other = "world-from-camera" if read_as.direction == "camera-from-world" else "camera-from-world"
    return other, np.array(fit.turn)


def columns_for(wanted: Float[np.ndarray, "3 3"], axes: Float[np.ndarray, "3 3"]) -> str:
    """Which columns of a world_from_camera matrix with these ``axes``, counted from 1 and negated where a minus says
    so, are those of one with the ``wanted`` axes: "1, -2, -3" between OpenCV's and OpenGL's."""
    columns = (axes @ wanted.T).T
    return ", ".join(f"{int(column.sum()) * (1 + int(np.flatnonzero(column)[0]))}" for column in columns)


def named_axes(axes: Float[np.ndarray, "3 3"]) -> str | None:
    """What the camera axes are called; None where they have no name."""
    return next((name for name, known in AXES.items() if np.array_equal(known, axes)), None)


def axes_in_words(axes: Float[np.ndarray, "3 3"]) -> str:
    """Where the x, y and z of a file's cameras point: "x right, y up, z back" are OpenGL's."""
    ways = (_WAYS[int(np.flatnonzero(row)[0])][int(row.sum() < 0)] for row in axes)
    return ", ".join(f"{axis} {way}" for axis, way in zip("xyz", ways, strict=True))
