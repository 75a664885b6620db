"""Whether camera poses agree with what pairs of photos say of each other: no pose or point of a model is trusted.

Every verified match (keypoint a of photo i, keypoint b of photo j) is a test. Photo i's other matches give the inverse
depth of a, without j; with it the poses predict where j sees the point. The distance to b, in pixels, is the *transfer
error*. It notices a wrong rotation, a wrong place and a wrong scale, also along a straight row of photos, where every
epipolar line stays right (Hartley and Zisserman 2004, ch. 9 and 12: epipolar geometry, triangulation).

Pairs vote with their matches, for or against; photos and groups are judged by the votes across the cut between them and
the rest. So a group that was moved as a whole, whose members agree among themselves, is found as well as one photo.

All arrays are numpy float64. A *match* is directed here: every undirected one counts once each way.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from stages.sfm.pairs.match_graph import connected, weak_cuts

MEDIAN_VARIANCE = np.pi / 2  # of a median, over that of a mean
# A pair agrees with the poses where half of its matches lie nearer to their predictions than this: so many times the
# usual distance, which is noise, and never less than a fraction of a pixel nor more than verification lets through.
# It contradicts them where they lie CLEARLY farther off: a photo that few points hold may be off a little.
TOLERANCE, MIN_TOLERANCE_PX, MAX_TOLERANCE_PX = 3.0, 0.6, 4.0
CLEARLY = 2.0
MIN_WITNESS = 30  # matches of a pair that may contradict: verification lets chance pass with half as many
CLOSEST = 1e-3  # of its distance to the other photo: nearer a point cannot be to a photo that sees it
ROUNDS = 12  # of acquittal, which goes from neighbour to neighbour
MIN_BUNDLE = 60  # agreeing matches across: twice what mapping asks of a single photo
MIN_MATCHES = 8  # of a pair, for its median to mean something
# So many steps of a row, and such a share of them, may be broken by pairs with MIN_STEP of a usual step's matches.
MAX_BREAKS, MAX_TORN, MIN_STEP = 2, 0.05, 0.5


class PairMatches(NamedTuple):
    """Verified matches of posed photos, numbered from 0; match k belongs to ``pairs[pair[k]]`` and joins two keypoints.

    Keypoints are numbered through all photos: ``photo`` says whose each is, ``bearing`` is its unit ray in the camera's
    frame (right for every camera model). ``focal_px`` turns angles into pixels, one per photo. ``weight`` is how many
    verified matches a pair has in all; those listed may be a sample.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    weight: Float[np.ndarray, "pairs"]
    pair: Int[np.ndarray, "matches"]
    keypoint: Int[np.ndarray, "matches 2"]
    photo: Int[np.ndarray, "keypoints"]
    bearing: Float[np.ndarray, "keypoints 3"]
    focal_px: Float[np.ndarray, "photos"]


def transfer_errors_px(
    matches: PairMatches,
    world_from_camera: Float[np.ndarray, "photos 3 4"],
    trusted: Bool[np.ndarray, "pairs"] | None = None,
) -> tuple[Float[np.ndarray, "2*matches"], Bool[np.ndarray, "2*matches"]]:
    """How far each match is from where the poses predict it, in pixels of the photo that sees it; the matches from
    first to second photo, then those from second to first. Depths come from ``trusted`` pairs, from all without it.

    Also which of them are predicted to a point, by a depth that others tell.

    Errors count in units of what noise would make of them were the point as far from both photos and its depth known:
    a ray transferred to a photo nearer by is vaguer there, and a depth that other pairs measured over a short baseline
    predicts little over a long one. Where nothing else tells the depth, only the
    distance to the epipolar line counts, and how far behind the camera the point would be.
    """
    source, target = (np.concatenate([matches.keypoint[:, a], matches.keypoint[:, 1 - a]]) for a in (0, 1))
    rotation, centre = world_from_camera[:, :, :3], world_from_camera[:, :, 3]
    ray = np.einsum("kij,kj->ki", rotation[matches.photo], matches.bearing)
    here, there = ray[source], ray[target]
    baseline = centre[matches.photo[target]] - centre[matches.photo[source]]
    ahead = np.einsum("ki,ki->k", baseline, here)
    sideways = ahead[:, None] * here - baseline  # the point moves that way, seen from the target, as it comes nearer
    base = np.linalg.norm(sideways, axis=1)
    sideways = np.divide(sideways, base[:, None], out=np.zeros_like(sideways), where=base[:, None] > 0)
    seen_ahead, seen_sideways = np.einsum("ki,ki->k", there, here), np.einsum("ki,ki->k", there, sideways)
    across = np.einsum("ki,ki->k", there, np.cross(here, sideways))
    across = np.where(base > 0, across, np.linalg.norm(np.cross(here, there), axis=1))
    scale = base * seen_ahead + seen_sideways * ahead  # not positive where the rays do not meet before the cameras
    meets = scale > 0
    inverse_depth = np.maximum(np.divide(seen_sideways, scale, out=np.zeros_like(base), where=meets), 0)
    evidence = np.where(meets, _sensitivity(inverse_depth, base, ahead)[1], 0.0) ** 2
    if trusted is not None:
        evidence *= np.tile(trusted[matches.pair], 2)
    others, weight = _median_of_others(inverse_depth, evidence, source)
    known = weight > 0
    others = np.where(known, others, inverse_depth)
    along = np.arctan2(seen_sideways, seen_ahead) - np.arctan2(others * base, 1 - others * ahead)
    nearness, slope = _sensitivity(others, base, ahead)
    noise = (1 + nearness**2) / 2  # of the ray that is transferred and of the one it is compared with; 1 at equal depth
    depth_noise = np.divide(MEDIAN_VARIANCE * slope**2, weight, out=np.zeros_like(base), where=known)
    angle = np.hypot(np.arcsin(np.clip(across, -1, 1)) / np.sqrt(noise), along / np.sqrt(noise + depth_noise))
    return matches.focal_px[matches.photo[target]] * angle, known


