"""One optimisation step of the vanilla NeRF (Mildenhall et al. 2020)."""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import NO_EFFECTS, ImageEffects, RenderedRays
from nerf.fields.interface import Rendering
from nerf.fields.vanilla import VanillaNerf
from nerf.geometry.rays import Rays
from nerf.runtime.parallel import in_order
from nerf.runtime.profiler import WorkCounts, span
from nerf.runtime.randomness import generator
from nerf.training.colour_loss import shows_backdrop
from nerf.training.learning_rate import learning_rate
from nerf.training.pixel_sampler import PixelSampler
from nerf.training.psnr import psnr
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import RAY_GEOMETRY, NonFinite, StepResult, all_finite, composite_over

# Rays per chunk of a batch, each on its own core; elsewhere a batch is one chunk. Their gradients are added in order,
# so results do not depend on the number of cores.
CHUNK_RAYS = {"cpu": 256}

# Adam's epsilon in the published code (Keras's default): far below the root of any gradient's square that counts, it
# keeps a weight without gradient where it is, 0/1e-7 instead of 0/0.
PUBLISHED_EPSILON = 1e-7
ADAM_BYTES = 4 * 7  # of a weight: its gradient read, itself and its moments read and written


@dataclass(frozen=True)
class VanillaTrainerSettings:
    """How to train. ``background`` is what lies behind the scene: a colour, or another random one each step
    (only for photos with alpha, where it shows the field which space is empty). ``backdrop_tolerance``: of the one
    colour that photos show where nothing is, in [0, 1]; 0: they show other things (nerf/training/colour_loss.py)."""

    batch_rays: int
    seed: int
    background: tuple[float, float, float] | Literal["random"]
    initial_learning_rate: float = 5e-4
    final_learning_rate: float = 5e-5
    backdrop_tolerance: float = 0.0


class Batch(NamedTuple):
    """Rays with the colour each should see, the view each belongs to, and the background behind all of them."""

    rays: Rays
    target: Float[Tensor, "rays 3"]
    view: Int[Tensor, "rays"]
    background: Float[Tensor, "3"]

    def part(self, rows: slice) -> "Batch":
        """Some of the rays."""
        return Batch(self.rays.each(lambda part: part[rows]), self.target[rows], self.view[rows], self.background)


class _Part(NamedTuple):
    """What one chunk of a batch contributes to it."""

    loss: Float[Tensor, ""]
    fine_error: Float[Tensor, ""]
    gradients: tuple[Tensor, ...]


