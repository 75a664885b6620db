"""What a field must beat: the mean of the training photos, and the training photo taken from nearest by."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from nerf.geometry.scene import View


class MeanPhoto(NamedTuple):
    """The mean of the training photos. ``image`` (H, W, 3) is None where their sizes differ; ``colour`` is (3,)."""

    image: "Tensor | None"
    colour: "Tensor"

    def shown_at(self, height: int, width: int) -> "Tensor":
        """The prediction for a photo of this size: the mean image if it is of the same size, else the mean colour."""
        if self.image is not None and self.image.shape[:2] == (height, width):
            return self.image
        return self.colour.expand(height, width, 3)


def mean_photo(photos: "Iterable[Tensor]", used: "Iterable[Tensor | None]") -> MeanPhoto:
    """Average (H, W, 3) photos, each of equal weight whatever its size. Raises ValueError for no photos.

    ``used`` says of each photo which pixels count, (H, W) bool, None all of them. Where no photo has a pixel that
    counts, the mean image has the mean colour; that is of all pixels where none counts anywhere.
    """
    import torch

    total, weight = torch.zeros(()), torch.zeros(())
    colours, of_all = torch.zeros(2, 3, dtype=torch.float64)
    sizes, seen, counted = set(), 0, 0
    for photo, mask in zip(photos, used, strict=True):
        sizes.add(photo.shape)
        exact, seen = photo.double(), seen + 1
        colour = exact.mean((0, 1))
        of_all += colour
        if mask is not None and not mask.any():
            continue
        colours += colour if mask is None else exact[mask].mean(0)
        if len(sizes) == 1:
            total = total + (exact if mask is None else exact * mask[..., None])
            weight = weight + (1 if mask is None else mask[..., None])
        counted += 1
    if not seen:
        raise ValueError("the mean of no photos")
    if not counted:
        return MeanPhoto(None, (of_all / seen).float())
    colour = colours / counted
    image = torch.where(weight > 0, total / weight.clamp(min=1), colour).float() if len(sizes) == 1 else None
    return MeanPhoto(image, colour.float())


def nearest_view(view: "View", candidates: "Sequence[View]") -> "View":
    """The candidate whose pose is nearest (nerf/geometry/pose_distance.py); of several, the first by name."""
    import numpy as np

    from nerf.geometry.pose_distance import pose_distances

    ordered = sorted(candidates, key=lambda candidate: candidate.name)
    poses = np.stack([candidate.scene_from_camera for candidate in ordered])
    return ordered[int(np.argmin(pose_distances(view.scene_from_camera, poses)))]


def resized(photo: "Tensor", height: int, width: int) -> "Tensor":
    """An (H, W, 3) photo stretched to another size, antialiased; the photo itself if the size is the same."""
    from torch.nn.functional import interpolate

    if photo.shape[:2] == (height, width):
        return photo
    batch = photo.permute(2, 0, 1)[None]
    return interpolate(batch, (height, width), mode="bilinear", antialias=True)[0].permute(1, 2, 0)
