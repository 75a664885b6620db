"""Effect ``vignetting``: lenses show less light towards the corners of their photos, each camera as its own does.

Along a ray that leaves its camera at an angle θ from the optical axis the log gain (nerf/effects/exposure.py, the same
for all channels) is that at the axis less

    p(u) = d₁ (1 - (1 - u)³) + d₂ (3 u² - 2 u³) + d₃ u³,  u = sin²(θ/2) / sin²(θ/2 of the corner),  d ≥ 0,

a cubic in Bernstein's form: 0 at the axis, d₁ + d₂ + d₃ at the corner, and rising between. So it is an even polynomial
of degree six in the sine of half the angle, as Goldman & Chen 2005 take one in the radius; u knows no camera model and
no pixels, and is finite behind the camera.

What the axis shows is told from the corners, but not from the scene: a brighter field under a lower gain shows the
same. Two choices fix that. The darkest corner's gain begins as one, for colours of a field end at 1, and a corner may
show what the middle of no photo shows without being saturated. And the mean gain over an image stays as it begins:
learning moves middle and corners against each other, which neither an exposure nor a brighter field can do.
"""

import math
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import HeldOutImages, Images
from nerf.effects.exposure import MAX_LOG_GAIN, expose, expose_backward
from nerf.geometry.rays import Rays

LEARNING_RATE = 2e-3  # of the logarithm of a gain, as of exposures
TERMS = 3
UNKNOWN_CORNER = math.log(2)  # log gain by which corners may be darker where nothing was measured
# Means of the terms of p over an image of 4 : 3, where u is the squared radius. They need not be exact.
MEAN_TERMS = (0.613, 0.297, 0.090)