class VanillaTrainer:
    """Trains coarse and fine network together on |C_c - C|² + |C_f - C|² (Mildenhall et al. 2020, eq. 6) by Adam
    with the published constants; the loss is the mean over rays and channels. ``effects`` stand
    between the field and each image (nerf/effects)."""

    def __init__(
        self,
        model: VanillaNerf,
        dataset: RayDataset,
        settings: VanillaTrainerSettings,
        effects: ImageEffects = NO_EFFECTS,
    ) -> None:
        self.model = model
        self.dataset = dataset
        self.settings = settings
        self.order = PixelSampler(dataset.unmasked_count, settings.seed, dataset.device)
        self.effects = effects
        networks = [p for p in model.parameters() if p.requires_grad]
        groups = [{"params": networks, "of_start": 1.0}]
        for effect in effects.all:
            learnt = [parameter.requires_grad_() for parameter in effect.parameters.values()]
            groups.append({"params": learnt, "of_start": effect.learning_rate / settings.initial_learning_rate})
        self.parameters = [parameter for group in groups for parameter in group["params"]]
        self.optimiser = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=PUBLISHED_EPSILON, fused=True)

    def step(self, step: int, progress: float, lr_scale: float = 1.0) -> StepResult:
        """One batch, one update. Raises NonFinite before the update, leaving model and optimiser as they were."""
        with span("batch"):
            batch = self._batch(step)
        device = self.dataset.device
        starts = range(0, self.settings.batch_rays, CHUNK_RAYS.get(device.type, self.settings.batch_rays))
        parts = list(in_order(partial(self._part, batch, step), starts, device))
        gradients = [torch.stack(of).sum(0) for of in zip(*(each.gradients for each in parts), strict=True)]
        norm = torch.nn.utils.get_total_norm(gradients)
        losses, errors = torch.stack([p.loss for p in parts]).sum(), torch.stack([p.fine_error for p in parts]).sum()
        loss, error, norm_now = torch.stack([losses, errors, norm]).tolist()
        for quantity, value in {"loss": loss, "gradient": norm_now}.items():
            if not abs(value) < float("inf"):
                raise NonFinite(quantity, step, _tensors_of(batch))
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        rate = lr_scale * learning_rate(
            progress, self.settings.initial_learning_rate, self.settings.final_learning_rate
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["of_start"]
        with span("optimiser", WorkCounts(streamed_bytes=ADAM_BYTES * sum(each.numel() for each in self.parameters))):
            self.optimiser.step()
        with torch.no_grad():
            for effect in self.effects.all:
                effect.fix_gauge()
        rays, queries = self.settings.batch_rays, self.settings.batch_rays * self.model.settings.queries_per_ray
        return StepResult(loss, psnr(error), rays, colour_evaluations=queries, density_evaluations=queries)

    def _part(self, batch: Batch, step: int, start: int) -> _Part:
        """What a slice of the batch adds to loss and gradient; it draws its samples from its own random numbers."""
        size = CHUNK_RAYS.get(self.dataset.device.type, self.settings.batch_rays)
        rays, target, view, background = batch.part(slice(start, start + size))
        random = generator(self.dataset.device, self.settings.seed, step, 1 + start)
        seen_along = self.effects.forward_rays(rays, view)
        if not all_finite(seen_along):
            raise NonFinite(RAY_GEOMETRY, step, _tensors_of(batch))
        coarse, fine = self.model.render_training(seen_along, background, random)

        def squared_error(rendering: Rendering) -> Float[Tensor, ""]:
            residual = self.effects.residual(RenderedRays(rendering, background, rays, view), target)
            return residual.square().sum() / batch.target.numel()

        def opacity_cost(rendering: Rendering) -> Float[Tensor, ""] | float:
            tolerance = self.settings.backdrop_tolerance
            if tolerance == 0:
                return 0.0
            at_backdrop = rendering.opacity * shows_backdrop(target, background, tolerance)
            return tolerance**2 * at_backdrop.sum() / len(batch.target)

        with span("composite"):
            fine_error = squared_error(fine)
            loss = fine_error + opacity_cost(fine)
            if coarse is not fine:  # a field without hierarchy has one rendering and counts it once
                loss = squared_error(coarse) + opacity_cost(coarse) + loss
        with span("backward", self._backward_work(len(view))):
            return _Part(loss.detach(), fine_error.detach(), torch.autograd.grad(loss, self.parameters))

    def state(self) -> dict[str, Tensor]:
        """Weights as ``model.<name>``, per-image parameters as ``image.<effect>.<name>``, Adam's moments and step
        counts as ``adam.<parameter>.<name>``, and the field's settings, to know it by."""
        tensors = {"settings": torch.frombuffer(bytearray(repr(self.model.settings).encode()), dtype=torch.uint8)}
        tensors |= {f"model.{name}": tensor for name, tensor in self.model.state_dict().items()}
        tensors |= {f"image.{name}": tensor.detach() for name, tensor in self.effects.parameters.items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": tensor for name, tensor in moments.items()}
        return tensors

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go back to what :meth:`state` gave. Raises RuntimeError for the state of another field."""
        mine = self.state()["settings"]
        if "settings" not in state or not torch.equal(state["settings"].cpu(), mine):
            raise RuntimeError("this state belongs to another field: settings differ")
        weights: dict[str, Tensor] = {}
        moments: dict[int, dict[str, Tensor]] = {}
        for key, tensor in state.items():
            kind, _, name = key.partition(".")
            if kind == "model":
                weights[name] = tensor
            elif kind == "image":
                self.effects.parameters[name].detach().copy_(tensor)
            elif kind == "adam":
                index, name = name.split(".")
                moments.setdefault(int(index), {})[name] = tensor.clone()
        self.model.load_state_dict(weights)
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": moments, "param_groups": groups})

    def _backward_work(self, rays: int) -> WorkCounts:
        return WorkCounts(
            matmul_flops=self.model.fine.matmul_flops_backward * self.model.settings.queries_per_ray * rays
        )

    def _batch(self, step: int) -> Batch:
        random = generator(self.dataset.device, self.settings.seed, step)
        count = self.settings.batch_rays
        rays, colour, alpha, view = self.dataset.lookup(
            self.dataset.unmasked_pixels(self.order.take(step * count, count))
        )
        if self.settings.background == "random":
            background = torch.rand(3, generator=random, device=self.dataset.device)
        else:
            background = torch.tensor(self.settings.background, device=self.dataset.device)
        return Batch(rays, composite_over(colour, alpha, background), view, background)


def _tensors_of(batch: Batch) -> dict[str, Tensor]:
    return batch.rays._asdict() | {"target": batch.target, "view": batch.view, "background": batch.background}
