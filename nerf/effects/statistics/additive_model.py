"""Weighted fits of y_k = a[view_k] + b[point_k]: what belongs to photos, what to points, and what is left.

The points' parts are eliminated, which leaves the Laplacian of the graph of photos that share points:
A = diag(sum w) - sum over points of w w^T / sum(w), as in a bundle adjustment of one number per photo (Schur
complement). Slopes between what it leaves are Frisch, Waugh and Lovell's.

Nothing here asks BLAS, whose sums differ in their last digits by the number of its threads and by the processor: what
is trained begins with these gains, and the same photos are to give the same field.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf.effects.statistics.tracks import within_groups

CONSTANT = 1e-9  # share of its square sum that x has left around its photos and points: no more than rounding
EXACT = 1e-12  # of a residual, beside the right-hand side


@dataclass(frozen=True)
class AdditiveModel:
    """Which photo and which point each of m observations is of, in order of point, and all pairs of one point.

    ``main``: the photos of the largest connected part of the graph; of the others nothing is known beside them.
    """

    views: int
    view: Int[np.ndarray, "m"]
    point: Int[np.ndarray, "m"]  # 0 … points - 1, every one there
    first: Int[np.ndarray, "pairs"]  # an observation, and another one of the same point
    second: Int[np.ndarray, "pairs"]
    main: Bool[np.ndarray, "views"]

    def mean(self, values: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Each observation's point's weighted mean."""
        top = np.bincount(self.point, weight * values)
        return (top / np.bincount(self.point, weight))[self.point]

    def per_view(self, values: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views"]:
        """Sums over the observations of each photo."""
        return np.bincount(self.view, values, self.views)

    def share(self, weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """The part of each observation in the weight of its point."""
        return weight / np.bincount(self.point, weight)[self.point]

    def outer(self, left: Float[np.ndarray, "m"], right: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views views"]:
        """Sum over points of u u'^T, u[v] the sum of ``left`` over photo v's observations of it, u' of ``right``."""
        place = self.view[self.first] * self.views + self.view[self.second]
        crossed = np.bincount(place, left[self.first] * right[self.second], self.views**2)
        matrix = crossed.reshape(self.views, self.views)
        matrix = matrix + matrix.T
        matrix[np.diag_indices(self.views)] += self.per_view(left * right)
        return matrix

    def laplacian(self, weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "main main"]:
        """A of the connected photos, made regular by the gauge that their parts sum to nothing."""
        matrix = np.diag(self.per_view(weight)) - self.outer(weight, self.share(weight))
        matrix = matrix[np.ix_(self.main, self.main)]
        size = np.trace(matrix) / max(len(matrix), 1)
        return matrix + size / max(len(matrix), 1)

    def parts(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views"]:
        """The photos' parts, 0 on average over the connected ones and 0 for the others."""
        gain = np.zeros(self.views)
        right = self.per_view(weight * (y - self.mean(y, weight)))[self.main]
        if len(right):
            gain[self.main] = solved(self.laplacian(weight), right)
        return gain

    def rest(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """What neither photos nor points explain of ``y``."""
        return self.around_points(y - self.parts(y, weight)[self.view], weight)

    def around_points(self, y: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """What is left of ``y`` beside each point's mean."""
        return y - self.mean(y, weight)

    def errors(self, rest: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]) -> Float[np.ndarray, "views"]:
        """Standard errors of :meth:`parts`, infinite for photos that are not connected.

        Points are taken as independent, their observations are not (sandwich estimator, clustered by point; Liang &
        Zeger 1986). A photo of n points has n / (n - 3) times that variance: its own part has made what is left
        smaller, and so few tell the noise no better than Student's t says; of three points nothing is known.
        """
        error = np.full(self.views, np.inf)
        if not self.main.any():
            return error
        inverse = inverted(self.laplacian(weight))
        score = self.outer(weight * rest, weight * rest)[np.ix_(self.main, self.main)]
        seen = np.bincount(self.view, minlength=self.views)[self.main]
        variance = np.maximum(np.sum(_times(inverse, score) * inverse, axis=1), 0.0)
        few = seen / np.maximum(seen - 3, 1)
        error[self.main] = np.where(seen > 3, np.sqrt(few * variance), np.inf)
        return error

    def slope(
        self, y: Float[np.ndarray, "m"], x: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"]
    ) -> tuple[float, float]:
        """How ``y`` follows ``x`` within photos and points alike, and the slope's standard error; (0, inf) where ``x``
        does not vary within them.

        It is clustered by point or by photo, whichever is more: light that falls from one side follows ``x`` in all of
        a photo, and more points of it tell no more. n photos have n / (n - 1) times that variance: their sum is 0.
        """
        across = self.rest(x, weight)
        size = float(np.sum(weight * across**2))
        if not size > CONSTANT * float(np.sum(weight * x**2)):
            return 0.0, float("inf")
        rest = self.rest(y, weight)
        slope = float(np.sum(weight * across * rest)) / size
        score = weight * across * (rest - slope * across)
        of_points, of_photos = np.bincount(self.point, score), self.per_view(score)
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
    return AdditiveModel(views, view, of, first, second, _largest_part(view, of, views))


def solved(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """The x of ``matrix`` x = ``right``, ``matrix`` symmetric and positive definite: conjugate gradients, scaled by the
    diagonal (Hestenes & Stiefel 1952), to EXACT of the residual. Sums always run in the same order."""
    diagonal = np.diag(matrix).copy()
    x, rest = np.zeros_like(right), right.copy()
    step = rest / diagonal
    size = first = float(np.sum(rest * step))
    for _ in range(10 * len(right)):
        if size <= EXACT**2 * first:
            break
        ahead = _times(matrix, step[None])[:, 0]
        curvature = float(np.sum(step * ahead))
        if curvature <= 0:  # what is left is rounding
            break
        x += size / curvature * step
        rest -= size / curvature * ahead
        scaled, before = rest / diagonal, size
        size = float(np.sum(rest * scaled))
        step = scaled + size / before * step
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


def _times(left: Float[np.ndarray, "m k"], right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "m n"]:
    """``left`` times the transpose of ``right``, every sum in the same order."""
    return np.einsum("ik,jk->ij", left, right, optimize=False)


def _largest_part(view: Int[np.ndarray, "m"], point: Int[np.ndarray, "m"], views: int) -> Bool[np.ndarray, "views"]:
    """The photos of the largest part of the graph, by the smallest number that spreads over each part; none where no
    two photos share a point."""
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
