"""Whether camera poses agree with the verified matches of image pairs: no pose or point of a model is trusted.

Every verified match (keypoint a of photo i, keypoint b of photo j) is a test. Photo i's other matches give the inverse
depth of a, without j; with it the poses predict where j sees the point. The distance to b, in pixels, is the *transfer
error*. It detects a wrong rotation, position and scale, also along a straight line of photos, where every epipolar
line stays right (Hartley and Zisserman 2004, ch. 9 and 12: epipolar geometry, triangulation).

Pairs vote with their matches, for or against the poses. Photos and groups are classified by the votes across the cut
between them and the rest. So a group that was moved as a whole, whose members agree among themselves, is found as well
as one photo.

All arrays are numpy float64. A *match* is directed here: every undirected one counts once each way.
"""

from collections.abc import Container
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from stages.sfm.pairs.match_graph import connected, weak_cuts

MEDIAN_VARIANCE = np.pi / 2  # of a median, over that of a mean
# A pair agrees with the poses where half of its matches lie nearer to their predictions than a tolerance:
# TOLERANCE_FACTOR times the median error, which is noise, and never less than a fraction of a pixel nor more than
# verification accepts. It contradicts them beyond CONTRADICTION_FACTOR times the tolerance: a photo with few points may
# be off a little.
TOLERANCE_FACTOR, MIN_TOLERANCE_PX, MAX_TOLERANCE_PX = 3.0, 0.6, 4.0
CONTRADICTION_FACTOR = 2.0
MIN_PAIR_MATCHES = 30  # of a pair that may contradict: verification lets chance matches pass with half as many
MIN_RELATIVE_DEPTH = 1e-3  # of its distance to the other photo: nearer a point cannot be to a photo that sees it
MAX_RECHECKS = 12  # of misplaced photos; being cleared goes on from neighbour to neighbour
MIN_LINK_MATCHES = 60  # agreeing matches across a cut: twice what mapping asks of a single photo
MIN_MATCHES_FOR_MEDIAN = 8  # of a pair
# The median error under right poses is 1.2 to 2.9 times the noise of the matches, with the camera model of mapping too
# (docs/experiments/match_graph.md); where it is this many times, and more than MIN_TOLERANCE_PX allows in any case, the
# poses as a whole are wrong. Then every pair is a little wrong, and none is worse than the others.
MAX_NOISE_MULTIPLE = 4.0
# So many pairs of consecutive photos, and such a fraction of them, may contradict the poses with at least
# MIN_STEP_STRENGTH of the matches that consecutive photos have in the median.
MAX_BROKEN_STEPS, MAX_BROKEN_FRACTION, MIN_STEP_STRENGTH = 2, 0.05, 0.5


