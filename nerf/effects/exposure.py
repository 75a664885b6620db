"""Effect ``exposure``: photos of one scene taken at different gains, one per channel (which is white balance, too).

A gain acts on light, photos are sRGB: what a photo of log gain g shows of a colour c is s(exp(g) s⁻¹(c)), where s is
the transfer curve of sRGB (nerf/rendering/srgb.py). Gains are natural logarithms, so they add up: expose(expose(c, a),
b) is expose(c, a + b), and g = log 2 is one stop (EV).

From power to power no light has to be computed: s(exp(g) s⁻¹(c)) = k (c + 0.055) - 0.055 with k = exp(g / 2.4), which
is c + (k - 1) (c + 0.055). That keeps colours as large as 1e30 finite, and c exactly what it is where g is 0.

Gains begin as the tracks measured them (nerf/effects/statistics/exposure.py) and are learnt on with the field, which
holds what the darkest photo shows: its colours end at 1, and only the photo with the least gain shows all that is
bright. So the least gain of each channel begins at one. From then on the mean of the logarithms is held, which fixes
the gauge.
"""

import math
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf.effects import HeldOutImages, Images
from nerf.geometry.rays import Rays
from nerf.rendering.srgb import linear_to_srgb, srgb_to_linear
from nerf.rendering.srgb_arrays import LINEAR_THRESHOLD, OFFSET, POWER, SLOPE

LEARNING_RATE = 2e-3  # of the logarithm of a gain; gains begin within a percent or two of where they end
MAX_LOG_GAIN = 16.0  # either way: 23 stops, beyond what any camera spans

MIN_VALUE, MAX_VALUE = 2 / 255, 253 / 255  # within, 8 bits tell a photo's log gain
MAX_PIXELS = 1 << 14  # that a fit looks at: noise of 0.05 then moves a gain by 0.002
ITERATIONS = 8  # with each of the two weights
HUBER, TUKEY = 1.345, 4.685  # standard deviations: 95 % of the efficiency of least squares on Gaussian noise
OF_GAUSSIAN = 1.4826  # standard deviation of Gaussian noise by its median absolute value
MIN_SPREAD = 1 / 255  # no residual spreads less than a step of the photos


class ExposureModel:
    """A :class:`nerf.effects.ColourEffect`. ``log_gain``: natural logarithms of gains in linear light, a row per
    view."""

    name: ClassVar = "exposure"
    learning_rate: ClassVar = LEARNING_RATE
    row_length: ClassVar = 3
    held_out_words: ClassVar = "exposed as the photos taken nearest by"

    def __init__(self, log_gain: Float[Tensor, "views 3"]) -> None:
        self.log_gain = log_gain.clone()
        self.mean = self.log_gain.mean(0)

    @classmethod
    def initial(cls, images: Images, measured: Float[Tensor, "views 3"] | None) -> "ExposureModel":
        """From gains that are known up to a factor per channel; None: all alike."""
        if measured is None:
            measured = torch.zeros_like(images.scene_from_camera[:, :, 3])
        return cls(measured - measured.amin(0))

    @classmethod
    def restored(cls, images: Images, rows: Float[Tensor, "views 3"]) -> "ExposureModel":
        """Gains as they were learnt."""
        return cls(rows)

    @classmethod
    def of_new_view(cls, rows: Float[Tensor, "views 3"]) -> "ExposureModel":
        """The reference exposure: the median over the photos, per channel."""
        return cls(rows.median(0).values[None])

    @classmethod
    def new_view_words(cls, rows: Float[Tensor, "views 3"]) -> str:
        """In stops (EV) above the photo with the least exposure, the three channels on the mean."""
        stops = float(rows.median(0).values.double().mean() - rows.double().mean(1).min()) / math.log(2)
        return f"reference exposure, {round(stops, 2) + 0.0:+.2f} EV over the least exposed photo"  # no -0

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views 3"]]:
        """The logarithms of the gains."""
        return {"log_gain": self.log_gain}

    @property
    def rows(self) -> Float[Tensor, "views 3"]:
        """The same."""
        return self.log_gain

    def fix_gauge(self) -> None:
        """Keep the mean: a field twice as bright under gains half as large shows the same."""
        self.log_gain -= self.log_gain.mean(0) - self.mean

    def of_held_out(self, held_out: HeldOutImages) -> "ExposureModel":
        """Gains like those of the photos taken nearest by: a camera that sets its exposure sees there what they saw."""
        return ExposureModel(held_out.weights.to(self.log_gain) @ self.log_gain)

    def forward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]
    ) -> Float[Tensor, "rays 3"]:
        """The colours at the gains of their photos."""
        return expose(colour, self.log_gain.index_select(0, view))

    def inverse(self, shown: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """Log gains add up to nothing."""
        return expose(shown, -self.log_gain.index_select(0, view))

    def backward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"], grad: Float[Tensor, "rays 3"]
    ) -> tuple[Float[Tensor, "rays 3"], dict[str, Tensor]]:
        """By the chain rule; a photo's gain moves all of its rays."""
        of_colour, of_gain = expose_backward(colour, self.log_gain.index_select(0, view), grad)
        return of_colour, {"log_gain": torch.zeros_like(self.log_gain).index_add_(0, view, of_gain)}


