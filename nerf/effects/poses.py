"""Effect ``pose_refinement``: a small rigid correction of every photo's camera, learnt with the field.

o' = o + t and d' = exp([w]) d: a rotation vector w (radians) about the camera's own centre and a shift t (scene units),
in the scene's axes (Lin et al. 2021, BARF; SO(3) × R³ keeps the two apart where BARF's se(3) mixes them). On: 6 numbers
per photo, and the gradient of every sample's place. What all cameras share is left to the field: it may turn and shift
as a whole, which no photo can tell.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf.effects import GradRays
from nerf.effects.rotations import rotation_from_vector
from nerf.rays import Rays

RATE = 1e-3  # radians and scene units; 5 pixels of a phone's photo at a quarter of its size are about 1e-2


class RefinedPoses:
    """A :class:`nerf.effects.PhotoRays` that begins at the calibrated poses."""

    rate = RATE

    def __init__(self, views: int, device: torch.device | str = "cpu") -> None:
        self.turn = torch.zeros(views, 3, device=device)
        self.shift = torch.zeros(views, 3, device=device)

    @property
    def parameters(self) -> dict[str, Float[Tensor, "views 3"]]:
        """Rotation vectors in radians and shifts in scene units."""
        return {"turn": self.turn, "shift": self.shift}

    def settle(self) -> None:
        """Take out the mean turn and shift."""
        for each in (self.turn, self.shift):
            each -= each.mean(0)

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
        return {"turn": of_turn, "shift": shift}