def _sensitivity(
    inverse_depth: Float[np.ndarray, "n"], base: Float[np.ndarray, "n"], ahead: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """How many times nearer a point is to the target than to the source, and by how much its direction there changes
    with its inverse depth."""
    squared = (1 - inverse_depth * ahead) ** 2 + (inverse_depth * base) ** 2
    squared = np.maximum(squared, CLOSEST**2)
    return 1 / np.sqrt(squared), base / squared


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

    ``pair_error_px`` is each pair's median transfer error, NaN of too few matches, and ``usual_px`` that of all. A pair
    ``agrees`` if it is within ``tolerance_px``, and ``contradicts`` if it is clearly beyond. ``misplaced`` are photos
    that more matches contradict than support, alone or as a group; ``unlinked`` are photos or groups that no pair links
    to the rest, so that nothing supports where they are. ``votes_for`` and ``votes_against`` are matches of each photo
    with those that are neither, ``photo_error_px`` the median over its pairs with them (NaN without).
    """

    pair_error_px: Float[np.ndarray, "pairs"]
    photo_error_px: Float[np.ndarray, "photos"]
    usual_px: float
    tolerance_px: float
    agrees: Bool[np.ndarray, "pairs"]
    contradicts: Bool[np.ndarray, "pairs"]
    misplaced: Bool[np.ndarray, "photos"]
    unlinked: Bool[np.ndarray, "photos"]
    votes_for: Float[np.ndarray, "photos"]
    votes_against: Float[np.ndarray, "photos"]

    @property
    def passed(self) -> Bool[np.ndarray, "photos"]:
        """The photos whose poses stand."""
        return ~(self.misplaced | self.unlinked)


def check_poses(matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"]) -> PoseCheck:
    """Judge photos and groups by the votes of the pairs between them and the rest.

    Groups to judge are the parts that come off the graph of agreeing pairs at its weakest places: who was moved as a
    whole agrees within, and next to nothing across. A part is misplaced if more matches across contradict than agree.
    """
    count = len(world_from_camera)
    error = pair_medians(matches, *transfer_errors_px(matches, world_from_camera))
    usual, tolerance = _usual_px(error, matches.weight)
    support, against = _votes(matches, error, tolerance, count)
    misplaced = _outvoted(support, against)
    # Depths that a misplaced group measured wrong speak against good photos beside it: these are heard once more.
    for _ in range(ROUNDS if misplaced.any() else 0):
        trusted = ~misplaced[matches.pairs].any(axis=1)
        error = pair_medians(matches, *transfer_errors_px(matches, world_from_camera, trusted))
        support, against = _votes(matches, error, tolerance, count)
        acquitted = misplaced & ((support - against)[:, ~misplaced].sum(axis=1) > 0)
        if not acquitted.any():
            break
        misplaced &= ~acquitted
    held = _matrix(matches, error <= CLEARLY * tolerance, count)
    unlinked = ~misplaced & (connected(np.where(misplaced[:, None] | misplaced[None], 0, held) > 0) > 0)
    standing = ~(misplaced | unlinked)
    return PoseCheck(
        pair_error_px=error,
        photo_error_px=_photo_medians(matches, np.where(standing[matches.pairs].all(axis=1), error, np.nan), count),
        usual_px=usual,
        tolerance_px=tolerance,
        agrees=error <= tolerance,
        contradicts=_contradicts(matches, error, tolerance),
        misplaced=misplaced,
        unlinked=unlinked,
        votes_for=support[:, standing].sum(axis=1),
        votes_against=against[:, standing].sum(axis=1),
    )


def agreement(matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"]) -> tuple[int, int]:
    """How many pairs agree with poses, and how many agree with or contradict them."""
    error = pair_medians(matches, *transfer_errors_px(matches, world_from_camera))
    _, tolerance = _usual_px(error, matches.weight)
    agreeing = int((error <= tolerance).sum())
    return agreeing, agreeing + int(_contradicts(matches, error, tolerance).sum())


def _usual_px(error_px: Float[np.ndarray, "pairs"], weight: Float[np.ndarray, "pairs"]) -> tuple[float, float]:
    """The median error of matches, and up to which one a pair agrees."""
    told = np.isfinite(error_px)
    usual = float(np.median(np.repeat(error_px[told], weight[told].astype(int)))) if told.any() else 0.0
    return usual, float(np.clip(TOLERANCE * usual, MIN_TOLERANCE_PX, MAX_TOLERANCE_PX))


def believed(
    matches: PairMatches, world_from_camera: Float[np.ndarray, "photos 3 4"], trusted: Bool[np.ndarray, "pairs"]
) -> Bool[np.ndarray, "matches"]:
    """The matches to believe beside poses that ``trusted`` pairs made, by the depths that these alone tell: where most
    pairs are mistaken, :func:`check_poses` would believe them.

    Those of trusted pairs that are not clearly off, and of others those that agree, if they are MIN_WITNESS.
    """
    error, known = (part.reshape(2, -1) for part in transfer_errors_px(matches, world_from_camera, trusted))
    pair_error = pair_medians(matches, error.reshape(-1), known.reshape(-1))
    _, tolerance = _usual_px(pair_error[trusted], matches.weight[trusted])
    off = (known & (error > CLEARLY * tolerance)).any(axis=0)
    agrees = (known & (error <= tolerance)).any(axis=0) & ~off
    enough = np.bincount(matches.pair[agrees], minlength=len(matches.pairs)) >= MIN_WITNESS
    return np.where(trusted[matches.pair], ~off, agrees & enough[matches.pair])


def _photo_medians(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], count: int
) -> Float[np.ndarray, "photos"]:
    """Of each photo the median error over its pairs, each counting by its matches; NaN where it has none."""
    photo, error = matches.pairs.T.reshape(-1), np.tile(error_px, 2)
    told = np.isfinite(error)
    photo, error, weight = photo[told], error[told], np.tile(matches.weight, 2)[told]
    found = np.full(count, np.nan)
    for number in np.unique(photo).tolist():
        mine = np.flatnonzero(photo == number)
        mine = mine[np.argsort(error[mine], kind="stable")]
        total = np.cumsum(weight[mine])
        found[number] = error[mine[np.searchsorted(total, total[-1] / 2)]]
    return found


class WeakLink(NamedTuple):
    """Photos that few matches hold to the rest."""

    photos: list[int]
    pairs: int
    matches: int


def weak_links(matches: PairMatches, check: PoseCheck) -> list[WeakLink]:
    """Groups that a single pair, or fewer than MIN_BUNDLE agreeing matches hold to the rest: the smallest ones."""
    support, _ = _votes(matches, check.pair_error_px, check.tolerance_px, len(check.misplaced))
    cuts, found = weak_cuts(support), []
    taken = np.zeros(len(check.misplaced), bool)
    for number in np.argsort(cuts.side.sum(axis=1), kind="stable").tolist():
        side, pairs, weight = cuts.side[number], int(cuts.edges[number]), float(cuts.weight[number])
        if (pairs == 1 or weight < MIN_BUNDLE) and not (side & taken).any():
            taken |= side
            found.append(WeakLink(np.flatnonzero(side).tolist(), pairs, int(weight)))
    return found


def cut_off(
    row: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck, reach: int
) -> Bool[np.ndarray, "photos"]:
    """Standing photos off the longest piece of the ``row``, in which photos were taken, where the row falls apart.

    Where parts of a scene look alike, photos of one part can stand in the other: they agree there with what they see,
    and those between the parts, which know better, are outvoted. Matches lead along the row through these, and none of
    a photo up to ``reach`` places before them agrees with one behind: there the row falls apart, and its longest piece
    alone can be relied on. So it does at every break where it is torn: many parts stand in one another then.
    """
    count = len(check.misplaced)
    verified, agrees = _matrix(matches, matches.weight >= MIN_WITNESS, count) > 0, _matrix(matches, check.agrees, count)
    leads = np.r_[True, verified[row[:-1], row[1:]]]  # to each place from the one before
    places = np.flatnonzero(check.passed[row])
    torn = is_torn(row, matches, check)
    breaks = _steps(row, matches, check, check.contradicts) > 0
    piece = np.zeros(len(places), int)
    for number in range(1, len(places)):
        before, after = places[number - 1], places[number]
        crossing = np.ix_(row[places[max(0, number - reach) : number]], row[places[number : number + reach]])
        led_through = after > before + 1 and leads[before + 1 : after + 1].all()
        broken = (led_through and not agrees[crossing].any()) or (torn and breaks[number - 1])
        piece[number] = piece[number - 1] + broken
    found = np.zeros(count, bool)
    if len(places):
        found[row[places[piece != np.bincount(piece).argmax()]]] = True
    return found


def row_breaks(row: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck) -> list[tuple[int, int]]:
    """Standing photos next to each other in the ``row``, in which photos were taken, whose own matches contradict where
    they stand to each other.

    Of right poses next to none: photos taken one after the other see the same. A row that goes on elsewhere, at a place
    that looks alike, has one.
    """
    standing = row[check.passed[row]]
    steps = np.flatnonzero(_steps(row, matches, check, check.contradicts))
    return [(int(standing[step]), int(standing[step + 1])) for step in steps]


def is_torn(row: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck) -> bool:
    """Whether more than MAX_TORN of the steps of the row, and MAX_BREAKS, are broken by pairs about as strong as those
    of whole steps: by photos that see the same, not by a place that looks alike, where the row went on elsewhere."""
    whole, broken = (_steps(row, matches, check, pairs) for pairs in (check.agrees, check.contradicts))
    if not whole.any():
        return False
    strong = broken >= MIN_STEP * np.median(whole[whole > 0])
    return bool(strong.sum() > max(MAX_BREAKS, MAX_TORN * len(strong)))


def _steps(
    row: Int[np.ndarray, "photos"], matches: PairMatches, check: PoseCheck, chosen: Bool[np.ndarray, "pairs"]
) -> Float[np.ndarray, "steps"]:
    """The matches of each step of the row from one standing photo to the next, 0 where its pair is not ``chosen``."""
    standing = row[check.passed[row]]
    return _matrix(matches, chosen, len(check.misplaced))[standing[:-1], standing[1:]]


def _outvoted(
    support: Float[np.ndarray, "photos photos"], against: Float[np.ndarray, "photos photos"]
) -> Bool[np.ndarray, "photos"]:
    """Photos on the smaller side of a cut across which more matches contradict than agree; the clearest cut first, for
    photos beside a misplaced group would be outvoted by it."""
    sides = np.concatenate([weak_cuts(support).side, np.eye(len(support), dtype=bool)]).astype(float)
    excess = against - support
    standing = np.ones(len(support))
    while True:
        part = sides * standing
        rest = standing - part
        margin = np.einsum("ci,ci->c", part @ excess, rest)
        margin[part.sum(axis=1) > rest.sum(axis=1)] = 0
        clearest = int(np.argmax(margin))
        if margin[clearest] <= 0:
            break
        standing = rest[clearest]
    return standing == 0


def pair_medians(
    matches: PairMatches, error_px: Float[np.ndarray, "2*matches"], known: Bool[np.ndarray, "2*matches"]
) -> Float[np.ndarray, "pairs"]:
    """The median transfer error of each pair, both ways, of matches ``known`` to a point where these are enough; NaN of
    fewer than MIN_MATCHES matches."""
    pair = np.tile(matches.pair, 2)
    enough = np.bincount(pair[known], minlength=len(matches.pairs)) >= MIN_MATCHES
    counted = known | ~enough[pair]
    pair, error_px = pair[counted], error_px[counted]
    order = np.lexsort((error_px, pair))
    bounds = np.searchsorted(pair[order], np.arange(len(matches.pairs) + 1))
    middle = np.minimum((bounds[:-1] + bounds[1:]) // 2, max(0, len(order) - 1))
    found = error_px[order][middle] if len(order) else np.full(len(middle), np.nan)
    return np.where(np.diff(bounds) >= MIN_MATCHES, found, np.nan)


def _votes(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], tolerance_px: float, count: int
) -> tuple[Float[np.ndarray, "photos photos"], Float[np.ndarray, "photos photos"]]:
    """The symmetric matrices of matches whose pairs agree with the poses, and of those whose pairs contradict them."""
    agree, against = error_px <= tolerance_px, _contradicts(matches, error_px, tolerance_px)
    return _matrix(matches, agree, count), _matrix(matches, against, count)


def _contradicts(
    matches: PairMatches, error_px: Float[np.ndarray, "pairs"], tolerance_px: float
) -> Bool[np.ndarray, "pairs"]:
    return (error_px > CLEARLY * tolerance_px) & (matches.weight >= MIN_WITNESS)


def _matrix(matches: PairMatches, chosen: Bool[np.ndarray, "pairs"], count: int) -> Float[np.ndarray, "photos photos"]:
    votes = np.zeros((count, count))
    first, second = matches.pairs[chosen].T
    votes[first, second] = votes[second, first] = matches.weight[chosen]
    return votes
