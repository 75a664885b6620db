"""Effect ``pose_refinement``: a small rigid correction of every photo's camera, learnt with the field.

o' = o + t and d' = exp([w]) d: a rotation vector w (radians) about the camera's own centre and a shift t (scene units),
in the scene's axes (Lin et al. 2021, BARF; SO(3) × R³ keeps the two apart where BARF's se(3) mixes them). On: 6 numbers
per photo, and the gradient of every sample's place. What all cameras share is left to the field: it may turn, shift
and grow as a whole, which no photo can tell.

A shift is learnt as the *offset* t / u, with a unit u of the distance of what the photo shows: Adam's steps have one
size whatever the gradient, and where things are 0.04 units away, as in a street's or a drone's photos, a step of shift
would move the picture 25 times as far as a step of turn, and shake what turns have settled.
"""

from operator import itemgetter
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import NO_EFFECTS, ImageEffects, Images, RayGradients, RenderedRays
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.rays import Rays
from nerf.geometry.rotations import rotation_from_vector
from nerf.runtime.randomness import generator

MIN_SINGULAR_VALUE = 1e-9  # of the largest: smaller ones come from rounding, of cameras that coincide
LEARNING_RATE = 1e-3  # radians and units of shift; 5 pixels of a phone's photo at a quarter of its size are about 1e-2
MAX_UNIT = 1.0  # scene units

FIT_STEPS = 40
FIT_RAYS = 256  # in a step
FIT_LEARNING_RATE = 3e-3  # radians and units of shift at first, falling exponentially to
FIT_FINAL_RATE = 0.1  # of it


