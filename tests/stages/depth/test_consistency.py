import numpy as np
import pytest

from stages.depth.consistency import (
    MAX_SIGMA,
    MIN_PATCH_PIXELS,
    SIGMA_FACTOR,
    Candidate,
    DepthMap,
    SparseDepths,
    agreed,
    plausible,
)
from stages.depth.files import read_depth_map, write_depth_map
from tests.refusals import refused

SHAPE = (2, 3)


def candidate(inverse: float, sigma: float = 0.001, per_pixel: float = 0.01) -> Candidate:
    return Candidate(*(np.full(SHAPE, value, np.float32) for value in (inverse, sigma, per_pixel)))


def test_the_majority_decides_by_its_mean() -> None:
    depth = agreed([candidate(0.500), candidate(0.504, sigma=0.002), candidate(0.3), candidate(np.nan)], SHAPE)
    inverse = (0.500 / 0.001**2 + 0.504 / 0.002**2) / (1 / 0.001**2 + 1 / 0.002**2)
    assert np.allclose(depth.distance, 1 / inverse)
    assert np.all(depth.views == 2)
    expected = SIGMA_FACTOR / np.sqrt(1 / 0.001**2 + 1 / 0.002**2) / inverse
    assert np.allclose(depth.sigma, expected, rtol=1e-4)


@pytest.mark.parametrize(
    "candidates",
    [
        [],
        [candidate(0.5)],
        [candidate(0.5), candidate(0.52)],
        [candidate(0.5), candidate(np.nan)],
        [candidate(0.5), candidate(0.504, per_pixel=0.003)],
        [candidate(0.5, sigma=MAX_SIGMA), candidate(0.5, sigma=MAX_SIGMA)],
    ],
)
def test_what_two_do_not_agree_on_is_not_known(candidates: list[Candidate]) -> None:
    depth = agreed(candidates, SHAPE)
    assert not depth.distance.any() and not depth.sigma.any() and not depth.views.any()
    assert depth.coverage == 0


def test_the_order_of_neighbours_does_not_matter() -> None:
    random = np.random.default_rng(0)
    sides = [
        Candidate(
            *(
                random.uniform(low, high, (40, 50)).astype(np.float32)
                for low, high in ((0.4, 0.5), (1e-3, 3e-3), (0.02, 0.03))
            )
        )
        for _ in range(5)
    ]
    one, other = agreed(sides, (40, 50)), agreed(sides[::-1], (40, 50))
    assert 0.5 < one.coverage <= 1
    assert np.array_equal(one.views, other.views)
    assert np.mean(np.isclose(one.distance, other.distance, rtol=1e-5)) > 0.99


def two_patches(sparse: list[tuple[int, int, float]]) -> list[bool]:
    """Whether ``plausible`` keeps the left patch, at distance 2, and the right one, at 3, with a slope; ``sparse`` are
    row, column, distance."""
    distance = np.zeros((8, 16), np.float32)
    distance[:, :7], distance[:, 7:] = 2, 3 * 1.005 ** np.arange(9)
    known = distance > 0
    depth = DepthMap(distance, np.where(known, 0.001, 0).astype(np.float32), known.astype(np.uint8))
    row, column, true = (np.array(column) for column in zip(*sparse, strict=True))
    kept = plausible(depth, SparseDepths(row, column, true))
    assert {each.dtype for each in kept} == {np.dtype(np.float32), np.dtype(np.uint8)}
    assert np.array_equal(kept.distance[kept.distance > 0], distance[kept.distance > 0])
    assert all(np.array_equal(each > 0, kept.distance > 0) for each in kept)
    shares = [float((kept.distance[:, part] > 0).mean()) for part in (slice(0, 7), slice(7, 16))]
    assert set(shares) <= {0.0, 1.0}, "a patch stays or goes as a whole"
    return [share > 0 for share in shares]


@pytest.mark.parametrize(
    ("sparse", "left", "right"),
    [
        ([(0, 0, 2.0), (0, 7, 3.0)], True, True),
        ([(0, 0, 2.1), (0, 7, 3.0)], False, True),
        ([(0, 0, 2.1), (3, 3, 2.0), (0, 8, 3.5)], True, False),
        ([(0, 0, 2.03)], True, True),
        ([(0, 15, 3.0)], True, False),
    ],
)
def test_sparse_points_decide_over_patches(sparse: list[tuple[int, int, float]], left: bool, right: bool) -> None:
    assert two_patches(sparse) == [left, right]


@pytest.mark.parametrize("pixels", [MIN_PATCH_PIXELS - 1, MIN_PATCH_PIXELS])
def test_patches_of_few_pixels_are_chance(pixels: int) -> None:
    distance = np.zeros((10, 40), np.float32)
    distance[4, :pixels] = 2
    nowhere = SparseDepths(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    kept = plausible(DepthMap(distance, distance, distance.astype(np.uint8)), nowhere)
    assert (kept.distance > 0).sum() == (pixels if pixels >= MIN_PATCH_PIXELS else 0)


def test_a_file_is_read_back_and_equal_every_time(tmp_path) -> None:
    depth = agreed([candidate(0.5), candidate(0.501)], SHAPE)
    for name in ("a", "b"):
        write_depth_map(tmp_path / name, depth)
    back = read_depth_map(tmp_path / "a")
    assert np.array_equal(back.distance, depth.distance) and np.array_equal(back.views, depth.views)
    assert np.allclose(back.sigma, depth.sigma, rtol=1e-3)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("damage", [b"", b"no depth map", None])
def test_a_damaged_file_is_named(damage: bytes | None, tmp_path) -> None:
    path = tmp_path / "a"
    write_depth_map(path, agreed([candidate(0.5), candidate(0.5)], SHAPE))
    path.write_bytes(path.read_bytes()[:-9] if damage is None else damage)
    with refused("depth.damaged-map", "a"):
        read_depth_map(path)