class PairMatches(NamedTuple):
    """Verified matches of posed photos, numbered from 0; match k belongs to ``pairs[pair[k]]`` and joins two keypoints.

    Keypoints are numbered through all photos: ``photo`` says whose each is, ``ray_direction`` is its unit ray in the
    camera's frame (right for every camera model). ``focal_px`` turns angles into pixels, one per photo. ``weight`` is
    how many verified matches a pair has in all; those listed may be a sample. ``pair_noise_px`` is the median distance
    of a pair's matches from the epipolar geometry of its two photos alone, which no pose of a model bends; NaN where it
    is not known.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    weight: Float[np.ndarray, "pairs"]
    pair: Int[np.ndarray, "matches"]
    keypoint: Int[np.ndarray, "matches 2"]
    photo: Int[np.ndarray, "keypoints"]
    ray_direction: Float[np.ndarray, "keypoints 3"]
    focal_px: Float[np.ndarray, "photos"]
    pair_noise_px: Float[np.ndarray, "pairs"]

    @property
    def noise_px(self) -> float:
        """That of half of the pairs; NaN where it is known of none."""
        known = self.pair_noise_px[np.isfinite(self.pair_noise_px)]
        return float(np.median(known)) if len(known) else np.nan


def transfer_errors_px(
    matches: PairMatches,
    world_from_camera: Float[np.ndarray, "photos 3 4"],
    trusted: Bool[np.ndarray, "pairs"] | None = None,
) -> tuple[Float[np.ndarray, "2*matches"], Bool[np.ndarray, "2*matches"]]:
    """How far each match is from where the poses predict it, in pixels of the photo that sees it; the matches from
    first to second photo, then those from second to first. Depths come from ``trusted`` pairs, without it from all of
    MIN_PAIR_MATCHES and more: chance matches tell no depth.

    Also which of them are predicted to a point, by a depth that others tell.

    Errors count in units of what noise would make of them were the point as far from both photos and its depth known: a
    ray transferred to a photo nearer by is vaguer there, and a depth that other pairs measured over a short baseline
    predicts little over a long one. Where nothing else tells the depth, only the distance to the epipolar line counts,
    and how far behind the camera the point would be.
    """
    source, target = (np.concatenate([matches.keypoint[:, a], matches.keypoint[:, 1 - a]]) for a in (0, 1))
    seen = _in_epipolar_planes(matches, world_from_camera, source, target)
    scale = seen.base * seen.ahead + seen.sideways * seen.step  # not positive where rays do not meet before the cameras
    meets = scale > 0
    inverse_depth = np.maximum(np.divide(seen.sideways, scale, out=np.zeros_like(scale), where=meets), 0)
    sure = matches.weight >= MIN_PAIR_MATCHES if trusted is None else trusted
    evidence = np.where(meets, _sensitivity(seen, inverse_depth)[1], 0.0) ** 2 * np.tile(sure[matches.pair], 2)
    others, weight = _median_of_others(inverse_depth, evidence, source)
    known = weight > 0
    predicted = np.where(known, others, inverse_depth)
    along = np.arctan2(seen.sideways, seen.ahead) - np.arctan2(predicted * seen.base, 1 - predicted * seen.step)
    nearness, slope = _sensitivity(seen, predicted)
    noise = (1 + nearness**2) / 2  # of the ray that is transferred and of the one it is compared with; 1 at equal depth
    depth_noise = np.divide(MEDIAN_VARIANCE * slope**2, weight, out=np.zeros_like(slope), where=known)
    angle = np.hypot(np.arcsin(np.clip(seen.across, -1, 1)) / np.sqrt(noise), along / np.sqrt(noise + depth_noise))
    return matches.focal_px[matches.photo[target]] * angle, known


class _SeenRays(NamedTuple):
    """The targets' rays of directed matches, in the axes of their epipolar planes: *ahead* is the source's ray,
    *sideways* at a right angle to it in the plane, where the point moves, seen from the target, as it comes nearer, and
    *across* the plane's normal. From source to target it is ``step`` ahead and ``base`` against sideways. Where there
    is no base, ``sideways`` is 0 and ``across`` all that is not ahead."""

    step: Float[np.ndarray, "n"]
    base: Float[np.ndarray, "n"]
    ahead: Float[np.ndarray, "n"]
    sideways: Float[np.ndarray, "n"]
    across: Float[np.ndarray, "n"]


def _in_epipolar_planes(
    matches: PairMatches,
    world_from_camera: Float[np.ndarray, "photos 3 4"],
    source: Int[np.ndarray, "n"],
    target: Int[np.ndarray, "n"],
) -> _SeenRays:
    rotation, centre = world_from_camera[:, :, :3], world_from_camera[:, :, 3]
    ray = np.einsum("kij,kj->ki", rotation[matches.photo], matches.ray_direction)
    ahead, there = ray[source], ray[target]
    baseline = centre[matches.photo[target]] - centre[matches.photo[source]]
    step = np.einsum("ki,ki->k", baseline, ahead)
    sideways = step[:, None] * ahead - baseline
    base = np.linalg.norm(sideways, axis=1)
    sideways = np.divide(sideways, base[:, None], out=np.zeros_like(sideways), where=base[:, None] > 0)
    seen_ahead, seen_sideways = np.einsum("ki,ki->k", there, ahead), np.einsum("ki,ki->k", there, sideways)
    across = np.einsum("ki,ki->k", there, np.cross(ahead, sideways))
    across = np.where(base > 0, across, np.linalg.norm(np.cross(ahead, there), axis=1))
    return _SeenRays(step, base, seen_ahead, seen_sideways, across)


def _sensitivity(
    seen: _SeenRays, inverse_depth: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """How many times nearer a point is to the target than to the source, and by how much its direction there changes
    with its inverse depth."""
    squared = (1 - inverse_depth * seen.step) ** 2 + (inverse_depth * seen.base) ** 2
    squared = np.maximum(squared, MIN_RELATIVE_DEPTH**2)
    return 1 / np.sqrt(squared), seen.base / squared


def _median_of_others(
    value: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"], group: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Of each entry the weighted median of the other entries of its group, and their weight together (0: none)."""
    order = np.lexsort((value, group))
    value, weight, group = value[order], weight[order], group[order]
    begins = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
    ends = np.r_[begins[1:], len(group)]
    total = np.cumsum(weight)
    first, last = np.repeat(begins, ends - begins), np.repeat(ends, ends - begins) - 1
    before = total[first] - weight[first]
    others = np.maximum(total[last] - before - weight, 0)
    place = np.arange(len(group))
    # Without the entry itself, sums from its place on are smaller by its weight.
    half = before + others / 2
    median = np.searchsorted(total, half)
    after = np.maximum(np.searchsorted(total, half + weight), place + 1)
    median = np.clip(np.where(median < place, median, after), first, last)
    median = np.where((median == place), np.where(place > first, place - 1, np.minimum(place + 1, last)), median)
    found = np.where(last > first, value[median], np.nan)
    others = np.where(last > first, others, 0)
    out, out_weight = np.empty_like(value), np.empty_like(weight)
    out[order], out_weight[order] = found, others
    return out, out_weight


