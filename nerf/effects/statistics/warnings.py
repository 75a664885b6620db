"""What photos show that no effect models and a user can do something about: each statistic is a warning and switches
nothing. Blurred photos are named one by one by ingest (stages/ingest/sharpness.py)."""

import numpy as np
from jaxtyping import Float, Int

from nerf.effects.statistics.additive_model import additive_model
from nerf.effects.statistics.exposure import EV, THRESHOLD_EV, ExposureFit, or_all
from nerf.effects.statistics.outlier_images import OutlierImages
from nerf.effects.statistics.pose_refinement import PX, THRESHOLD_PX
from nerf.effects.statistics.statistic import OF_GAUSSIAN, Statistic, classify, unknown
from nerf.effects.statistics.tracks import MAX_IN_TRACK, TrackColours, within_groups
from nerf.rendering.srgb_arrays import linear_light

# Light through a medium is J exp(-b d) + A (1 - exp(-b d)) (Koschmieder 1924) with A nearly grey: the difference of the
# largest and the least channel falls as exp(-b d). Over their mean it does too, for colours about as bright as A, and
# exposure and shading fall out. A fifth of the colour lost between near and far photos is what anyone sees.
MIN_FADING = 0.2
MIN_COLOUR = 0.08  # difference of channels as sRGB values, below which it is noise
# Small spots fade in far photos that show them blurred, their colours most of all (JPEG keeps half of the resolution):
# windows count by how even they are, half where their grey values deviate by this.
ROUGH = 0.02

# A sample that stands for a pixel is right at one size. Detail between one octave and the next is what photos at twice
# the distance cannot show and photos at the other show whole: from there on they contradict each other at edges (the
# grey zone), and at two octaves at most of them (mip-NeRF, Barron et al. 2021, loses 10 dB and more at eight-fold).
MIN_SIZE_RATIO = 4.0
SIZE_QUANTILE = 0.95

# A share q of all pixels showing something else, by some 0.3, adds 0.09 q to the squared error where the field has it
# right, and as much again where it is led astray: 0.15 % of them would be 1.1 dB. Points are no pixels, and
# surfaces that hide each other are expected wrongly: one percent of all points is beyond doubt.
MIN_TRANSIENT_SHARE = 0.01

MIN_MOTION_PX = 2.0  # per frame, at 1000 pixels, below which rows have no time to differ


def tone_statistic(fit: ExposureFit) -> Statistic:
    """Whether gains alone are not enough: how much photos' gains differ between bright points and dark ones, EV per
    deviation of brightness. The threshold is that of exposure."""
    known = fit.known & np.isfinite(fit.contrast_error)
    if not known.any() or fit.brightness_spread == 0:
        return unknown("EV", THRESHOLD_EV, fit.unknown_because, False)
    scale = fit.brightness_spread / EV
    counted = or_all(known & (fit.contrast_error * scale < THRESHOLD_EV), known)
    contrast, error = fit.contrast[counted] * scale, fit.contrast_error[counted] * scale
    noise = float(np.median(error))
    spread = float(np.sqrt(max(np.mean(contrast**2) - np.mean(error**2), 0.0)))
    words = f"gains differ by {spread:.2g} ± {noise:.1g} EV between bright and dark points"
    return classify(spread, noise, THRESHOLD_EV, "EV", words)


def transients_statistic(outliers: OutlierImages, fit: ExposureFit) -> Statistic:
    """The share of all points that photos show in another colour beyond what is usual for a photo, of those photos only
    where it is much more than in the others."""
    if not fit.known.any():
        return unknown("share", MIN_TRANSIENT_SHARE, fit.unknown_because, False)
    photos = int(np.count_nonzero(outliers.seen))
    if not photos:
        return unknown("share", MIN_TRANSIENT_SHARE, "too few photos with enough points", False)
    found = float(np.sum(outliers.beyond[outliers.much]) / photos)
    # where no photo is an outlier, one could have been overlooked
    variance = (
        np.sum(outliers.variance[outliers.much]) if outliers.much.any() else np.mean(outliers.variance[outliers.seen])
    )
    noise = float(np.sqrt(variance)) / photos
    words = (
        f"{outliers.much.sum()} of {photos} photos are outliers: they show {found:.1%} of all points in another colour"
    )
    return classify(found, noise, MIN_TRANSIENT_SHARE, "share", words)


