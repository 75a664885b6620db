"""The additive view/point model: weighted fits of y_k = a[view_k] + b[point_k] + residual.

The points' effects b are eliminated, which leaves the Laplacian of the graph of photos that share points:
A = diag(sum w) - sum over points of w w^T / sum(w), as in a bundle adjustment of one number per photo (Schur
complement). Slopes between residuals are Frisch, Waugh and Lovell's.

Nothing here asks BLAS, whose sums differ in their last digits by the number of its threads and by the processor: what
is trained begins with these gains, and the same photos are to give the same field.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf.effects.statistics.tracks import within_groups

MIN_VARIATION = 1e-9  # of the square sum of x, that photos and points leave of it: what is less is rounding
TOLERANCE = 1e-12  # of a residual, relative to the right-hand side


@dataclass(frozen=True)
class AdditiveModel:
    """Which photo and which point each of m observations is of, in order of point, and all pairs of one point.

    ``connected``: the photos of the largest connected part of the graph; nothing relates the others to them.
    """

    views: int
    view: Int[np.ndarray, "m"]
    point: Int[np.ndarray, "m"]  # 0 … points - 1, every one there
    first: Int[np.ndarray, "pairs"]  # an observation, and another one of the same point
    second: Int[np.ndarray, "pairs"]
    connected: Bool[np.ndarray, "views"]

    def point_mean(self, values: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """The weighted mean of each observation's point."""
        top = np.bincount(self.point, weight * values)
        return (top / np.bincount(self.point, weight))[self.point]

    def sum_per_view(self, values: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views"]:
        """Sums over the observations of each photo."""
        return np.bincount(self.view, values, self.views)

    def point_share(self, weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """The fraction of its point's weight that each observation has."""
        return weight / np.bincount(self.point, weight)[self.point]

    def pair_products(
        self, left: Float[np.ndarray, "m"], right: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "views views"]:
        """Sum over points of u u'^T, u[v] the sum of ``left`` over photo v's observations of it, u' of ``right``."""
        place = self.view[self.first] * self.views + self.view[self.second]
        crossed = np.bincount(place, left[self.first] * right[self.second], self.views**2)
        matrix = crossed.reshape(self.views, self.views)
        matrix = matrix + matrix.T
        matrix[np.diag_indices(self.views)] += self.sum_per_view(left * right)
        return matrix

    def laplacian(self, weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "connected connected"]:
        """A of the connected photos, made regular by the gauge that their effects sum to 0."""
        matrix = np.diag(self.sum_per_view(weight)) - self.pair_products(weight, self.point_share(weight))
        matrix = matrix[np.ix_(self.connected, self.connected)]
        size = np.trace(matrix) / max(len(matrix), 1)
        return matrix + size / max(len(matrix), 1)

    def view_effects(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views"]:
        """The effects a of photos, 0 on average over the connected ones and 0 for the others."""
        gain = np.zeros(self.views)
        right = self.sum_per_view(weight * (y - self.point_mean(y, weight)))[self.connected]
        if len(right):
            gain[self.connected] = conjugate_gradients(self.laplacian(weight), right)
        return gain

    def residuals(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """The residuals of ``y`` under the model."""
        return self.within_points(y - self.view_effects(y, weight)[self.view], weight)

    def within_points(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """``y`` less the mean of its point."""
        return y - self.point_mean(y, weight)

    def standard_errors(
        self, residuals: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "views"]:
        """Standard errors of :meth:`view_effects`, infinite for photos that are not connected.

        Points are taken as independent, their observations are not (sandwich estimator, clustered by point; Liang &
        Zeger 1986). A photo of n points has n / (n - 3) times that variance: its own effect has made the residuals
        smaller, and so few tell the noise no better than Student's t says; of three points nothing is known.
        """
        error = np.full(self.views, np.inf)
        if not self.connected.any():
            return error
        inverse = inverted(self.laplacian(weight))
        score = self.pair_products(weight * residuals, weight * residuals)[np.ix_(self.connected, self.connected)]
        seen = np.bincount(self.view, minlength=self.views)[self.connected]
        variance = np.maximum(np.sum(_times_transposed(inverse, score) * inverse, axis=1), 0.0)
        few = seen / np.maximum(seen - 3, 1)
        error[self.connected] = np.where(seen > 3, np.sqrt(few * variance), np.inf)
        return error

    def slope(
        self, y: Float[np.ndarray, "m"], x: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]
    ) -> tuple[float, float]:
        """How ``y`` follows ``x`` within photos and points alike, and the slope's standard error; (0, inf) where ``x``
        does not vary within them.

        It is clustered by point or by photo, whichever is more: light that falls from one side follows ``x`` in all of
        a photo, and more points of it tell no more. n photos have n / (n - 1) times that variance: their sum is 0.
        """
        x_left = self.residuals(x, weight)
        size = float(np.sum(weight * x_left**2))
        if not size > MIN_VARIATION * float(np.sum(weight * x**2)):
            return 0.0, float("inf")
        y_left = self.residuals(y, weight)
        slope = float(np.sum(weight * x_left * y_left)) / size
        score = weight * x_left * (y_left - slope * x_left)
        of_points, of_photos = np.bincount(self.point, score), self.sum_per_view(score)
        photos = max(np.count_nonzero(of_photos), 2)
        variance = max(np.sum(of_points**2), photos / (photos - 1) * np.sum(of_photos**2))
        return slope, float(np.sqrt(variance)) / size


def additive_model(view: Int[np.ndarray, "m"], point: Int[np.ndarray, "m"], views: int) -> AdditiveModel:
    """The layout of observations that are in order of point (``nerf.effects.statistics.tracks.usable``)."""
    rank, length = within_groups(point)
    of = np.cumsum(rank == 0) - 1
    pairs = [
        np.stack([first := np.flatnonzero(rank + lag < length), first + lag])
        for lag in range(1, int(length.max(initial=1)))
    ]
    first, second = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), int)
    return AdditiveModel(views, view, of, first, second, _largest_component(view, of, views))


def conjugate_gradients(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """The x of ``matrix`` x = ``right``, ``matrix`` symmetric and positive definite: conjugate gradients, scaled by the
    diagonal (Hestenes & Stiefel 1952), to TOLERANCE of the residual. Sums always run in the same order."""
    diagonal = np.diag(matrix).copy()
    x, residual = np.zeros_like(right), right.copy()
    direction = residual / diagonal
    norm = first = float(np.sum(residual * direction))
    for _ in range(10 * len(right)):
        if norm <= TOLERANCE**2 * first:
            break
        image = _times_transposed(matrix, direction[None])[:, 0]
        curvature = float(np.sum(direction * image))
        if curvature <= 0:  # the rest is rounding
            break
        x += norm / curvature * direction
        residual -= norm / curvature * image
        scaled, before = residual / diagonal, norm
        norm = float(np.sum(residual * scaled))
        direction = scaled + norm / before * direction
    return x


def inverted(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The inverse of a symmetric positive definite matrix, row after row swept out (Goodnight 1979)."""
    swept = matrix.copy()
    change = np.empty_like(swept)
    for k in range(len(swept)):
        pivot, column = swept[k, k], swept[:, k].copy()
        row = swept[k] / pivot
        np.multiply(column[:, None], row, out=change)
        swept -= change
        swept[k], swept[:, k], swept[k, k] = row, -column / pivot, 1 / pivot
    return swept


def _times_transposed(left: Float[np.ndarray, "m k"], right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "m n"]:
    """``left`` times the transpose of ``right``, every sum in the same order."""
    return np.einsum("ik,jk->ij", left, right, optimize=False)


def _largest_component(
    view: Int[np.ndarray, "m"], point: Int[np.ndarray, "m"], views: int
) -> Bool[np.ndarray, "views"]:
    """The photos of the largest connected component of the graph; none where no two photos share a point. A component's
    label is the smallest number in it, which spreads from neighbour to neighbour."""
    if not len(view):
        return np.zeros(views, bool)
    label = np.arange(views)
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    while True:
        of_point = np.minimum.reduceat(label[view], starts)
        spread = label.copy()
        np.minimum.at(spread, view, of_point[point])
        if np.array_equal(spread, label):
            break
        label = spread
    sizes = np.bincount(label, minlength=views)
    return (label == sizes.argmax()) & (sizes.max() > 1)
