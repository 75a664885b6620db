"""Exposure: photos of one scene taken at different gains, one per channel (which is white balance, too).

A gain acts on light, photos are sRGB: what a photo of log gain g shows of a colour c is s(exp(g) s⁻¹(c)), where s is
the transfer curve of sRGB (nerf/rendering/srgb.py). Gains are natural logarithms, so they add up: expose(expose(c, a),
b) is expose(c, a + b), and g = log 2 is one stop (EV).

From power to power no light has to be computed: s(exp(g) s⁻¹(c)) = k (c + 0.055) - 0.055 with k = exp(g / 2.4), which
is c + (k - 1) (c + 0.055). That keeps colours as large as 1e30 finite, and c exactly what it is where g is 0.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf.fields.interface import RadianceModel, Rendering
from nerf.geometry.rays import Rays
from nerf.rendering.srgb import KNEE, OFFSET, POWER, SLOPE, linear_to_srgb, srgb_to_linear

LARGEST = 16.0  # of a log gain, either way: 23 stops, beyond what any camera spans

DARKEST, LIGHTEST = 2 / 255, 253 / 255  # within, 8 bits tell a photo's log gain
MOST_PIXELS = 1 << 14  # that a fit looks at: noise of 0.05 then moves a gain by 0.002
ITERATIONS = 8  # with each of the two weights
HUBER, TUKEY = 1.345, 4.685  # standard deviations: 95 % of the efficiency of least squares on Gaussian noise
OF_GAUSSIAN = 1.4826  # standard deviation of Gaussian noise by its median absolute value
FINEST = 1 / 255  # no residual spreads less than a step of the photos


def expose(colour: Float[Tensor, "*n 3"], log_gain: Float[Tensor, "*#n 3"]) -> Float[Tensor, "*n 3"]:
    """What a photo of gain exp(``log_gain``) shows of sRGB colours, s(exp(g) s⁻¹(c)); not clipped above 1.

    expose(c, 0) is c, bit for bit. Colours below 0 count as 0, gains beyond LARGEST as that.
    """
    return _shown(_branches(colour, log_gain))


def expose_backward(
    colour: Float[Tensor, "*n 3"], log_gain: Float[Tensor, "*#n 3"], grad: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*#n 3"]]:
    """Gradients of a loss by the colours and the log gains, given that by what :func:`expose` shows."""
    done = _branches(colour, log_gain)
    by_gain = _slope(done, _shown(done))
    from_power = by_gain * POWER / (done.colour + OFFSET)  # by_gain · d log s⁻¹(c) / dc
    from_line = torch.where(done.bright, by_gain / done.colour.clamp(min=KNEE / 1e9), done.gain)  # never divides by 0
    by_colour = torch.where(done.was_bright, from_power, from_line) * (colour >= 0)
    by_gain = by_gain * (log_gain.abs() <= LARGEST)
    return grad * by_colour, (grad * by_gain).sum_to_size(log_gain.shape)


class _Branches(NamedTuple):
    """Colours with their gains, and on which side of the knee they were and come to be."""

    colour: Tensor
    log_gain: Tensor
    gain: Tensor
    powered: Tensor  # what is shown if both sides are bright
    straight: Tensor  # if both are dark
    was_bright: Bool[Tensor, "..."]
    bright: Bool[Tensor, "..."]


def _branches(colour: Tensor, log_gain: Tensor) -> _Branches:
    colour, log_gain = torch.broadcast_tensors(colour.clamp(min=0), log_gain.clamp(-LARGEST, LARGEST))
    gain = log_gain.exp()
    powered = colour + torch.expm1(log_gain / POWER) * (colour + OFFSET)
    straight = colour * gain
    was_bright = colour > KNEE
    bright = torch.where(was_bright, powered, straight) > KNEE
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


def own_light(
    colour: Float[Tensor, "*n 3"], opacity: Float[Tensor, "*n"], background: Float[Tensor, "3"]
) -> Float[Tensor, "*n 3"]:
    """The part of a rendering's colour that is the scene's own and not the background's: what a gain acts on."""
    return (colour - (1 - opacity)[..., None] * background).clamp(min=0)