# --- votes


class PoseCheck(NamedTuple):
    """What verified pairs say of poses.

    ``pair_error_px`` is each pair's median transfer error, NaN of too few matches, and ``median_px`` that of all. A
    pair ``agrees`` if it is within ``tolerance_px``, and ``contradicts`` if it is clearly beyond. ``misplaced`` are
    photos that more matches contradict than support, alone or as a group; ``unlinked`` are photos or groups that no
    pair links to the rest, so that nothing supports where they are. ``votes_for`` and ``votes_against`` are matches of
    each photo with those that are neither, ``photo_error_px`` the median over its pairs with them (NaN without).
    """

    pair_error_px: Float[np.ndarray, "pairs"]
    photo_error_px: Float[np.ndarray, "photos"]
    median_px: float
    tolerance_px: float
    agrees: Bool[np.ndarray, "pairs"]
    contradicts: Bool[np.ndarray, "pairs"]
    misplaced: Bool[np.ndarray, "photos"]
    unlinked: Bool[np.ndarray, "photos"]
    votes_for: Float[np.ndarray, "photos"]
    votes_against: Float[np.ndarray, "photos"]

    @property
    def passed(self) -> Bool[np.ndarray, "photos"]:
        """The photos whose poses pass the check."""
        return ~(self.misplaced | self.unlinked)


def check_poses(
    matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"], max_tolerance_px: float = MAX_TOLERANCE_PX
) -> PoseCheck:
    """Classify photos and groups by the votes of the pairs between them and the rest.

    The groups are the sides of weak cuts of the graph of agreeing pairs: a group that was moved as a whole agrees
    within, and hardly across. A group is misplaced if more matches across contradict than agree.
    """
    count, nowhere = len(world_from_camera), np.zeros(len(matches.pairs), bool)
    error = _pair_errors_px(matches, world_from_camera, nowhere)
    _, tolerance = _tolerance_px(error, matches.weight, max_tolerance_px)
    misplaced = _misplaced(*_votes(matches, error, tolerance, count))
    error = _pair_errors_px(matches, world_from_camera, _trusted(matches, misplaced))
    median, tolerance = _tolerance_px(error, matches.weight, max_tolerance_px)
    support, against = _votes(matches, error, tolerance, count)
    misplaced = _misplaced(support, against)
    # Depths that a misplaced group got wrong count against good photos beside it: these are checked again without.
    for _ in range(MAX_RECHECKS if misplaced.any() else 0):
        error = _pair_errors_px(matches, world_from_camera, _trusted(matches, misplaced))
        support, against = _votes(matches, error, tolerance, count)
        cleared = misplaced & ((support - against)[:, ~misplaced].sum(axis=1) > 0)
        if not cleared.any():
            break
        misplaced &= ~cleared
    agrees, contradicts = error <= tolerance, _contradicts(matches, error, tolerance)
    linked = _matrix(matches, _links(matches, error, tolerance), count)
    unlinked = ~misplaced & (connected(np.where(misplaced[:, None] | misplaced[None], 0, linked) > 0) > 0)
    passed = ~(misplaced | unlinked)
    counted = passed[matches.pairs].all(axis=1) & (agrees | (matches.weight >= MIN_PAIR_MATCHES))
    return PoseCheck(
        pair_error_px=error,
        photo_error_px=_photo_medians(matches, np.where(counted, error, np.nan), count),
        median_px=median,
        tolerance_px=tolerance,
        agrees=agrees,
        contradicts=contradicts,
        misplaced=misplaced,
        unlinked=unlinked,
        votes_for=support[:, passed].sum(axis=1),
        votes_against=against[:, passed].sum(axis=1),
    )


