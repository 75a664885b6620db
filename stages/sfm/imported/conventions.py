"""How poses of cameras stand in a file: from which frame to which, and where a camera's axes point.

Nothing in a file tells a mistaken convention, but its photos do: verified matches agree with the poses under the right
one alone. So where given poses contradict their photos, all others are tried, and the one that fits is named.
"""

from collections.abc import Iterator
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stages.io.transforms_export import OPENGL_FROM_OPENCV
from stages.sfm.geometry_check import PairMatches, agreement

AXES: dict[str, Float[np.ndarray, "3 3"]] = {"opencv": np.eye(3), "opengl": OPENGL_FROM_OPENCV}
# Of OpenCV's x, y and z, and their opposites.
_WAYS = (("right", "left"), ("down", "up"), ("forward", "back"))
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
    read with, and the rotation from OpenCV's camera axes to those of the poses as they were read."""

    other_direction: bool
    turn: list[list[float]]
    agreeing: int
    pairs: int


def best_fit(matches: PairMatches, poses: Float[np.ndarray, "photos 3 4"]) -> Fit | None:
    """The convention under which most verified pairs agree with ``poses``; None where under none of them most do."""
    best = max(_fits(matches, poses), key=lambda fit: fit.agreeing / max(1, fit.pairs))
    return best if best.agreeing >= MIN_FIT * best.pairs > 0 else None


def _fits(matches: PairMatches, poses: Float[np.ndarray, "photos 3 4"]) -> Iterator[Fit]:
    for other_direction, turn in product((False, True), _right_handed()):
        turned = inverse(poses) if other_direction else poses
        turned = np.concatenate([turned[..., :3] @ turn, turned[..., 3:]], axis=-1)
        yield Fit(other_direction, turn.tolist(), *agreement(matches, turned))


def _right_handed() -> Iterator[Float[np.ndarray, "3 3"]]:
    """The 24 rotations that take axes to axes."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0:
            yield turn


def found_convention(fit: Fit, read_as: PoseConvention) -> tuple[str, Float[np.ndarray, "3 3"]]:
    """Direction of the matrices in the file, and the rotation from OpenCV's camera axes to the file's, of poses that
    were read under a convention. A turn of the world, the same for all poses, makes no difference."""
    if not fit.other_direction:
        return read_as.direction or "world-from-camera", AXES[read_as.axes or "opencv"] @ np.array(fit.turn)
    other = "world-from-camera" if read_as.direction == "camera-from-world" else "camera-from-world"
    return other, np.array(fit.turn)


def named_axes(axes: Float[np.ndarray, "3 3"]) -> str | None:
    """What the camera axes are called; None where they have no name."""
    return next((name for name, known in AXES.items() if np.array_equal(known, axes)), None)


def axes_in_words(axes: Float[np.ndarray, "3 3"]) -> str:
    """Where the x, y and z of a file's cameras point: "x right, y up, z back" are OpenGL's."""
    ways = (_WAYS[int(np.flatnonzero(row)[0])][int(row.sum() < 0)] for row in axes)
    return ", ".join(f"{axis} {way}" for axis, way in zip("xyz", ways, strict=True))