def scale_variation_statistic(tracks: TrackColours) -> Statistic:
    """The 95th percentile over points of the largest by the smallest footprint, over the photos that see each; or the
    ratio of the 95th by the 5th percentile of photos, where that is more.

    Features are matched over an octave or two, so far and near photos of the same thing may share no point, but others
    between them do: ln(footprint) = size[photo] + size[point], fitted to all, compares photos by way of these.
    """
    order = np.lexsort((tracks.footprint, tracks.point))
    rank, length = within_groups(tracks.point[order])
    several = length > 1
    if not several.any():
        return unknown("×", MIN_SIZE_RATIO, "no tracks", False)
    size = tracks.footprint[order]
    ratio = size[several & (rank == length - 1)] / size[several & (rank == 0)]
    found = float(np.quantile(ratio, SIZE_QUANTILE))
    # the quantiles that are a binomial deviation off: the standard error of a quantile without a distribution
    off = np.sqrt(SIZE_QUANTILE * (1 - SIZE_QUANTILE) / len(ratio))
    below, above = np.quantile(ratio, [SIZE_QUANTILE - off, min(SIZE_QUANTILE + off, 1.0)])
    whole = _size_ratio_of_photos(tracks)
    words = f"pixel sizes differ {found:.2g}-fold at one point, and {whole:.2g}-fold between connected photos"
    return classify(max(found, whole), float(above - below) / 2, MIN_SIZE_RATIO, "×", words)


def _size_ratio_of_photos(tracks: TrackColours) -> float:
    """The ratio of the sizes of pixels between nine tenths of the connected photos."""
    seen = tracks.only(np.lexsort((tracks.view, tracks.point)))
    rank, length = within_groups(seen.point)
    seen = seen.only((length > 1) & (rank < MAX_IN_TRACK))
    layout = additive_model(seen.view, seen.point, seen.views)
    if not layout.connected.any():
        return 1.0
    size = layout.view_effects(np.log(seen.footprint), np.ones(len(seen)))[layout.connected]
    return float(np.exp(np.ptp(np.quantile(size, [1 - SIZE_QUANTILE, SIZE_QUANTILE]))))


def participating_media_statistic(tracks: TrackColours, fit: ExposureFit) -> Statistic:
    """The exponent of fading over the range of distances at which points are seen (nine tenths of it): the slope of the
    logarithm of saturation over distance within photos and points alike. Where nothing is known, that is no reason
    to expect fog."""
    colour = tracks.colour[fit.used]
    strong = np.ptp(colour, axis=1) > MIN_COLOUR
    if not strong.any():
        return unknown("", MIN_FADING, "no colourful points", False)
    # a point counts where it is strong in all its photos, or fading would leave out its own faintest cases
    point = fit.layout.point
    strong = (np.bincount(point, strong) == np.bincount(point))[point]
    part = fit.used[strong]
    layout = additive_model(tracks.view[part], tracks.point[part], tracks.views)
    if not layout.connected.any():
        return unknown("", MIN_FADING, "no colourful points", False)
    light, distance, weight = (
        linear_light(tracks.colour[part]),
        tracks.distance[part],
        _evenness_weights(tracks.only(part)),
    )
    slope, error = layout.slope(np.log(np.ptp(light, axis=1) / light.mean(axis=1)), distance, weight)
    if not np.isfinite(error):
        return unknown("", MIN_FADING, "every point is seen from the same distance", False)
    reach = float(np.ptp(np.quantile(layout.within_points(distance, weight), [0.05, 0.95])))
    fading = max(-slope * reach, 0.0)
    words = f"colours fade by {1 - np.exp(-fading):.0%} ± {error * reach:.0%} from near to far photos"
    found = classify(fading, error * reach, MIN_FADING, "", words)
    return found._replace(called_for=bool(found.called_for))