def _trusted(matches: PairMatches, misplaced: Bool[np.ndarray, "photos"]) -> Bool[np.ndarray, "pairs"]:
    """The pairs that may tell depths: enough matches not to be chance, of photos that are not misplaced."""
    return ~misplaced[matches.pairs].any(axis=1) & (matches.weight >= MIN_PAIR_MATCHES)


def fits_as_a_whole(matches: PairMatches, check: PoseCheck) -> bool:
    """Whether the matches are about as near to where the poses predict them as to the epipolar geometry of their two
    photos alone. True where that is not known."""
    exact_enough = check.median_px <= MIN_TOLERANCE_PX / TOLERANCE_FACTOR
    return exact_enough or not check.median_px > MAX_NOISE_MULTIPLE * matches.noise_px


def median_error_px(matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"]) -> float:
    """How far half of the matches lie from where the poses predict them."""
    return _tolerance_px(_pair_errors_px(matches, world_from_camera), matches.weight)[0]


def agreement(
    matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"], among: Bool[np.ndarray, "pairs"]
) -> tuple[int, int]:
    """How many pairs, of those ``among`` them, agree with poses, and how many agree with or contradict them."""
    error = _pair_errors_px(matches, world_from_camera)
    _, tolerance = _tolerance_px(error, matches.weight)
    agreeing = int((error <= tolerance)[among].sum())
    return agreeing, agreeing + int(_contradicts(matches, error, tolerance)[among].sum())


def _tolerance_px(
    error_px: Float[np.ndarray, "pairs"], weight: Float[np.ndarray, "pairs"], most_px: float = MAX_TOLERANCE_PX
) -> tuple[float, float]:
    """The median error of matches, and up to which one a pair agrees."""
    known = np.isfinite(error_px)
    median = float(np.median(np.repeat(error_px[known], weight[known].astype(int)))) if known.any() else 0.0
    return median, tolerance_px(median, most_px)


def tolerance_px(median_px: float, most_px: float = MAX_TOLERANCE_PX) -> float:
    """Up to which median error something agrees with poses under which the errors have this median."""
    return float(np.clip(TOLERANCE_FACTOR * median_px, MIN_TOLERANCE_PX, most_px))


def consistent_matches(
    matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"], trusted: Bool[np.ndarray, "pairs"]
) -> Bool[np.ndarray, "matches"]:
    """The matches consistent with poses that ``trusted`` pairs made, by the depths that these pairs alone give: where
    most pairs are mistaken, :func:`check_poses` would trust them.

    Those of trusted pairs that do not contradict the poses, and of other pairs those that agree, if they are at least
    MIN_PAIR_MATCHES.
    """
    error, known = (part.reshape(2, -1) for part in transfer_errors_px(matches, world_from_camera, trusted))
    pair_error = pair_medians(matches, error.reshape(-1), known.reshape(-1))
    _, tolerance = _tolerance_px(pair_error[trusted], matches.weight[trusted])
    off = (known & (error > CONTRADICTION_FACTOR * tolerance)).any(axis=0)
    agrees = (known & (error <= tolerance)).any(axis=0) & ~off
    enough = np.bincount(matches.pair[agrees], minlength=len(matches.pairs)) >= MIN_PAIR_MATCHES
    return np.where(trusted[matches.pair], ~off, agrees & enough[matches.pair])


def supported_pairs(
    matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"], trusted: Bool[np.ndarray, "pairs"]
) -> Bool[np.ndarray, "pairs"]:
    """The ``trusted`` pairs whose matches, all together, agree with the poses, by the depths that trusted pairs alone
    give.

    Stricter than :func:`check_poses`, which believes a pair that neither agrees nor contradicts: where a sequence hangs
    by one pair from photo to photo, that pair has to agree."""
    error = _pair_errors_px(matches, world_from_camera, trusted)
    _, tolerance = _tolerance_px(error[trusted], matches.weight[trusted])
    return trusted & (error <= tolerance)


def _photo_medians(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], count: int
) -> Float[np.ndarray, "photos"]:
    """Of each photo the median error over its pairs, each counting by its matches; NaN where it has none."""
    photo, error = matches.pairs.T.reshape(-1), np.tile(error_px, 2)
    known = np.isfinite(error)
    photo, error, weight = photo[known], error[known], np.tile(matches.weight, 2)[known]
    found = np.full(count, np.nan)
    for number in np.unique(photo).tolist():
        mine = np.flatnonzero(photo == number)
        mine = mine[np.argsort(error[mine], kind="stable")]
        total = np.cumsum(weight[mine])
        found[number] = error[mine[np.searchsorted(total, total[-1] / 2)]]
    return found


