"""How far apart photos were taken, as one number, and what neighbours tell of a photo."""

import numpy as np
from jaxtyping import Float

NEIGHBOURS = 4


def pose_distances(pose: Float[np.ndarray, "3 4"], others: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n"]:
    """Distance of the centres in scene units plus rotation angle in radians.

    The region of interest is about two units wide, so a radian weighs as much as half the scene. The whole rotation
    counts, roll included.
    """
    moved = np.linalg.norm(others[:, :, 3] - pose[:, 3], axis=1)
    return moved + rotation_angles(others[:, :, :3], pose[:, :3])


def rotation_angles(
    rotations: Float[np.ndarray, "n 3 3"], others: Float[np.ndarray, "*n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Between each rotation and its other one, or the only other one, in radians."""
    # The chord ||R_a - R_b||_F = 2 sqrt(2) sin(angle / 2) keeps its precision at small angles, unlike arccos(trace).
    chord = np.linalg.norm(rotations - others, axis=(1, 2))
    return 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1.0))


def neighbour_weights(
    held_out: Float[np.ndarray, "m 3 4"], known: Float[np.ndarray, "n 3 4"]
) -> Float[np.ndarray, "m n"]:
    """How much each known photo tells of each held-out one: inverse squares of distance among the NEIGHBOURS nearest
    (Shepard 1968), rows that sum to 1. Photos at no distance at all share everything."""
    weights = np.zeros((len(held_out), len(known)))
    for row, pose in zip(weights, held_out, strict=True):
        distance = pose_distances(pose, known)
        nearest = np.argsort(distance, kind="stable")[:NEIGHBOURS]
        least = distance[nearest[0]]
        # over the least distance, so that nothing overflows; at distance 0 only those at 0 count
        relative = np.divide(least, distance[nearest], out=np.ones(len(nearest)), where=distance[nearest] > 0)
        row[nearest] = relative**2 / np.sum(relative**2)
    return weights
