"""What structure from motion knows of a scene, reduced to arrays; and two robust estimators of position.

Everything here is numpy float64 and equivariant under similarities: coordinate-wise medians are not, so centres
are spatial medians.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

CONVERGED = 1e-9  # of the softening, which is a tenth of the distance between close points: far below any use of it
PARALLEL = 1e-9  # of the largest singular value: below it lines leave a direction open, and rounding must not choose
NEAREST = 1e-6  # of the usual distance: a line hit exactly would weigh infinitely much


@dataclass(frozen=True)
class Reconstruction:
    """Posed photos and sparse points in one common frame.

    ``ray_directions`` are unit vectors in the camera frame, sampled over each photo's whole field of view (frustum);
    observation j says that photo ``view[j]`` sees point ``point[j]``. There may be no points at all. ``opaque`` is the
    :func:`extent` of the :func:`angles` of what may be opaque in each photo: beside it all is background. Without
    alpha, which alone tells, None.
    """

    from_camera: Float[np.ndarray, "n 3 4"]
    ray_directions: Float[np.ndarray, "n k 3"]
    points: Float[np.ndarray, "m 3"]
    view: Int[np.ndarray, "observations"]
    point: Int[np.ndarray, "observations"]
    opaque: Float[np.ndarray, "n 2 2"] | None = None

    @property
    def centres(self) -> Float[np.ndarray, "n 3"]:
        """Where the photos were taken from."""
        return self.from_camera[:, :, 3]

    @property
    def rights(self) -> Float[np.ndarray, "n 3"]:
        """The image x axes."""
        return self.from_camera[:, :, 0]

    @property
    def ups(self) -> Float[np.ndarray, "n 3"]:
        """The direction of the upper edge of each photo."""
        return -self.from_camera[:, :, 1]

    @property
    def axes(self) -> Float[np.ndarray, "n 3"]:
        """The optical axes."""
        return self.from_camera[:, :, 2]

    @property
    def rays(self) -> Float[np.ndarray, "n k 3"]:
        """The ray directions in the common frame."""
        return np.einsum("nij,nkj->nki", self.from_camera[:, :, :3], self.ray_directions)

    def field(self, view: int) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest :func:`angles` in a photo."""
        return extent(angles(self.ray_directions[view]))

    def project(
        self, view: int, points: Float[np.ndarray, "m 3"]
    ) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, "m"]]:
        """The :func:`angles` at which a photo has points, and which of them lie in its field of view, hidden or not."""
        local = (points - self.centres[view]) @ self.from_camera[view, :, :3]
        at, widest = angles(local), self.ray_directions[view, :, 2].min()
        return at, within(at, self.field(view)) & (local[:, 2] >= widest * np.linalg.norm(local, axis=1))

    def distances(self) -> Float[np.ndarray, "observations"]:
        """Distance from the photo to the point, per observation."""
        return np.linalg.norm(self.points[self.point] - self.centres[self.view], axis=1)

    def in_frame(
        self, rotation: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"], scale: float = 1.0
    ) -> "Reconstruction":
        """The same in the frame x' = scale rotation (x - centre): subtracting first keeps far origins exact."""
        axes = rotation @ self.from_camera[:, :, :3]
        centres = scale * (self.centres - centre) @ rotation.T
        points = scale * (self.points - centre) @ rotation.T
        return replace(self, from_camera=np.concatenate([axes, centres[:, :, None]], axis=2), points=points)


def observations_by_view(view: Int[np.ndarray, "observations"], count: int) -> list[Int[np.ndarray, "seen"]]:
    """Of each of ``count`` photos which observations are its own, in their order."""
    order = np.argsort(view, kind="stable")
    return np.split(order, np.searchsorted(view[order], np.arange(1, count)))


def angles(vectors: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 2"]:
    """How far to the right and down of the optical axis vectors in a camera's frame point, in radians. A photo
    without distortion is a rectangle of them."""
    return np.arctan2(vectors[..., :2], vectors[..., 2:])


def extent(values: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "2 d"]:
    """The least and the greatest."""
    return np.stack([values.min(axis=0), values.max(axis=0)])


def within(values: Float[np.ndarray, "m d"], box: Float[np.ndarray, "2 d"]) -> Bool[np.ndarray, "m"]:
    """Which rows lie in an :func:`extent`."""
    return ((values >= box[0]) & (values <= box[1])).all(axis=1)


def thinned(points: Float[np.ndarray, "n d"], most: int) -> Float[np.ndarray, "m d"]:
    """Every k-th of the points, with the least k that leaves ``most`` of them or fewer."""
    return points[:: -(-len(points) // most) or 1]


def spatial_median(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "d"]:
    """The point of least summed distance to ``points``, of which a third may be far outliers.

    Minimises sum sqrt(|x - p_i|^2 + e^2) by Weiszfeld's iteration. e, a tenth of the distance between close
    points, makes the minimum unique and the iteration quick where the median falls on one of the points.
    """
    count = len(points)
    apart = [points - np.roll(points, shift, axis=0) for shift in {1, count // 3, count // 2} - {0}]
    softening = np.quantile(np.linalg.norm(np.concatenate(apart), axis=1), 0.25) / 10 if count > 1 else 0.0
    estimate = np.median(points, axis=0)
    if softening == 0:  # the points coincide, and with them every coordinate's median
        return estimate
    for _ in range(500):
        weight = 1 / np.hypot(np.linalg.norm(points - estimate, axis=1), softening)
        step = weight @ (points - estimate) / weight.sum()
        estimate = estimate + step
        if np.linalg.norm(step) <= CONVERGED * softening:
            break
    return estimate


def closest_point_to_lines(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3"]:
    """The point of least summed distance to the lines, by iteratively reweighted least squares.

    Each round solves sum w_i (I - d_i d_i^T) (p - o_i) = 0 with w_i = 1 / distance. Parallel lines leave the
    point free along them: of those the least-norm solution relative to the origins' median is taken.
    """
    middle = spatial_median(origins)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    offsets = np.einsum("nij,nj->ni", across, origins - middle)
    weights = np.ones(len(origins))
    estimate = np.zeros(3)
    for _ in range(50):
        normal = np.einsum("n,nij->ij", weights, across)
        estimate = np.linalg.lstsq(normal, weights @ offsets, rcond=PARALLEL)[0]
        distance = np.linalg.norm(across @ estimate - offsets, axis=1)
        floor = NEAREST * max(np.median(distance), np.median(np.linalg.norm(offsets, axis=1)))
        weights = 1 / np.maximum(distance, floor) if floor > 0 else weights
    return middle + estimate


def angles_deg(a: Float[np.ndarray, "*#n 3"], b: Float[np.ndarray, "*#n 3"]) -> Float[np.ndarray, "*n"]:
    """Angles between unit vectors, in degrees."""
    return np.asarray(np.degrees(np.arccos(np.clip((a * b).sum(-1), -1.0, 1.0))))
