"""Effect ``pose_refinement``: a small rigid correction of every photo's camera, learnt with the field.

o' = o + t and d' = exp([w]) d: a rotation vector w (radians) about the camera's own centre and a shift t (scene units),
in the scene's axes (Lin et al. 2021, BARF; SO(3) × R³ keeps the two apart where BARF's se(3) mixes them). On: 6 numbers
per photo, and the gradient of every sample's place. What all cameras share is left to the field: it may turn, shift
and grow as a whole, which no photo can tell.

A shift is learnt as the *offset* t / u, with a unit u of the distance of what the photo shows: Adam's steps have one
size whatever the gradient, and where things are 0.04 units away, as in a street's or a drone's photos, a step of shift
would move the picture 25 times as far as a step of turn, and shake what turns have settled.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import GradRays
from nerf.geometry.rays import Rays
from nerf.geometry.rotations import rotation_from_vector

SAME_PLACE = 1e-9  # singular values below this share of the largest come from rounding: cameras that coincide
RATE = 1e-3  # radians and units of shift; 5 pixels of a phone's photo at a quarter of its size are about 1e-2
LARGEST_UNIT = 1.0  # scene units


class RefinedPoses:
    """A :class:`nerf.effects.PhotoRays` that begins at the calibrated poses, whose cameras stand at ``centres`` and see
    what is at a ``distance`` (scene units; None: nobody knows, and units are the largest)."""

    rate = RATE

    def __init__(self, centres: Float[Tensor, "views 3"], distance: Float[Tensor, "views"] | None = None) -> None:
        self.turn, self.offset = torch.zeros_like(centres), torch.zeros_like(centres)
        largest = centres.new_full((len(centres), 1), LARGEST_UNIT)
        self.unit = largest if distance is None else distance[:, None].minimum(largest)
        self.gauge = _gauge(centres, self.unit)

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views 3"]]:
        """Rotation vectors in radians and shifts in units of each photo's own."""
        return {"turn": self.turn, "offset": self.offset}

    @property
    def shift(self) -> Float[Tensor, "views 3"]:
        """Shifts in scene units."""
        return self.unit * self.offset

    def settle(self) -> None:
        """Take out what moves all cameras like one body, or scales their places (to first order)."""
        motion = torch.cat([self.turn, self.offset]).double().flatten()
        shared = (self.gauge @ (self.gauge.T @ motion)).to(self.turn.dtype).view(2, -1, 3)
        self.turn -= shared[0]
        self.offset -= shared[1]

    def forward(self, rays: Rays, view: Int[Tensor, "rays"]) -> Rays:
        """Turn and shift rays with their cameras."""
        turned = (rotation_from_vector(self.turn).index_select(0, view) @ rays.directions[:, :, None])[:, :, 0]
        return rays._replace(origins=rays.origins + self.shift.index_select(0, view), directions=turned)

    def backward(self, rays: Rays, view: Int[Tensor, "rays"], grad: GradRays) -> dict[str, Tensor]:
        """dL/dt = sum of dL/do', dL/dR = sum of dL/dd' dᵀ over the photo's rays; R to w by autograd, once per photo."""
        grad_origins, grad_directions = grad()
        views = len(self.turn)
        shift = torch.zeros_like(self.shift).index_add_(0, view, grad_origins)
        outer = grad_directions[:, :, None] * rays.directions[:, None, :]
        of_rotation = outer.new_zeros(views, 3, 3).index_add_(0, view, outer)
        with torch.enable_grad():
            turn = self.turn.detach().requires_grad_()
            (of_turn,) = torch.autograd.grad(rotation_from_vector(turn), turn, of_rotation)
        return {"turn": of_turn, "offset": self.unit * shift}


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
    return basis[:, size > SAME_PLACE * size[0]]