class VignettingModel:
    """A :class:`nerf.effects.ColourEffect`. ``falloff``: d₁, d₂, d₃, a row per camera; ``mean_log_gain``: over an image
    of each camera. ``images`` say which camera took each of them, along which axis."""

    name: ClassVar = "vignetting"
    learning_rate: ClassVar = LEARNING_RATE
    row_length: ClassVar = 1 + TERMS
    held_out_words: ClassVar = "as dark at the corners as its camera makes it"

    def __init__(
        self, images: Images, falloff: Float[Tensor, "cameras 3"], mean_log_gain: Float[Tensor, "cameras 1"]
    ) -> None:
        self.falloff, self.mean_log_gain = falloff.clone(), mean_log_gain
        self.camera, self.axis = images.camera, images.scene_from_camera[:, :, 2].contiguous()
        corner = images.corner[:, None]
        self.per_corner = torch.where(corner > 0, corner, math.inf).reciprocal()  # a single pixel on the axis: u is 0
        self.mean_terms = falloff.new_tensor(MEAN_TERMS)

    @classmethod
    def initial(cls, images: Images, measured: Float[Tensor, "views 3"] | None) -> "VignettingModel":
        """From the coefficients of each image's camera; None: without any."""
        rows = images.corner.new_zeros(len(images.camera), TERMS) if measured is None else measured
        darkest = UNKNOWN_CORNER if measured is None else float(rows.sum(1).max())
        return cls.restored(images, torch.cat([torch.full_like(rows[:, :1], darkest), rows], dim=1))

    @classmethod
    def restored(cls, images: Images, rows: Float[Tensor, "views 4"]) -> "VignettingModel":
        """From the log gain at the axis and the coefficients. Images of one camera have the same row."""
        of_camera = rows.new_zeros(int(images.camera.max()) + 1, 1 + TERMS)
        of_camera[images.camera] = rows
        falloff = of_camera[:, 1:]
        return cls(images, falloff, of_camera[:, :1] - falloff @ falloff.new_tensor(MEAN_TERMS)[:, None])

    @classmethod
    def of_new_view(cls, rows: Float[Tensor, "views 4"]) -> "VignettingModel":
        """The gain at the axis everywhere: corners are as bright as the middle."""
        at_axis = rows[:, :1].median(0, keepdim=True).values
        nowhere = Images(
            rows.new_zeros(1, 3, 4), torch.zeros(1, dtype=torch.int64, device=rows.device), rows.new_zeros(1)
        )
        return cls.restored(nowhere, torch.cat([at_axis, rows.new_zeros(1, TERMS)], dim=1))

    @classmethod
    def new_view_words(cls, rows: Float[Tensor, "views 4"]) -> str:
        """By how much corners would be darker."""
        return f"without vignetting of {float(rows[:, 1:].sum(1).max()) / math.log(2):.2f} EV at the corners"

    @property
    def parameters(self) -> dict[str, Float[Tensor, "cameras 3"]]:
        """The coefficients of the cameras."""
        return {"falloff": self.falloff}

    @property
    def rows(self) -> Float[Tensor, "views 4"]:
        """The log gain at the axis and the coefficients of each image's camera."""
        at_axis = self.mean_log_gain + self.falloff @ self.mean_terms[:, None]
        return torch.cat([at_axis, self.falloff], dim=1).index_select(0, self.camera)

    def fix_gauge(self) -> None:
        """No gain rises towards the corner. The mean gain stays as it is by itself."""
        self.falloff.clamp_(0, MAX_LOG_GAIN)

    def of_held_out(self, held_out: HeldOutImages) -> "VignettingModel":
        """That of their cameras; of a camera that took no training image, what their neighbours have."""
        rows = held_out.weights.to(self.falloff) @ self.rows
        for index, camera in enumerate(held_out.images.camera.tolist()):
            of_camera = self.camera == camera
            if of_camera.any():
                rows[index] = self.rows[of_camera][0]
        return self.restored(held_out.images, rows)

    def forward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]
    ) -> Float[Tensor, "rays 3"]:
        """The colours at the gains of their angles."""
        return expose(colour, self._log_gain(self._terms(rays, view), view))

    def inverse(self, shown: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """Log gains add up to nothing."""
        return expose(shown, -self._log_gain(self._terms(rays, view), view))

    def backward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"], grad: Float[Tensor, "rays 3"]
    ) -> tuple[Float[Tensor, "rays 3"], dict[str, Tensor]]:
        """By the chain rule; a camera's coefficients move all rays of all its images."""
        terms, camera = self._terms(rays, view), self.camera.index_select(0, view)
        of_colour, of_gain = expose_backward(colour, self._log_gain(terms, view), grad)
        of_falloff = of_gain * (self.mean_terms - terms)
        return of_colour, {"falloff": torch.zeros_like(self.falloff).index_add_(0, camera, of_falloff)}

    def _terms(self, rays: Rays, view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """What p multiplies with d₁, d₂, d₃."""
        return falloff_terms(rays.directions, self.axis.index_select(0, view), self.per_corner.index_select(0, view))

    def _log_gain(self, terms: Float[Tensor, "rays 3"], view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 1"]:
        camera = self.camera.index_select(0, view)
        darker = (self.falloff.index_select(0, camera) * (self.mean_terms - terms)).sum(1, keepdim=True)
        return self.mean_log_gain.index_select(0, camera) + darker


def falloff_terms(
    directions: Float[Tensor, "rays 3"], axis: Float[Tensor, "rays 3"], per_corner: Float[Tensor, "rays 1"]
) -> Float[Tensor, "rays 3"]:
    """1 - (1 - u)³, 3 u² - 2 u³ and u³ of unit directions; ``per_corner``: 1 / (4 sin²(θ/2)) of the corner.

    4 sin²(θ/2) is the squared length of the difference of direction and axis, which does not cancel as 1 - cos θ does.
    """
    u = ((directions - axis).square().sum(1, keepdim=True) * per_corner).clamp(max=1)
    return torch.cat([u * (3 - u * (3 - u)), u**2 * (3 - 2 * u), u**3], dim=1)
