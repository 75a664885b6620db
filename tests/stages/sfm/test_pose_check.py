from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.sfm.pose_check import (
    CONTRADICTION_FACTOR,
    MIN_PAIR_MATCHES,
    PairMatches,
    _median_of_others,
    check_poses,
    outside_main_segment,
    pair_medians,
    sequence_breaks,
    supported_pairs,
    transfer_errors_px,
    weak_links,
)

FOCAL_PX = 800.0
STEP = 0.2  # between photos, that are 2 from what they see: 80 px of parallax


def walk(photos: int = 30, points: int = 1500, noise_px: float = 0.4, reach: int = 5) -> tuple[PairMatches, np.ndarray]:
    """A straight line of photos along a wall of depth 2 to 3, each matched with the ``reach`` next ones."""
    random = np.random.default_rng(0)
    length = STEP * photos
    world = random.uniform((-1, -1, 2), (length + 1, 1, 3), (points, 3))
    centres = np.stack([STEP * np.arange(photos), np.zeros(photos), np.zeros(photos)], axis=1)
    poses = np.concatenate([np.tile(np.eye(3), (photos, 1, 1)), centres[:, :, None]], axis=2)
    seen = [np.flatnonzero(np.abs((world - centre)[:, 0] / world[:, 2]) < 0.5) for centre in centres]
    rays = [world[some] - centre for some, centre in zip(seen, centres, strict=True)]
    rays = [
        ray / ray[:, 2:] + np.pad(random.normal(0, noise_px / FOCAL_PX, (len(ray), 2)), ((0, 0), (0, 1)))
        for ray in rays
    ]
    begins = np.concatenate([[0], np.cumsum([len(some) for some in seen])])
    pairs, keypoints = [], []
    for first in range(photos):
        for second in range(first + 1, min(first + reach + 1, photos)):
            _, here, there = np.intersect1d(seen[first], seen[second], return_indices=True)
            if len(here):
                pairs.append((first, second))
                keypoints.append(np.stack([begins[first] + here, begins[second] + there], axis=1))
    ray_direction = np.concatenate(rays)
    counts = [len(some) for some in keypoints]
    return PairMatches(
        pairs=np.array(pairs),
        weight=np.array(counts, float),
        pair=np.repeat(np.arange(len(pairs)), counts),
        keypoint=np.concatenate(keypoints),
        photo=np.repeat(np.arange(photos), np.diff(begins)),
        ray_direction=ray_direction / np.linalg.norm(ray_direction, axis=1, keepdims=True),
        focal_px=np.full(photos, FOCAL_PX),
        pair_noise_px=np.full(len(pairs), np.nan),
    ), poses


def moved(
    poses: np.ndarray, photos: list[int], degrees: float = 0.0, shift: tuple[float, ...] = (0, 0, 0)
) -> np.ndarray:
    """A group turned about its middle, and shifted by so many steps."""
    poses = poses.copy()
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.8, 0.0])).as_matrix()
    middle = poses[photos][:, :, 3].mean(axis=0)
    poses[photos, :, :3] = turn @ poses[photos, :, :3]
    poses[photos, :, 3] = (poses[photos, :, 3] - middle) @ turn.T + middle + STEP * np.array(shift)
    return poses


def test_right_poses_pass_and_errors_are_the_noise() -> None:
    matches, poses = walk()
    check = check_poses(matches, poses)
    assert check.passed.all() and check.agrees.all()
    assert 0.3 < check.median_px < 1.2
    assert (check.votes_against == 0).all() and not weak_links(matches, check)


def test_exact_matches_have_no_error() -> None:
    matches, poses = walk(noise_px=0.0)
    error, known = transfer_errors_px(matches, poses)
    assert error.max() < 1e-6 and known.mean() > 0.9


def test_poses_may_be_in_any_frame_and_scale() -> None:
    matches, poses = walk(photos=10)
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    other = np.concatenate([turn @ poses[:, :, :3], (7.3 * poses[:, :, 3] @ turn.T + [5, -40, 3])[:, :, None]], axis=2)
    there, here = (pair_medians(matches, *transfer_errors_px(matches, of)) for of in (other, poses))
    np.testing.assert_allclose(there, here, rtol=0.02)  # equal weights are ties, which rounding decides


