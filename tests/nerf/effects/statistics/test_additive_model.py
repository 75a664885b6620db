import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nerf.effects.statistics.additive_model import AdditiveModel, additive_model, conjugate_gradients, inverted


def drawn(seed: int, views: int = 7, points: int = 40) -> tuple[AdditiveModel, np.ndarray]:
    """A layout in which some photos see a point twice, and weights."""
    draw = np.random.default_rng(seed)
    point = np.sort(draw.integers(0, points, 200))
    layout = additive_model(draw.integers(0, views, 200), point, views)
    return layout, draw.uniform(0.1, 3, 200)


def slow_fit(layout: AdditiveModel, y: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gains and what is left, by least squares over a design matrix with a column per photo and per point."""
    points = layout.point.max() + 1
    design = np.concatenate([np.eye(layout.views)[layout.view], np.eye(points)[layout.point]], axis=1)
    root = np.sqrt(weight)
    solution = np.linalg.lstsq(design * root[:, None], y * root, rcond=None)[0]
    gain = solution[: layout.views]
    return gain - gain.mean(), y - design @ solution


def test_parts_and_rest_are_those_of_least_squares() -> None:
    layout, weight = drawn(0)
    y = np.random.default_rng(1).normal(size=200)
    gain, rest = slow_fit(layout, y, weight)
    np.testing.assert_allclose(layout.view_effects(y, weight), gain, atol=1e-9)
    np.testing.assert_allclose(layout.residuals(y, weight), rest, atol=1e-9)


def test_what_is_of_photos_and_points_alone_leaves_nothing() -> None:
    layout, weight = drawn(2)
    draw = np.random.default_rng(3)
    y = draw.normal(size=layout.views)[layout.view] + draw.normal(size=40)[layout.point]
    np.testing.assert_allclose(layout.residuals(y, weight), 0, atol=1e-9)


def test_errors_are_those_of_repeated_draws() -> None:
    layout, weight = drawn(4, points=80)
    draw = np.random.default_rng(5)
    gains, errors = [], []
    for _ in range(300):
        y = draw.normal(size=200) / np.sqrt(weight)
        gains.append(layout.view_effects(y, weight))
        errors.append(layout.standard_errors(layout.residuals(y, weight), weight))
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(errors), axis=0)), np.std(gains, axis=0), rtol=0.25)


def test_the_slope_is_that_of_least_squares_with_its_error() -> None:
    layout, weight = drawn(6)
    draw = np.random.default_rng(7)
    x = draw.normal(size=200) + layout.view
    off = []
    for _ in range(200):
        y = 0.7 * x + draw.normal(size=layout.views)[layout.view] + draw.normal(size=200) / np.sqrt(weight)
        slope, error = layout.slope(y, x, weight)
        off.append((slope - 0.7) / error)
    assert 0.85 < np.std(off) < 1.25 and abs(np.mean(off)) < 0.3


def test_slopes_of_single_photos_are_no_common_slope() -> None:
    """Light from one side: what a photo has in common is one draw, however many of its points show it."""
    draw = np.random.default_rng(8)
    layout, weight = additive_model(draw.integers(0, 20, 2000), np.repeat(np.arange(400), 5), 20), np.ones(2000)
    x, off = draw.normal(size=2000), []
    for _ in range(100):
        y = draw.normal(size=20)[layout.view] * x + 0.1 * draw.normal(size=2000)
        slope, error = layout.slope(y, x, weight)
        off.append(slope / error)
    assert 0.7 < np.std(off) < 2, "5 by points alone"


def test_no_slope_over_what_belongs_to_photos() -> None:
    layout, weight = drawn(8)
    slope, error = layout.slope(np.random.default_rng(9).normal(size=200), 1.0 * layout.view, weight)
    assert slope == 0 and np.isinf(error)


def test_the_largest_part_of_the_graph() -> None:
    view = np.array([0, 1, 1, 2, 4, 5, 3])
    point = np.array([0, 0, 1, 1, 2, 2, 3])
    np.testing.assert_array_equal(additive_model(view, point, 6).connected, [True, True, True, False, False, False])
    assert not additive_model(np.zeros(0, int), np.zeros(0, int), 3).connected.any()
    assert not additive_model(np.array([0, 1]), np.array([0, 1]), 2).connected.any()


@pytest.mark.parametrize("length", [2, 3, 10])
def test_all_pairs_of_a_point_are_there_once(length: int) -> None:
    layout = additive_model(np.tile(np.arange(length), 2), np.repeat([0, 1], length), length)
    pairs = set(zip(layout.first.tolist(), layout.second.tolist(), strict=True))
    assert len(pairs) == len(layout.first) == length * (length - 1)
    assert all(a < b and (a < length) == (b < length) for a, b in pairs)


def chain(seed: int, size: int, weakest: float) -> np.ndarray:
    """The Laplacian of photos in a row, the links between them from ``weakest`` to 1, made regular as in a fit."""
    link = np.exp(np.random.default_rng(seed).uniform(np.log(weakest), 0, size - 1))
    matrix = np.diag(np.append(link, 0) + np.append(0, link)) - np.diag(link, 1) - np.diag(link, -1)
    return matrix + np.trace(matrix) / size**2


@pytest.mark.parametrize(("size", "weakest"), [(1, 1.0), (2, 1.0), (40, 1.0), (300, 0.1), (60, 1e-5)])
def test_equations_are_solved_as_exactly_as_by_lapack(size: int, weakest: float) -> None:
    matrix = chain(0, size, weakest) if size > 1 else np.array([[3.0]])
    truth = np.random.default_rng(1).normal(size=size)
    right = matrix @ truth
    allowed = 1e-9 * max(1.0, np.linalg.cond(matrix) / 1e4)
    np.testing.assert_allclose(conjugate_gradients(matrix, right), truth, atol=allowed)
    np.testing.assert_allclose(inverted(matrix) @ right, truth, atol=allowed)
    assert np.array_equal(conjugate_gradients(matrix, np.zeros(size)), np.zeros(size))


FIT = """
import hashlib

import numpy as np

from nerf.effects.statistics.exposure import fit_exposure
from tests.nerf.effects.statistics.photographed_points import photographed_points

tracks = photographed_points(0, views=160, points=1200, per_point=6, log_gain=np.random.default_rng(0).normal(size=160))
fit = fit_exposure(tracks)
print(hashlib.sha256(fit.log_gain.tobytes() + fit.error.tobytes()).hexdigest())
"""


def test_gains_are_the_same_bytes_with_any_blas() -> None:
    """Threads and kernels are what BLAS chooses by the machine; LAPACK gives other last digits with each of these."""
    found = set()
    for threads, kernels in (("1", "PRESCOTT"), ("2", "HASWELL")):
        blas = {"OPENBLAS_NUM_THREADS": threads, "OPENBLAS_CORETYPE": kernels}
        root = Path(__file__).parents[4]
        done = subprocess.run(
            [sys.executable, "-c", FIT], cwd=root, env=os.environ | blas, check=True, capture_output=True, text=True
        )
        found.add(done.stdout.strip())
    assert len(found) == 1 and len(found.pop()) == 64
