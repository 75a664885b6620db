"""The hot loops of the hash-grid field: arrays in, arrays out, written more than once and tested against each other.

A backend is a module with the functions of :class:`Backend`. ``nerf.kernels.torch`` is the specification: plain
torch, any device, float32 or float64. The contract:

* Tensors are contiguous, all on one device. Values are float32 (the reference takes float64 as well), optical depths
  float64, indices int32, bits int64, empty distances uint8. Backends read their arguments without copying and neither
  keep nor change them, except those that a docstring says are changed *in place*. What a function returns belongs to
  the caller.
* Nothing is differentiated by autograd: what has a ``_backward`` takes the gradient of a scalar loss with respect to
  the results and returns, or adds to, the one with respect to the arguments. Sample distances carry no gradient.
* Samples are *packed*: those of ray r are the entries starts[r] ... starts[r + 1] - 1, front to back. A ray may have
  none.
* A function that takes a ``capacity`` returns that many entries, whatever it counts: the host, which gives the tensors
  their lengths, need not wait for a GPU to count. Entries from starts[-1] on are *padding*: zeros that belong to no ray
  and have no gradient. What finds no place is left out, and then starts[-1] is the capacity.
* Points given to the hash grid or the occupancy grid are in *unit coordinates*: [0, 1]^3 is the cube of the scene's
  space map (nerf/geometry/space_maps): [-0.9, 0.9]^3 of a bounded scene or of normalised device coordinates, or the
  contracted space [-2, 2]^3.
* No function draws random numbers; no function fails on zero rays or zero samples.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Float64, Int, Int32, Int64, UInt8
from torch import Tensor

from nerf.fields.interface import Rendering
from nerf.geometry.rays import Rays

HIDDEN = 64  # numbers in the hidden layer of the networks
ROW_ALIGNMENT = 4  # of four features: a cache line, and a whole number of vectors for Adam


class GridLayout(NamedTuple):
    """A table that holds the vertices of several grids over the unit cube: level after level, a row per vertex.

    Level l has ``resolutions[l]`` cells along each axis and owns the rows [level_offsets[l], level_offsets[l + 1]), the
    last few of which may belong to no vertex. Where these suffice for all (R + 1)³ vertices, vertex (x, y, z) has row
    level_offsets[l] + (x (R + 1) + y) (R + 1) + z (a dense level). Otherwise their number is a power of two, and
    vertices share rows by the hash (x ⊕ 2654435761 y ⊕ 805459861 z) mod rows, in unsigned 32-bit arithmetic (Müller et
    al. 2022, eq. 4).
    """

    resolutions: tuple[int, ...]
    level_offsets: tuple[int, ...]
    features: int

    @property
    def rows(self) -> int:
        """Rows of the whole table."""
        return self.level_offsets[-1]

    @property
    def width(self) -> int:
        """Features of a point: those of level 0, then those of level 1, ..."""
        return self.features * len(self.resolutions)

    def level_rows(self, level: int) -> int:
        """Rows of one level."""
        return self.level_offsets[level + 1] - self.level_offsets[level]

    def is_hashed(self, level: int) -> bool:
        """Whether vertices of a level share rows."""
        return self.level_rows(level) < (self.resolutions[level] + 1) ** 3


def grid_layout(
    num_levels: int, base_res: int, max_res: int, log2_hashmap_size: int, features_per_level: int
) -> GridLayout:
    """Levels growing geometrically from ``base_res`` to ``max_res`` cells (Müller et al. 2022, eq. 2), a single one of
    ``max_res``, none with more than 2^log2_hashmap_size rows."""
    first = base_res if num_levels > 1 else max_res
    growth = (max_res / first) ** (1 / max(1, num_levels - 1))
    resolutions = tuple(round(first * growth**level) for level in range(num_levels))
    level_offsets = [0]
    for resolution in resolutions:
        vertices = -(-((resolution + 1) ** 3) // ROW_ALIGNMENT) * ROW_ALIGNMENT
        level_offsets.append(level_offsets[-1] + min(vertices, 1 << log2_hashmap_size))
    return GridLayout(resolutions, tuple(level_offsets), features_per_level)


class RayStepping(NamedTuple):
    """Where samples stand on a ray: at distances t(s_near + k + jitter), k = 0, 1, ...

    With d the ``step_size`` and c the ``cone_angle``, a step is max(d, c t) long (Müller et al. 2022, appendix E.1):

        t(s) = d s                      for c s <= 1
        t(s) = d / c exp(c s - 1)       beyond

    and s_near = s(max(near, entry into the box)). Sample k stands for the interval from t(s_near + k) to
    t(s_near + k + 1), the last of which ends at far.

    ``contracted``: the scene is contracted; otherwise rays are cut to the box. ``occupancy_resolution``: cells of the
    occupancy grid along an axis, a multiple of 4. ``max_samples``: per ray; what lies behind them is not sampled.
    """

    step_size: float
    cone_angle: float
    contracted: bool
    occupancy_resolution: int
    max_samples: int

    @property
    def linear_until(self) -> float:
        """The distance from which steps grow."""
        return self.step_size / self.cone_angle if self.cone_angle else math.inf

    def longer(self, factor: float) -> "RayStepping":
        """Every step so many times as long."""
        return self._replace(step_size=factor * self.step_size, cone_angle=factor * self.cone_angle)


class BinaryOccupancy(NamedTuple):
    """Which cells of the occupancy grid are occupied, a bit each, and how far each brick is from the nearest occupied
    one (``nerf.kernels.torch.occupancy``)."""

    bits: Int64[Tensor, "bricks"]
    empty_distance: UInt8[Tensor, "bricks"]


class Samples(NamedTuple):
    """Packed samples: of each its ray, its distance along it, and the length of the interval it stands for."""

    starts: Int32[Tensor, "rays_and_end"]
    ray: Int32[Tensor, "samples"]
    t: Float[Tensor, "samples"]
    dt: Float[Tensor, "samples"]


class Layers(NamedTuple):
    """The weights of a network of one hidden layer (``nerf.kernels.torch.mlp``). All rows have HIDDEN numbers, which
    matrix products with few outputs need to be fast: (n, 64) x (64, 3) takes three times as long as with the smaller
    one transposed."""

    hidden: Float[Tensor, "inputs hidden"]
    out: Float[Tensor, "outputs hidden"]


class MlpGradients(NamedTuple):
    """Of a network's layers, of its inputs, and of what rays add to its hidden layer, if they do."""

    hidden: Float[Tensor, "inputs hidden"]
    out: Float[Tensor, "outputs hidden"]
    inputs: Float[Tensor, "samples inputs"]
    ray_hidden: Float[Tensor, "rays hidden"] | None