@pytest.mark.parametrize("photos", [[12], [0], [29], [10, 11, 12], list(range(14, 17)), list(range(12))])
@pytest.mark.parametrize(
    ("degrees", "shift"),
    [
        (2.0, (0, 0, 0)),
        (30.0, (0, 0, 0)),
        (0.0, (0.1, 0, 0)),  # along the line every epipolar line stays as it was
        (0.0, (0, 0.1, 0)),
        (0.0, (0, 0, -5)),
        (10.0, (3, 2, 1)),
    ],
)
def test_moved_photos_and_groups_are_found_and_no_others(
    photos: list[int], degrees: float, shift: tuple[float, ...]
) -> None:
    matches, poses = walk()
    check = check_poses(matches, moved(poses, photos, degrees, shift))
    assert np.flatnonzero(~check.passed).tolist() == photos


def test_wrong_pairs_do_not_misplace_photos_with_better_ones() -> None:
    """Repeated structure: a tenth of all pairs are wrong."""
    matches, poses = walk()
    random = np.random.default_rng(1)
    wrong = random.choice(len(matches.pairs), len(matches.pairs) // 10, replace=False)
    keypoint = matches.keypoint.copy()
    for pair in wrong.tolist():
        mine = matches.pair == pair
        keypoint[mine, 1] = random.permutation(keypoint[mine, 1])
    check = check_poses(matches._replace(keypoint=keypoint), poses)
    assert check.passed.all()
    assert np.flatnonzero(check.contradicts).tolist() == sorted(wrong.tolist())


def test_a_group_without_pairs_to_the_rest_is_unlinked() -> None:
    matches, poses = walk()
    kept = (matches.pairs[:, 0] < 7) == (matches.pairs[:, 1] < 7)
    check = check_poses(restricted(matches, kept), poses)
    assert np.flatnonzero(check.unlinked).tolist() == list(range(7)) and not check.misplaced.any()


def test_a_photo_that_no_pair_agrees_with_is_unlinked() -> None:
    """Its one pair is off, though too little to contradict its pose: nothing supports where it is."""
    matches, poses = walk()
    last = len(poses) - 1
    matches = restricted(matches, (matches.pairs[:, 1] != last) | (matches.pairs[:, 0] == last - 1))
    check = check_poses(matches, moved(poses, [last], degrees=0.2))
    error = check.pair_error_px[matches.pairs[:, 1] == last]
    assert check.tolerance_px < error < CONTRADICTION_FACTOR * check.tolerance_px
    assert np.flatnonzero(check.unlinked).tolist() == [last] and not check.misplaced.any()


def test_a_blurred_photo_is_linked_by_inexact_pairs() -> None:
    """All of its pairs are off, by no more than their own matches are from any geometry."""
    matches, poses = walk()
    random, blurred = np.random.default_rng(3), 12
    ray = matches.ray_direction.copy()
    mine = matches.photo == blurred
    ray[mine] += random.normal(0, 2.2 / FOCAL_PX, (mine.sum(), 3)) * [1, 1, 0]
    of_it = (matches.pairs == blurred).any(axis=1)
    matches = matches._replace(ray_direction=ray / np.linalg.norm(ray, axis=1, keepdims=True))
    sharp = check_poses(matches, poses)
    error = sharp.pair_error_px[of_it]
    assert (error > sharp.tolerance_px).all() and (error < CONTRADICTION_FACTOR * sharp.tolerance_px).all()
    assert np.flatnonzero(sharp.unlinked).tolist() == [blurred]
    known = check_poses(matches._replace(pair_noise_px=np.where(of_it, 1.5, 0.4)), poses)
    assert known.passed.all()


def test_a_single_pair_across_is_a_weak_link() -> None:
    matches, poses = walk()
    across = (matches.pairs[:, 0] < 7) & (matches.pairs[:, 1] >= 7)
    kept = ~across | np.array([pair == [6, 7] for pair in matches.pairs.tolist()])
    matches = restricted(matches, kept)
    check = check_poses(matches, poses)
    (link,) = weak_links(matches, check)
    assert check.passed.all() and link.photos == list(range(7)) and link.pairs == 1


def test_chance_matches_cut_off_no_photo() -> None:
    """They have no more than verification lets pass, and would tell wrong depths of what the right pair sees."""
    matches, poses = walk()
    random, last = np.random.default_rng(3), 29
    matches = restricted(matches, (matches.pairs[:, 1] != last) | (matches.pairs[:, 0] == last - 1))
    held = int(np.flatnonzero(matches.pairs[:, 1] == last)[0])
    mine = matches.pair == held  # and no other photo sees what these two do
    lone = ~np.isin(matches.keypoint, matches.keypoint[mine]).any(axis=1)
    matches = matches._replace(pair=matches.pair[lone | mine], keypoint=matches.keypoint[lone | mine])
    seen = matches.keypoint[matches.pair == held, 1]
    partners = np.arange(24, 28)
    chance = [
        np.stack([random.choice(np.flatnonzero(matches.photo == photo), 20), random.choice(seen, 20)], axis=1)
        for photo in partners
    ]
    matches = matches._replace(
        pairs=np.concatenate([matches.pairs, np.stack([partners, np.full(4, last)], axis=1)]),
        weight=np.concatenate([matches.weight, np.full(4, 20.0)]),
        pair=np.concatenate([matches.pair, np.repeat(len(matches.pairs) + np.arange(4), 20)]),
        keypoint=np.concatenate([matches.keypoint, *chance]),
        pair_noise_px=np.concatenate([matches.pair_noise_px, np.full(4, np.nan)]),
    )
    check = check_poses(matches, poses)
    assert check.passed.all() and not check.contradicts.any() and check.agrees[held]
    assert check.photo_error_px[last] < 1.5
    assert [link.photos for link in weak_links(matches, check)] == [[last]]
    elsewhere = check_poses(matches, moved(poses, [last], 5.0))  # epipolar lines notice
    assert np.flatnonzero(~elsewhere.passed).tolist() == [last]


@pytest.mark.parametrize(
    ("middle", "led_through", "lost"),
    [
        (range(10, 16), True, range(10)),
        (range(10, 13), True, range(0)),  # matches reach over these
        (range(10, 16), False, range(0)),  # a new sequence may begin there
    ],
)
def test_photos_that_fail_in_the_middle_break_the_sequence(middle: range, led_through: bool, lost: range) -> None:
    matches, poses = walk()
    if not led_through:
        matches = restricted(matches, ~((matches.pairs[:, 0] <= 12) & (matches.pairs[:, 1] > 12)))
    check = check_poses(matches, moved(poses, list(middle), 0.0, (0, 0, -5)))
    linked = check._replace(misplaced=np.isin(np.arange(30), middle), unlinked=np.zeros(30, bool))  # as by a false loop
    assert np.flatnonzero(outside_main_segment(np.arange(30), matches, linked, 5)).tolist() == list(lost)


def test_a_contradicted_consecutive_pair_is_a_break() -> None:
    matches, poses = walk()
    sequence = np.arange(30)
    assert sequence_breaks(sequence, matches, check_poses(matches, poses)) == []
    elsewhere = moved(poses, list(range(12)), 0.0, (0, 0, -5))
    trusting = check_poses(matches, elsewhere)._replace(misplaced=np.zeros(30, bool), unlinked=np.zeros(30, bool))
    assert sequence_breaks(sequence, matches, trusting) == [(11, 12)]
    assert sequence_breaks(sequence[::2], matches, trusting) == [(10, 12)]


@pytest.mark.parametrize(
    ("breaks", "kept_of_breaks", "lost"),
    [
        ([[5, 6], [7, 8], [19, 20]], 1.0, [*range(8), *range(20, 30)]),
        (
            [[5, 6], [7, 8], [19, 20]],
            0.4,
            [],
        ),  # weaker than agreeing steps: the sequence may have gone on in another part
        ([[7, 8], [19, 20]], 1.0, []),  # no more than two breaks
    ],
)
def test_of_a_fragmented_sequence_only_the_longest_segment_stays(
    breaks: list[list[int]], kept_of_breaks: float, lost: list[int]
) -> None:
    matches, poses = walk()
    sequence, ends = np.arange(30), [0, *(second for _, second in breaks), 30]
    weight = np.where([pair in breaks for pair in matches.pairs.tolist()], kept_of_breaks, 1.0) * matches.weight
    matches = matches._replace(weight=np.maximum(weight, MIN_PAIR_MATCHES))
    for number, (first, after) in enumerate(pairwise(ends)):
        poses = moved(poses, list(range(first, after)), 0.0, (0, 0, -5.0 * number))
    trusting = check_poses(matches, poses)._replace(misplaced=np.zeros(30, bool), unlinked=np.zeros(30, bool))
    assert sequence_breaks(sequence, matches, trusting) == [tuple(step) for step in breaks]
    assert np.flatnonzero(outside_main_segment(sequence, matches, trusting, 5)).tolist() == lost


def test_a_step_that_holds_a_sequence_has_to_agree() -> None:
    matches, poses = walk()
    steps = matches.pairs[:, 1] == matches.pairs[:, 0] + 1
    assert supported_pairs(matches, poses, steps)[steps].all()
    bent = moved(poses, list(range(12, 30)), 0.2)
    check = check_poses(matches, bent)._replace(misplaced=np.zeros(30, bool), unlinked=np.zeros(30, bool))
    unsupported = steps & ~supported_pairs(matches, bent, steps)
    assert matches.pairs[unsupported].tolist() == [[11, 12]]
    assert not check.contradicts[unsupported].any(), "the check alone leaves it in doubt"
    assert not outside_main_segment(np.arange(30), matches, check, 5).any()
    supported = {(i, i + 1) for i in range(29) if i != 11}
    assert np.flatnonzero(outside_main_segment(np.arange(30), matches, check, 5, supported)).tolist() == [*range(12)]


def restricted(matches: PairMatches, kept: np.ndarray) -> PairMatches:
    """Only some of the pairs."""
    of = kept[matches.pair]
    number = np.cumsum(kept) - 1
    return matches._replace(
        pairs=matches.pairs[kept],
        weight=matches.weight[kept],
        pair=number[matches.pair[of]],
        keypoint=matches.keypoint[of],
        pair_noise_px=matches.pair_noise_px[kept],
    )


def test_photos_in_one_position_are_checked_by_rotation() -> None:
    matches, poses = walk(photos=6, noise_px=0.0)
    here = poses.copy()
    here[:, :, 3] = 0.0
    error, _ = transfer_errors_px(matches, here)
    assert np.isfinite(error).all() and np.median(error) > 10


def test_nothing_to_compare_is_no_evidence() -> None:
    none = PairMatches(
        np.zeros((0, 2), int), np.zeros(0), np.zeros(0, int), np.zeros((0, 2), int), np.zeros(0, int),
        np.zeros((0, 3)), np.ones(3), np.zeros(0),
    )  # fmt: skip
    check = check_poses(none, np.tile(np.eye(3, 4), (3, 1, 1)))
    assert not check.misplaced.any() and check.unlinked.sum() == 2


def test_medians_leave_each_entry_itself_out() -> None:
    random = np.random.default_rng(2)
    value, weight, group = random.normal(size=400), random.uniform(0.1, 2, 400), random.integers(0, 60, 400)
    found, others = _median_of_others(value, weight, group)
    for entry in range(400):
        rest = np.flatnonzero((group == group[entry]) & (np.arange(400) != entry))
        if not len(rest):
            assert others[entry] == 0
            continue
        assert others[entry] == pytest.approx(weight[rest].sum())
        rest = rest[np.argsort(value[rest])]
        total = np.cumsum(weight[rest])
        expected = value[rest[np.searchsorted(total, total[-1] / 2)]]
        assert found[entry] == pytest.approx(expected)


def test_pairs_with_few_matches_have_no_median() -> None:
    matches, poses = walk(photos=4)
    few = restricted(matches, np.ones(len(matches.pairs), bool))
    mine = np.flatnonzero(few.pair == 0)
    keep = np.ones(len(few.pair), bool)
    keep[mine[3:]] = False
    few = few._replace(pair=few.pair[keep], keypoint=few.keypoint[keep])
    medians = pair_medians(few, *transfer_errors_px(few, poses))
    assert np.isnan(medians[0]) and np.isfinite(medians[1:]).all()
