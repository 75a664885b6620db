"""Space maps: how a scene is laid out in the cube of half side ``half``, about the origin, that a field fills.

* :class:`Box`: the region of interest as it is. Nothing beyond it is seen.
* :class:`Contraction` (contraction.py): all of space, for cameras that look anywhere.
* :class:`Ndc` (ndc.py): all that cameras which face one way can see, to infinity: normalised device coordinates.

Box and Ndc take straight lines to straight lines. So rays are mapped once (mapped_rays.py), and what marches them by
equal steps through a cube needs to know no map. The contraction ``bends_rays``: it is applied to every sample, and
steps grow with the distance. Densities are per scene unit in all of them.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from nerf import REGION_HALF_SIZE
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.mapped_rays import MappedRays
from nerf.geometry.space_maps.ndc import Ndc


@dataclass(frozen=True)
class Box:
    """The cube [-0.9, 0.9]³ of the scene frame."""

    kind: Literal["box"] = "box"
    half: ClassVar[float] = REGION_HALF_SIZE
    bends_rays: ClassVar[bool] = False
    unbounded: ClassVar[bool] = False

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Of scene points: themselves."""
        return points

    def inverse(self, mapped: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """The scene points again."""
        return mapped

    def map_rays(self, rays: Rays) -> MappedRays:
        """Rays as they are marched."""
        return MappedRays(rays)


SpaceMap = Box | Contraction | Ndc


def space_map(kind: str, **parameters: Any) -> SpaceMap:
    """A map by its kind and parameters, as ``dataclasses.asdict`` gives them, or JSON, which has lists for tuples.
    Raises ValueError for an unknown kind."""
    maps = {"box": Box, "contraction": Contraction, "ndc": Ndc}
    if kind not in maps:
        raise ValueError(f"the space map is {kind!r}; it must be one of {', '.join(maps)}")
    return maps[kind](**{name: _tuples(value) for name, value in parameters.items()})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
