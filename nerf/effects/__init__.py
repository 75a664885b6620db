"""What stands between a radiance field and an image of it: optional effects, switched by stage effects.

An image has a tuple of ray effects (its camera model: where its rays run) and a tuple of colour effects (its appearance
model: what it shows of the scene), applied in order. :class:`ImageEffects` holds both and composes them; without any it
is the identity, which computes nothing and changes no bit.

Parameters have a row per image of the ray dataset, or per camera, and are updated in place by the trainer. ``forward``
is plain torch, which autograd may differentiate (the vanilla NeRF's trainer does so); the backward methods are its
derivative by hand (the hash-grid trainer has no autograd) and give dense gradients of the parameters by name.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf import MIN_SATURATED
from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays


class RayGradients(NamedTuple):
    """Gradients of a loss by rays' origins and directions."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]


class Images(NamedTuple):
    """What effects may know of images: their calibrated poses, the number of the ``camera`` that took each of them, how
    far its ``corner`` is from the optical axis (4 sin²(θ/2) of the largest angle θ), and how far away (scene units) is
    what each of them shows; None: nobody knows."""

    scene_from_camera: Float[Tensor, "views 3 4"]
    camera: Int[Tensor, "views"]
    corner: Float[Tensor, "views"]
    viewing_distance: Float[Tensor, "views"] | None = None


class HeldOutImages(NamedTuple):
    """Images that took no part in training, and how much each training image tells of each of them
    (nerf/geometry/pose_distance.py)."""

    images: Images
    weights: Float[Tensor, "held_out views"]


class RenderedRays(NamedTuple):
    """What a field shows along calibrated ``rays`` of the images ``view``, over ``background``."""

    rendering: Rendering
    background: Float[Tensor, "*#rays 3"]
    rays: Rays
    view: Int[Tensor, "rays"]