class WeakLink(NamedTuple):
    """Photos that few matches link to the rest."""

    photos: list[int]
    pairs: int
    matches: int


def weak_links(matches: PairMatches, check: PoseCheck) -> list[WeakLink]:
    """Groups that a single pair, or fewer than MIN_LINK_MATCHES agreeing matches link to the rest: the smallest
    ones."""
    support, _ = _votes(matches, check.pair_error_px, check.tolerance_px, len(check.misplaced))
    cuts, found = weak_cuts(support), []
    taken = np.zeros(len(check.misplaced), bool)
    for number in np.argsort(cuts.side.sum(axis=1), kind="stable").tolist():
        side, pairs, weight = cuts.side[number], int(cuts.edges[number]), float(cuts.weight[number])
        if (pairs == 1 or weight < MIN_LINK_MATCHES) and not (side & taken).any():
            taken |= side
            found.append(WeakLink(np.flatnonzero(side).tolist(), pairs, int(weight)))
    return found


def outside_main_segment(
    sequence: Int[np.ndarray, "photos"],
    matches: PairMatches,
    check: PoseCheck,
    reach: int,
    supported: Container[tuple[int, int]] | None = None,
) -> Bool[np.ndarray, "photos"]:
    """Photos that passed and are outside the longest segment of the capture ``sequence``, where the poses break it.

    Where a scene has repeated structure, photos of one part can be registered in another: they agree there with what
    they see and outvote those between the parts, which are right. Such a break is where matches lead along the sequence
    through photos that failed, and no photo up to ``reach`` positions before them agrees with one behind: only the
    longest segment can be relied on. Where :func:`is_fragmented` holds, every broken step separates segments; where
    ``supported`` steps (photos in order of the sequence) are given, every other step does.
    """
    count = len(check.misplaced)
    verified, agrees = (
        _matrix(matches, matches.weight >= MIN_PAIR_MATCHES, count) > 0,
        _matrix(matches, check.agrees, count),
    )
    linked = np.r_[True, verified[sequence[:-1], sequence[1:]]]  # each position with the one before
    positions = np.flatnonzero(check.passed[sequence])
    fragmented = is_fragmented(sequence, matches, check)
    breaks = _step_matches(sequence, matches, check, check.contradicts) > 0
    segment = np.zeros(len(positions), int)
    for number in range(1, len(positions)):
        before, after = positions[number - 1], positions[number]
        crossing = np.ix_(
            sequence[positions[max(0, number - reach) : number]], sequence[positions[number : number + reach]]
        )
        leads_through = after > before + 1 and linked[before + 1 : after + 1].all()
        broken = (leads_through and not agrees[crossing].any()) or (fragmented and breaks[number - 1])
        step = (int(sequence[before]), int(sequence[after]))
        broken = broken or (supported is not None and step not in supported)
        segment[number] = segment[number - 1] + broken
    outside = np.zeros(count, bool)
    if len(positions):
        outside[sequence[positions[segment != np.bincount(segment).argmax()]]] = True
    return outside


def sequence_breaks(
    sequence: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck
) -> list[tuple[int, int]]:
    """Consecutive photos of the capture ``sequence`` that passed and whose own matches contradict their relative pose.

    Right poses have next to none: photos taken one after the other see the same. A sequence that goes on in another
    part of repeated structure has one.
    """
    passed = sequence[check.passed[sequence]]
    steps = np.flatnonzero(_step_matches(sequence, matches, check, check.contradicts))
    return [(int(passed[step]), int(passed[step + 1])) for step in steps]


def is_fragmented(sequence: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck) -> bool:
    """Whether more than MAX_BROKEN_FRACTION of the steps of the sequence, and MAX_BROKEN_STEPS, are broken by pairs
    with about as many matches as agreeing steps have: by photos that see the same, not by repeated structure at which
    the sequence went on elsewhere."""
    agreeing, broken = (_step_matches(sequence, matches, check, pairs) for pairs in (check.agrees, check.contradicts))
    if not agreeing.any():
        return False
    strong = broken >= MIN_STEP_STRENGTH * np.median(agreeing[agreeing > 0])
    return bool(strong.sum() > max(MAX_BROKEN_STEPS, MAX_BROKEN_FRACTION * len(strong)))