def fit_log_gain(shown: Float[Tensor, "n 3"], truth: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """The log gains that make ``shown`` (a rendering, sRGB) like ``truth`` (a photo of it, sRGB).

    Per channel, g minimises the sum of w (min(s(exp(g) s⁻¹(shown)), 1) - truth)², the error in sRGB that pictures are
    judged by, with Gauss-Newton from the median of the logarithmic ratios. Weights w (Yohai 1987): Huber's first,
    under which all pixels agree on one gain and on how far they spread about it; then Tukey's at that spread, which
    leave out what differs for other reasons. Saturated pixels ask for no more than being saturated. 0 where nothing
    tells a gain: without pixels, or where the rendering is black.
    """
    count = len(shown)
    chosen = torch.linspace(0, count - 1, min(count, MOST_PIXELS), dtype=torch.float64).round().long()
    pair = (picture[chosen.to(picture.device)].double() for picture in (shown, truth))
    channels = zip(*(picture.clamp(min=0).unbind(-1) for picture in pair), strict=True)
    return torch.stack([_fit_channel(*channel) for channel in channels]).to(shown.dtype)


def _fit_channel(shown: Float[Tensor, "n"], truth: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    log_gain, spread = _first_guess(shown, truth), shown.new_tensor(FINEST)
    for iteration in range(2 * ITERATIONS):
        done = _branches(shown, log_gain)
        exposed = _shown(done)
        telling = (exposed < 1) & (_slope(done, exposed) > FINEST)  # the others' error does not change with the gain
        if not telling.any():
            break
        slope, residual = _slope(done, exposed)[telling], (exposed - truth.clamp(max=1))[telling]
        if iteration < ITERATIONS:
            spread = (OF_GAUSSIAN * residual.abs().median()).clamp(min=FINEST)
            weight = HUBER * spread / residual.abs().clamp(min=HUBER * spread)
        else:
            weight = (1 - (residual / (TUKEY * spread)) ** 2).clamp(min=0) ** 2
        pull, curvature = (weight * slope * residual).sum(), (weight * slope**2).sum()
        if curvature <= 0:
            break
        log_gain = (log_gain - (pull / curvature).clamp(-1, 1)).clamp(-LARGEST, LARGEST)
    return log_gain


def _first_guess(shown: Float[Tensor, "n"], truth: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """The median logarithmic ratio of pixels that are neither black nor saturated; of those that are, if there are no
    others."""
    seen = shown > DARKEST
    within = seen & (truth > DARKEST) & (truth < LIGHTEST)
    told = within if within.any() else seen
    if not told.any():
        return shown.new_zeros(())
    light = srgb_to_linear(truth[told].clamp(FINEST / 2, 1))
    return (light.log() - srgb_to_linear(shown[told]).log()).median().clamp(-LARGEST, LARGEST)


class ExposedModel:
    """A RadianceModel that shows another one at a fixed gain. Its colours may exceed 1."""

    def __init__(self, model: RadianceModel, log_gain: Float[Tensor, "3"]) -> None:
        self.model, self.log_gain = model, log_gain
        self.chunk_rays = model.chunk_rays

    def density(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """The other model's."""
        return self.model.density(points)

    def density_and_colour(
        self, points: Float[Tensor, "*points 3"], directions: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points"], Float[Tensor, "*points 3"]]:
        """The other model's density, and its colour, exposed."""
        density, colour = self.model.density_and_colour(points, directions)
        return density, expose(colour, self.log_gain)

    def render(self, rays: Rays, background: Float[Tensor, "3"]) -> Rendering:
        """The other model's rendering, exposed; the background is shown as it is."""
        seen = self.model.render(rays, background)
        light = own_light(seen.colour, seen.opacity, background)
        # Not expose(light) + the rest: a gain of 1 is to change no bit.
        return seen._replace(colour=seen.colour + (expose(light, self.log_gain) - light))