@runtime_checkable
class RayEffect(Protocol):
    """Where the rays of each image run. ``name`` and ``learning_rate`` as of a :class:`ColourEffect`."""

    name: ClassVar[str]
    learning_rate: ClassVar[float]

    @property
    def parameters(self) -> dict[str, Float[Tensor, "_ _"]]:
        """What is learnt with the field: a row per image or per camera."""
        ...

    @property
    def rows(self) -> Float[Tensor, "views _"]:
        """What was learnt of each image, in the units of files."""
        ...

    @staticmethod
    def moved_poses(
        scene_from_camera: Float[Tensor, "views 3 4"], rows: Float[Tensor, "views _"]
    ) -> Float[Tensor, "views 3 4"]:
        """The poses that have, without this effect, the rays that images with these ``rows`` have with it."""
        ...

    @classmethod
    def initial(cls, images: Images, measured: Float[Tensor, "views _"] | None) -> "RayEffect":
        """What training begins with; ``measured``: what statistics say of each image, if they do."""
        ...

    def fix_gauge(self) -> None:
        """After an update: take out what the field could take up itself."""
        ...

    def forward(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """The rays along which to render."""
        ...

    def backward(self, rays: Rays, view: Int[Tensor, "rays"], grad: RayGradients) -> dict[str, Tensor]:
        """Gradients of the parameters; ``rays`` as forward was given them, ``grad`` by those that it gave."""
        ...

    def backward_rays(self, rays: Rays, view: Int[Tensor, "rays"], grad: RayGradients) -> RayGradients:
        """Gradients of the rays that forward was given; asked for only where another effect stands before."""
        ...


@runtime_checkable
class ColourEffect(Protocol):
    """What each image makes of the scene's radiance along its rays.

    ``name``: what the effect is called everywhere (stages/effects/effect_list.py); ``learning_rate``: Adam's for its
    parameters, before the field's warm-up and decay; ``row_length``: how many numbers files have of an image;
    ``held_out_words``: how images that took no part in training are shown."""

    name: ClassVar[str]
    learning_rate: ClassVar[float]
    row_length: ClassVar[int]
    held_out_words: ClassVar[str]

    @property
    def parameters(self) -> dict[str, Float[Tensor, "_ _"]]:
        """What is learnt with the field: a row per image or per camera."""
        ...

    @property
    def rows(self) -> Float[Tensor, "views _"]:
        """What was learnt of each image, in the units of files."""
        ...

    @classmethod
    def initial(cls, images: Images, measured: Float[Tensor, "views _"] | None) -> "ColourEffect":
        """What training begins with; ``measured``: what statistics say of each image, if they do."""
        ...

    @classmethod
    def restored(cls, images: Images, rows: Float[Tensor, "views _"]) -> "ColourEffect":
        """From what was learnt of ``images``."""
        ...

    @classmethod
    def of_new_view(cls, rows: Float[Tensor, "views _"]) -> "ColourEffect | None":
        """What a view shows that no camera took, by ``rows`` of one image that it is to be like, or of all. None: it
        shows the scene without the effect."""
        ...

    @classmethod
    def new_view_words(cls, rows: Float[Tensor, "views _"]) -> str:
        """What that is, by the rows of all images."""
        ...

    def fix_gauge(self) -> None:
        """After an update: take out what the field could take up itself."""
        ...

    def of_held_out(self, held_out: HeldOutImages) -> "ColourEffect":
        """Of images that took no part: what they are expected to show."""
        ...

    def forward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]
    ) -> Float[Tensor, "rays 3"]:
        """What the images show of ``colour`` (sRGB, may exceed 1), which the calibrated ``rays`` meet."""
        ...

    def inverse(self, shown: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """The colours of which the images show ``shown``."""
        ...

    def backward(
        self, colour: Float[Tensor, "rays 3"], rays: Rays, view: Int[Tensor, "rays"], grad: Float[Tensor, "rays 3"]
    ) -> tuple[Float[Tensor, "rays 3"], dict[str, Tensor]]:
        """Gradients of the colours and of the parameters, given that of what forward gave."""
        ...


Effect = RayEffect | ColourEffect


class ImageEffects(NamedTuple):
    """The effects that are on, in the order in which they are applied. Effects act on the scene's own radiance, not on
    a background that images with alpha are laid over."""

    rays: tuple[RayEffect, ...] = ()
    colours: tuple[ColourEffect, ...] = ()

    @property
    def all(self) -> tuple[Effect, ...]:
        """Those of rays, then those of colours."""
        return (*self.rays, *self.colours)

    @property
    def parameters(self) -> dict[str, Float[Tensor, "_ _"]]:
        """By effect and name, like ``exposure.log_gain``."""
        return {name: each for effect in self.all for name, each in parameters_of(effect).items()}

    def forward_rays(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """The rays along which to render, given those of the calibrated cameras."""
        for effect in self.rays:
            rays = effect.forward(rays, view)
        return rays

    def backward_rays(
        self, rays: Rays, view: Int[Tensor, "rays"], grad: Callable[[], RayGradients]
    ) -> dict[str, Tensor]:
        """Gradients of the ray effects' parameters. ``grad`` computes those of the rays that are rendered, which is
        costly: called only where they are wanted."""
        if not self.rays:
            return {}
        given = [rays]
        for effect in self.rays[:-1]:
            given.append(effect.forward(given[-1], view))
        of_rays, gradients = grad(), dict[str, Tensor]()
        for index in range(len(self.rays) - 1, -1, -1):
            effect = self.rays[index]
            gradients |= _named(effect, effect.backward(given[index], view, of_rays))
            if index:
                of_rays = effect.backward_rays(given[index], view, of_rays)
        return gradients

    def residual(self, seen: RenderedRays, target: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 3"]:
        """By how much the images would show more than their ``target`` colours; their squares are the loss.

        E(C - (1 - o) b) + (1 - o) b less the target, of opacity o, background b and all colour effects E; 0 where the
        image is MIN_SATURATED and would be: an image ends at 1, and does not tell by how much it was exceeded."""
        if not self.colours:
            return seen.rendering.colour - target
        behind = (1 - seen.rendering.opacity)[:, None] * seen.background
        shown = self._stages(seen, self.colours)[-1] + behind
        return torch.where((shown > 1) & (target >= MIN_SATURATED / 255), 0.0, shown - target)

    def backward_residual(
        self, seen: RenderedRays, grad: Float[Tensor, "rays 3"]
    ) -> tuple[Rendering, dict[str, Tensor]]:
        """Gradients of the rendering and of the colour effects' parameters, given that of the residual, which is 0
        where that was cut to 0."""
        none = torch.zeros(len(grad), dtype=grad.dtype, device=grad.device)
        if not self.colours:
            return Rendering(grad, none, none), {}
        of_colour, gradients = grad, dict[str, Tensor]()
        stages = self._stages(seen, self.colours[:-1])
        for effect, colour in zip(reversed(self.colours), reversed(stages), strict=True):
            of_colour, learnt = effect.backward(colour, seen.rays, seen.view, of_colour)
            gradients |= _named(effect, learnt)
        opacity = ((of_colour - grad) * seen.background).sum(-1)  # it moves both terms
        return Rendering(of_colour, none, opacity), gradients

    def of_held_out(self, held_out: HeldOutImages) -> "ImageEffects":
        """What images that took no part are expected to show; their poses count as calibrated."""
        return ImageEffects(colours=tuple(effect.of_held_out(held_out) for effect in self.colours))

    @staticmethod
    def _stages(seen: RenderedRays, effects: tuple[ColourEffect, ...]) -> list[Float[Tensor, "rays 3"]]:
        """The scene's own radiance, and what each of ``effects`` in turn makes of it."""
        rendering = seen.rendering
        stages = [rendering.colour - (1 - rendering.opacity)[:, None] * seen.background]
        for effect in effects:
            stages.append(effect.forward(stages[-1], seen.rays, seen.view))
        return stages


NO_EFFECTS = ImageEffects()


def parameters_of(effect: Effect) -> dict[str, Float[Tensor, "_ _"]]:
    """An effect's parameters by the names that they have among all."""
    return _named(effect, effect.parameters)


def _named(effect: Effect, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{effect.name}.{name}": tensor for name, tensor in tensors.items()}


def foreground_radiance(
    colour: Float[Tensor, "*n 3"], opacity: Float[Tensor, "*n"], background: Float[Tensor, "3"]
) -> Float[Tensor, "*n 3"]:
    """The part of a rendering's colour that is the scene's own and not the background's: what colour effects act on."""
    return (colour - (1 - opacity)[..., None] * background).clamp(min=0)