def _step_matches(
    sequence: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck, chosen: Bool[np.ndarray, "pairs"]
) -> Float[np.ndarray, "steps"]:
    """The matches of each step of the sequence from one passed photo to the next, 0 where its pair is not
    ``chosen``."""
    passed = sequence[check.passed[sequence]]
    return _matrix(matches, chosen, len(check.misplaced))[passed[:-1], passed[1:]]


def _misplaced(
    support: Float[np.ndarray, "photos photos"], against: Float[np.ndarray, "photos photos"]
) -> Bool[np.ndarray, "photos"]:
    """Photos on the smaller side of a cut across which more matches contradict than agree. The clearest cut comes
    first: photos beside a misplaced group would be outvoted by it."""
    sides = np.concatenate([weak_cuts(support).side, np.eye(len(support), dtype=bool)]).astype(float)
    excess = against - support
    remaining = np.ones(len(support))
    while True:
        part = sides * remaining
        rest = remaining - part
        margin = np.einsum("ci,ci->c", part @ excess, rest)
        margin[part.sum(axis=1) > rest.sum(axis=1)] = 0
        clearest = int(np.argmax(margin))
        if margin[clearest] <= 0:
            break
        remaining = rest[clearest]
    return remaining == 0


def pair_medians(
    matches: PairMatches, error_px: Float[np.ndarray, "2*matches"], known: Bool[np.ndarray, "2*matches"]
) -> Float[np.ndarray, "pairs"]:
    """The median transfer error of each pair, both ways, of matches ``known`` to a point where these are enough; NaN of
    fewer than MIN_MATCHES_FOR_MEDIAN matches."""
    pair = np.tile(matches.pair, 2)
    enough = np.bincount(pair[known], minlength=len(matches.pairs)) >= MIN_MATCHES_FOR_MEDIAN
    counted = known | ~enough[pair]
    pair, error_px = pair[counted], error_px[counted]
    order = np.lexsort((error_px, pair))
    bounds = np.searchsorted(pair[order], np.arange(len(matches.pairs) + 1))
    middle = np.minimum((bounds[:-1] + bounds[1:]) // 2, max(0, len(order) - 1))
    found = error_px[order][middle] if len(order) else np.full(len(middle), np.nan)
    return np.where(np.diff(bounds) >= MIN_MATCHES_FOR_MEDIAN, found, np.nan)


def _pair_errors_px(
    matches: PairMatches,
    world_from_camera: Float[np.ndarray, "photos 3 4"],
    trusted: Bool[np.ndarray, "pairs"] | None = None,
) -> Float[np.ndarray, "pairs"]:
    """:func:`pair_medians` of :func:`transfer_errors_px`."""
    return pair_medians(matches, *transfer_errors_px(matches, world_from_camera, trusted))


def _votes(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], tolerance_px: float, count: int
) -> tuple[Float[np.ndarray, "photos photos"], Float[np.ndarray, "photos photos"]]:
    """The symmetric matrices of matches whose pairs agree with the poses, and of those whose pairs contradict them."""
    agree, against = error_px <= tolerance_px, _contradicts(matches, error_px, tolerance_px)
    return _matrix(matches, agree, count), _matrix(matches, against, count)


def _contradicts(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], tolerance_px: float
) -> Bool[np.ndarray, "pairs"]:
    return (error_px > CONTRADICTION_FACTOR * tolerance_px) & (matches.weight >= MIN_PAIR_MATCHES)


def _links(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], tolerance_px: float
) -> Bool[np.ndarray, "pairs"]:
    """The pairs that agree with the poses, and those that are too inexact to do so and do not contradict them: a
    blurred photo among sharp ones has no others."""
    known = np.isfinite(matches.pair_noise_px)
    own_px = TOLERANCE_FACTOR * np.where(known, matches.pair_noise_px, 0.0)
    return error_px <= np.clip(own_px, tolerance_px, CONTRADICTION_FACTOR * tolerance_px)


def _matrix(matches: PairMatches, chosen: Bool[np.ndarray, "pairs"], count: int) -> Float[np.ndarray, "photos photos"]:
    votes = np.zeros((count, count))
    first, second = matches.pairs[chosen].T
    votes[first, second] = votes[second, first] = matches.weight[chosen]
    return votes