def expose(colour: Float[Tensor, "*n 3"], log_gain: Float[Tensor, "*#n #3"]) -> Float[Tensor, "*n 3"]:
    """What a photo of gain exp(``log_gain``) shows of sRGB colours, s(exp(g) s⁻¹(c)); not clipped above 1.

    expose(c, 0) is c, bit for bit. Colours below 0 count as 0, gains beyond MAX_LOG_GAIN as that.
    """
    return _shown(_branches(colour, log_gain))


def expose_backward(
    colour: Float[Tensor, "*n 3"], log_gain: Float[Tensor, "*#n #3"], grad: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*#n #3"]]:
    """Gradients of a loss by the colours and the log gains, given that by what :func:`expose` shows."""
    done = _branches(colour, log_gain)
    by_gain = _slope(done, _shown(done))
    from_power = by_gain * POWER / (done.colour + OFFSET)  # by_gain · d log s⁻¹(c) / dc
    from_line = torch.where(
        done.bright, by_gain / done.colour.clamp(min=LINEAR_THRESHOLD / 1e9), done.gain
    )  # never divides by 0
    by_colour = torch.where(done.was_bright, from_power, from_line) * (colour >= 0)
    by_gain = by_gain * (log_gain.abs() <= MAX_LOG_GAIN)
    return grad * by_colour, (grad * by_gain).sum_to_size(log_gain.shape)


class _Branches(NamedTuple):
    """Colours with their gains, and on which side of the sRGB curve's threshold they were and come to be."""

    colour: Tensor
    log_gain: Tensor
    gain: Tensor
    powered: Tensor  # what is shown if both sides are bright
    straight: Tensor  # if both are dark
    was_bright: Bool[Tensor, "..."]
    bright: Bool[Tensor, "..."]


def _branches(colour: Tensor, log_gain: Tensor) -> _Branches:
    colour, log_gain = torch.broadcast_tensors(colour.clamp(min=0), log_gain.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN))
    gain = log_gain.exp()
    powered = colour + torch.expm1(log_gain / POWER) * (colour + OFFSET)
    straight = colour * gain
    was_bright = colour > LINEAR_THRESHOLD
    bright = torch.where(was_bright, powered, straight) > LINEAR_THRESHOLD
    return _Branches(colour, log_gain, gain, powered, straight, was_bright, bright)


def _shown(done: _Branches) -> Tensor:
    rising = linear_to_srgb(done.straight / SLOPE)
    falling = SLOPE * done.gain * srgb_to_linear(done.colour)
    from_power = torch.where(done.bright, done.powered, falling)
    from_line = torch.where(done.bright, rising, done.straight)
    return torch.where(done.was_bright, from_power, from_line)


def _slope(done: _Branches, shown: Tensor) -> Tensor:
    """d shown / d log gain = s'(L) L of the light L that is shown."""
    return torch.where(done.bright, (shown + OFFSET) / POWER, shown)


def fit_log_gain(shown: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """The log gains that make ``shown`` (a rendering, sRGB) like ``truth`` (a photo of it, sRGB).

    Per channel, g minimises the sum of w (min(s(exp(g) s⁻¹(shown)), 1) - truth)², the error in sRGB that pictures are
    judged by, with Gauss-Newton from the median of the logarithmic ratios. Weights w (Yohai 1987): Huber's first,
    under which all pixels agree on one gain and on how far they spread about it; then Tukey's at that spread, which
    leave out what differs for other reasons. Saturated pixels ask for no more than being saturated. 0 where nothing
    tells a gain: without pixels, or where the rendering is black.
    """
    count = len(shown)
    chosen = torch.linspace(0, count - 1, min(count, MAX_PIXELS), dtype=torch.float64).round().long()
    pair = (picture[chosen.to(picture.device)].double() for picture in (shown, truth))
    channels = zip(*(picture.clamp(min=0).unbind(-1) for picture in pair), strict=True)
    return torch.stack([_fit_channel(*channel) for channel in channels]).to(shown.dtype)


def _fit_channel(shown: Float[Tensor, "n"], truth: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    log_gain, spread = _first_guess(shown, truth), shown.new_tensor(MIN_SPREAD)
    for iteration in range(2 * ITERATIONS):
        done = _branches(shown, log_gain)
        exposed = _shown(done)
        telling = (exposed < 1) & (
            _slope(done, exposed) > MIN_SPREAD
        )  # the others' error does not change with the gain
        if not telling.any():
            break
        slope, residual = _slope(done, exposed)[telling], (exposed - truth.clamp(max=1))[telling]
        if iteration < ITERATIONS:
            spread = (OF_GAUSSIAN * residual.abs().median()).clamp(min=MIN_SPREAD)
            weight = HUBER * spread / residual.abs().clamp(min=HUBER * spread)
        else:
            weight = (1 - (residual / (TUKEY * spread)) ** 2).clamp(min=0) ** 2
        gradient, curvature = (weight * slope * residual).sum(), (weight * slope**2).sum()
        if curvature <= 0:
            break
        log_gain = (log_gain - (gradient / curvature).clamp(-1, 1)).clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)
    return log_gain


def _first_guess(shown: Float[Tensor, "n"], truth: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """The median logarithmic ratio of pixels that are neither black nor saturated; of those that are, if there are no
    others."""
    seen = shown > MIN_VALUE
    within = seen & (truth > MIN_VALUE) & (truth < MAX_VALUE)
    told = within if within.any() else seen
    if not told.any():
        return shown.new_zeros(())
    light = srgb_to_linear(truth[told].clamp(MIN_SPREAD / 2, 1))
    return (light.log() - srgb_to_linear(shown[told]).log()).median().clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)