def _evenness_weights(tracks: TrackColours) -> Float[np.ndarray, "k"]:
    """Faint colours are noisy, and rough windows are not the same piece of a surface."""
    rough = 0.0 if tracks.texture is None else tracks.texture / ROUGH
    return np.ptp(tracks.colour, axis=1) ** 2 / (1 + rough**2)


def rolling_shutter_statistic(
    residual: Float[np.ndarray, "k 2"],
    row: Float[np.ndarray, "k"],
    motion: Float[np.ndarray, "views 2"],
    view: Int[np.ndarray, "k"],
) -> Statistic:
    """The error at the upper and lower edges of a frame of usual motion, PX: half the product of the motion and of the
    readout as a part of the time between frames. Called for where it harms as wrong poses do
    (nerf/effects/statistics/pose_refinement.py).

    ``residual``: observed minus projected, PX; ``row``: across the sensor's rows, as a share of the photo
    (:func:`across_rows`); ``motion``: how far the picture moves from a frame to the next, PX, NaN where it is not known
    or the photos are no video. The row at y shows the scene (y - 1/2) readouts later (or earlier, where the camera was
    turned about), so residual = ± readout (y - 1/2) motion; what poses could take up of it (shift, zoom) is gone after
    a bundle adjustment, and what is found is a lower bound.
    """
    speed = np.linalg.norm(motion, axis=1)
    moving = np.isfinite(speed) & (speed > MIN_MOTION_PX)
    kept = moving[view]
    if np.count_nonzero(kept) < 100 or np.count_nonzero(moving) < 3:
        return unknown(PX, THRESHOLD_PX, "no video, or hardly any motion", False)
    along = np.sum(residual[kept] * motion[view[kept]], axis=1) / speed[view[kept]]
    limit = 4 * OF_GAUSSIAN * float(np.median(np.abs(along)))
    along = np.clip(along, -limit, limit)  # false matches
    expected = (row[kept] - 0.5) * speed[view[kept]]
    size = float(np.sum(expected**2))
    readout = float(np.sum(expected * along)) / size
    # frames are taken as independent, their points are not
    score = np.bincount(view[kept], expected * (along - readout * expected), len(speed))
    edge = float(np.median(speed[moving])) / 2
    noise = float(np.sqrt(np.sum(score**2))) / size * edge
    off = f"{abs(readout) * edge:.2g} ± {noise:.1g} px at the upper and lower edges, at 1000 pixels"
    words = f"readout takes {abs(readout):.0%} of the time between frames: {off}"
    found = classify(abs(readout) * edge, noise, THRESHOLD_PX, PX, words)
    return found._replace(called_for=bool(found.called_for))


def across_rows(xy: Float[np.ndarray, "k 2"], size: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
    """Where pixels of photos of width and height ``size`` lie across the sensor's rows, from 0 to 1: along the shorter
    side, for sensors are wider than high, and a frame that is higher than wide was turned."""
    turned = size[:, 0] < size[:, 1]
    return np.where(turned, xy[:, 0] / size[:, 0], xy[:, 1] / size[:, 1])


def motion_to_next(
    xy: Float[np.ndarray, "k 2"],
    point: Int[np.ndarray, "k"],
    view: Int[np.ndarray, "k"],
    frame: Int[np.ndarray, "views"],
) -> Float[np.ndarray, "views 2"]:
    """How far the picture moves from a frame to the next one, in the pixels of ``xy``: the median over the points that
    both see; NaN where they share fewer than ten, and where the next view is not the next frame by its number."""
    views = len(frame)
    motion = np.full((views, 2), np.nan)
    of_view = [np.flatnonzero(view == number) for number in range(views)]
    for number in np.flatnonzero(np.diff(frame) == 1):
        here, there = of_view[number], of_view[number + 1]
        _, left, right = np.intersect1d(point[here], point[there], return_indices=True)
        if len(left) >= 10:
            motion[number] = np.median(xy[there[right]] - xy[here[left]], axis=0)
    return motion