class ColourSamples(NamedTuple):
    """The samples whose colours are evaluated (``nerf.kernels.torch.colour_sampling``), packed, with their rows among
    all samples and the opacity that each stands for."""

    samples: Samples
    rows: Int32[Tensor, "kept"]
    weights: Float[Tensor, "kept"]


@runtime_checkable
class Backend(Protocol):
    """The functions of a backend module; their docstrings are in ``nerf.kernels.torch``. ``CAPTURABLE``: whether a CUDA
    graph may hold them, where they are given capacities."""

    CAPTURABLE: bool

    def march(
        self,
        occupied: BinaryOccupancy,
        stepping: RayStepping,
        rays: Rays,
        jitter: Float[Tensor, "rays"],
        capacity: int | None = None,
    ) -> Samples: ...

    def sample_points(self, rays: Rays, samples: Samples, contracted: bool) -> Float[Tensor, "samples 3"]: ...

    def sample_points_backward(
        self, rays: Rays, samples: Samples, contracted: bool, grad_points: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]: ...

    def encode(
        self, layout: GridLayout, table: Float[Tensor, "rows features"], points: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points width"]: ...

    def encode_backward_table(
        self,
        layout: GridLayout,
        levels: range,
        points: Float[Tensor, "points 3"],
        grad_features: Float[Tensor, "points width"],
        grad_table: Float[Tensor, "rows features"],
    ) -> None: ...

    def encode_backward_points(
        self,
        layout: GridLayout,
        table: Float[Tensor, "rows features"],
        points: Float[Tensor, "points 3"],
        grad_features: Float[Tensor, "points width"],
    ) -> Float[Tensor, "points 3"]: ...

    def gather_rows(
        self, values: Float[Tensor, "rows width"], rows: Int32[Tensor, "chosen"]
    ) -> Float[Tensor, "chosen width"]: ...

    def spherical_harmonics(self, directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays 16"]: ...

    def spherical_harmonics_backward(
        self, directions: Float[Tensor, "rays 3"], grad: Float[Tensor, "rays 16"]
    ) -> Float[Tensor, "rays 3"]: ...

    def mlp_forward(
        self,
        layers: Layers,
        inputs: Float[Tensor, "samples inputs"],
        ray: Int32[Tensor, "samples"] | None = None,
        ray_hidden: Float[Tensor, "rays hidden"] | None = None,
    ) -> Float[Tensor, "samples outputs"]: ...

    def mlp_backward(
        self,
        layers: Layers,
        inputs: Float[Tensor, "samples inputs"],
        grad: Float[Tensor, "samples outputs"],
        samples: Samples | None = None,
        ray_hidden: Float[Tensor, "rays hidden"] | None = None,
    ) -> MlpGradients: ...

    def finish_round(
        self,
        stepping: RayStepping,
        samples: Samples,
        sigma: Float[Tensor, "samples"],
        threshold: float,
        jitter: Float[Tensor, "rays"],
        far: Float[Tensor, "rays"],
        optical_depth: Float64[Tensor, "rays"],
        near: Float[Tensor, "rays"],
    ) -> None: ...

    def pack_rounds(self, rounds: Sequence[Samples]) -> tuple[Samples, Int32[Tensor, "samples"]]: ...

    def visible_samples(
        self,
        samples: Samples,
        sigma: Float[Tensor, "samples"],
        threshold: float,
        thinning_threshold: float,
        thinning_offset: Float[Tensor, "rays"],
        capacity: int | None = None,
    ) -> tuple[Samples, Int32[Tensor, "kept"]]: ...

    def composite(
        self,
        samples: Samples,
        sigma: Float[Tensor, "samples"],
        colour: Float[Tensor, "samples 3"],
        background: Float[Tensor, "rays 3"],
        far: Float[Tensor, "rays"],
    ) -> tuple[Rendering, Float[Tensor, "samples"]]: ...

    def composite_backward(
        self,
        samples: Samples,
        sigma: Float[Tensor, "samples"],
        colour: Float[Tensor, "samples 3"],
        background: Float[Tensor, "rays 3"],
        far: Float[Tensor, "rays"],
        grad: Rendering,
        grad_weights: Float[Tensor, "samples"],
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]: ...

    def select_colour_samples(
        self,
        samples: Samples,
        sigma: Float[Tensor, "samples"],
        opacity_step: float,
        optical_depth: Float64[Tensor, "rays"],
        accumulated: Float[Tensor, "rays"],
    ) -> ColourSamples: ...

    def accumulate_colours(
        self, selected: ColourSamples, colour: Float[Tensor, "kept 3"], rendered: Float[Tensor, "rays 4"]
    ) -> None: ...

    def distortion(
        self, samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping
    ) -> Float[Tensor, "rays"]: ...

    def distortion_backward(
        self, samples: Samples, weights: Float[Tensor, "samples"], stepping: RayStepping, grad: Float[Tensor, "rays"]
    ) -> Float[Tensor, "samples"]: ...

    def depth_loss(
        self,
        samples: Samples,
        weights: Float[Tensor, "samples"],
        opacity: Float[Tensor, "rays"],
        far: Float[Tensor, "rays"],
        distance: Float[Tensor, "rays"],
        stepping: RayStepping,
    ) -> Float[Tensor, "rays"]: ...

    def depth_loss_backward(
        self,
        samples: Samples,
        far: Float[Tensor, "rays"],
        distance: Float[Tensor, "rays"],
        stepping: RayStepping,
        grad: Float[Tensor, "rays"],
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "rays"]]: ...

    def adam(
        self,
        parameter: Float[Tensor, "*shape"],
        gradient: Float[Tensor, "*shape"],
        exp_avg: Float[Tensor, "*shape"],
        exp_avg_sq: Float[Tensor, "*shape"],
        learning_rate: float,
        step: int,
    ) -> None: ...

    def scatter_max(
        self,
        cells: int,
        optical_thickness: Float[Tensor, "cells"],
        points: Float[Tensor, "points 3"],
        values: Float[Tensor, "points"],
    ) -> None: ...

    def occupancy_bits(
        self, optical_thickness: Float[Tensor, "cells"], threshold: float
    ) -> Int64[Tensor, "bricks"]: ...

    def cell_corners(self, cells: int, numbers: Int[Tensor, "chosen"]) -> Float[Tensor, "chosen 3"]: ...