class PoseRefinement:
    """A :class:`nerf.effects.RayEffect` that begins at the calibrated poses, whose cameras stand at ``centres`` and see
    what is at a ``distance`` (scene units; None: nobody knows, and units are the largest)."""

    name: ClassVar = "pose_refinement"
    learning_rate: ClassVar = LEARNING_RATE

    def __init__(self, centres: Float[Tensor, "views 3"], distance: Float[Tensor, "views"] | None = None) -> None:
        self.turn, self.offset = torch.zeros_like(centres), torch.zeros_like(centres)
        largest = centres.new_full((len(centres), 1), MAX_UNIT)
        self.unit = largest if distance is None else distance[:, None].minimum(largest)
        self.gauge = _gauge(centres, self.unit)

    @classmethod
    def initial(cls, images: Images, measured: Tensor | None = None) -> "PoseRefinement":
        """No correction: nothing is measured."""
        return cls(images.scene_from_camera[:, :, 3].contiguous(), images.viewing_distance)

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views 3"]]:
        """Rotation vectors in radians and shifts in units of each photo's own."""
        return {"turn": self.turn, "offset": self.offset}

    @property
    def shift(self) -> Float[Tensor, "views 3"]:
        """Shifts in scene units."""
        return self.unit * self.offset

    @property
    def rows(self) -> Float[Tensor, "views 6"]:
        """Rotation vectors in radians and shifts in scene units."""
        return torch.cat([self.turn, self.shift], dim=1)

    @staticmethod
    def moved_poses(
        scene_from_camera: Float[Tensor, "views 3 4"], rows: Float[Tensor, "views 6"]
    ) -> Float[Tensor, "views 3 4"]:
        """[exp([w]) R | c + t] of poses [R | c]."""
        turned = rotation_from_vector(rows[:, :3]) @ scene_from_camera[:, :, :3]
        return torch.cat([turned, (scene_from_camera[:, :, 3] + rows[:, 3:])[:, :, None]], dim=2)

    def fix_gauge(self) -> None:
        """Take out what moves all cameras like one body, or scales their places (to first order)."""
        motion = torch.cat([self.turn, self.offset]).double().flatten()
        shared = (self.gauge @ (self.gauge.T @ motion)).to(self.turn.dtype).view(2, -1, 3)
        self.turn -= shared[0]
        self.offset -= shared[1]

    def forward(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """Turn and shift rays with their cameras."""
        turned = (rotation_from_vector(self.turn).index_select(0, view) @ rays.directions[:, :, None])[:, :, 0]
        return rays._replace(origins=rays.origins + self.shift.index_select(0, view), directions=turned)

    def backward(self, rays: Rays, view: Int[Tensor, "rays"], grad: RayGradients) -> dict[str, Tensor]:
        """dL/dt = sum of dL/do', dL/dR = sum of dL/dd' dᵀ over the photo's rays; R to w by autograd, once per photo."""
        views = len(self.turn)
        shift = torch.zeros_like(self.shift).index_add_(0, view, grad.origins)
        outer = grad.directions[:, :, None] * rays.directions[:, None, :]
        of_rotation = outer.new_zeros(views, 3, 3).index_add_(0, view, outer)
        with torch.enable_grad():
            turn = self.turn.detach().requires_grad_()
            (of_turn,) = torch.autograd.grad(rotation_from_vector(turn), turn, of_rotation)
        return {"turn": of_turn, "offset": self.unit * shift}

    def backward_rays(self, rays: Rays, view: Int[Tensor, "rays"], grad: RayGradients) -> RayGradients:
        """dL/do = dL/do', dL/dd = Rᵀ dL/dd'."""
        back = rotation_from_vector(self.turn).mT.index_select(0, view)
        return RayGradients(grad.origins, (back @ grad.directions[:, :, None])[:, :, 0])


def _gauge(centres: Float[Tensor, "views 3"], unit: Float[Tensor, "views 1"]) -> Float[Tensor, "numbers gauge"]:
    """An orthonormal basis of the motions of all cameras that a field can take up itself: shift, turn w with shift
    w × o, scale with shift s o, of centres o about their mean; as turns and offsets. At most seven; fewer where cameras
    coincide."""
    places = (centres - centres.mean(0)).double()
    axes = torch.eye(3, dtype=torch.float64, device=centres.device)
    still = torch.zeros_like(places)
    motions = [torch.cat([still, axis / unit]) for axis in axes]
    motions += [
        torch.cat([axis.expand_as(places), torch.linalg.cross(axis.expand_as(places), places) / unit]) for axis in axes
    ]
    motions.append(torch.cat([still, places / unit]))
    basis, size, _ = torch.linalg.svd(torch.stack([motion.flatten() for motion in motions], 1), full_matrices=False)
    return basis[:, size > MIN_SINGULAR_VALUE * size[0]]


def fit_pose(
    model: HashGridField,
    rays: Rays,
    target: Float[Tensor, "pixels 3"],
    background: Float[Tensor, "3"],
    effects: ImageEffects = NO_EFFECTS,
    seed: int = 0,
    distance: float = MAX_UNIT,
) -> PoseRefinement:
    """The correction of a held-out photo's pose that makes a finished field look most like it, by Adam on the squared
    error.

    ``rays`` and ``target`` are pixels of that photo (those by which the pose may be judged), ``effects`` its colour
    effects; they and the field stay as they are. ``distance`` (scene units) is that of what the photo shows. The
    correction and ``effects`` know a single view, 0.
    """
    here = torch.zeros(1, 3, device=target.device)
    pose, random = PoseRefinement(here, here.new_tensor([distance])), generator(target.device, seed)
    exp_avg, exp_avg_sq = ({name: torch.zeros_like(part) for name, part in pose.parameters.items()} for _ in range(2))
    for step in range(FIT_STEPS):
        pixel = torch.randint(len(target), (min(FIT_RAYS, len(target)),), generator=random, device=target.device)
        places = torch.rand(2, len(pixel), generator=random, device=target.device)
        some = rays.each(itemgetter(pixel))
        gradients = _pose_gradients(model, pose, effects, (some, target[pixel], background), places)
        rate = FIT_LEARNING_RATE * FIT_FINAL_RATE ** (step / (FIT_STEPS - 1))
        for name, gradient in gradients.items():
            model.backend.adam(pose.parameters[name], gradient, exp_avg[name], exp_avg_sq[name], rate, step + 1)
    return pose


def _pose_gradients(
    model: HashGridField,
    pose: PoseRefinement,
    effects: ImageEffects,
    pixels: tuple[Rays, Float[Tensor, "pixels 3"], Float[Tensor, "3"]],
    places: Float[Tensor, "2 pixels"],
) -> dict[str, Tensor]:
    """Of the mean squared error on ``pixels`` (rays, colours, the background behind them), by the pose. ``places``:
    where samples stand in their intervals, and which thin ones are kept."""
    rays, target, background = pixels
    view = torch.zeros(len(target), dtype=torch.int64, device=target.device)
    jitter, offset = places
    done = model.forward(pose.forward(rays, view), jitter, offset, background.expand_as(target).contiguous())
    seen = RenderedRays(done.rendering, background, rays, view)
    residual = effects.residual(seen, target)
    grad, _ = effects.backward_residual(seen, residual * (2 / residual.numel()))
    gradients = model.backward(done, grad, torch.zeros_like(done.weights))
    return pose.backward(rays, view, RayGradients(*model.rays_backward(done, gradients)))
