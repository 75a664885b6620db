"""Solids with exact geometry: ray intersection, signed distance, normal and area-uniform sampling.

Everything happens in a shape's own frame, its centre near the origin. A shape answers a ray with the first point
where the ray *enters* it, so a ray that starts inside or leaves the surface sees nothing of that shape, and every
normal found by tracing faces the ray's origin.
"""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

Points = Float[Tensor, "*points 3"]
Values = Float[Tensor, "*points"]


@runtime_checkable
class Shape(Protocol):
    """A closed solid; lengths are in scene units."""

    @property
    def reach(self) -> float:
        """Radius of a sphere around the origin that holds the shape."""
        ...

    @property
    def area(self) -> float:
        """Area of the surface."""
        ...

    def intersect(self, origins: Points, directions: Points) -> Values:
        """Distance along the unit ``directions`` to the first entry at t > 0, infinity where there is none."""
        ...

    def distance(self, points: Points) -> Values:
        """Signed distance to the surface, negative inside."""
        ...

    def normal(self, points: Points) -> Points:
        """Outward unit normal at points on the surface."""
        ...

    def sample(self, uniform: Points) -> Points:
        """Points on the surface, area-uniform for ``uniform`` in [0, 1)^3."""
        ...


class Sphere(NamedTuple):
    """A ball of ``radius``."""

    radius: float

    @property
    def reach(self) -> float:
        return self.radius

    @property
    def area(self) -> float:
        return 4 * math.pi * self.radius**2

    def intersect(self, origins: Points, directions: Points) -> Values:
        middle = -dot(origins, directions)
        # The foot of the perpendicular and not |origin|^2 - radius^2, which cancels far from the sphere.
        foot = origins + middle[..., None] * directions
        t = middle - (self.radius**2 - dot(foot, foot)).sqrt()  # NaN where the ray passes by
        return torch.where(t > 0, t, torch.inf)

    def distance(self, points: Points) -> Values:
        return dot(points, points).sqrt() - self.radius

    def normal(self, points: Points) -> Points:
        return torch.nn.functional.normalize(points, dim=-1)

    def sample(self, uniform: Points) -> Points:
        return self.radius * _on_unit_sphere(uniform[..., 0], uniform[..., 1])


class Box(NamedTuple):
    """A box with half sides ``half``."""

    half: tuple[float, float, float]

    @property
    def reach(self) -> float:
        return math.hypot(*self.half)

    @property
    def area(self) -> float:
        return 8 * sum(self._face_weights())

    def _face_weights(self) -> tuple[float, float, float]:
        x, y, z = self.half
        return y * z, z * x, x * y

    def intersect(self, origins: Points, directions: Points) -> Values:
        enter, leave = _slabs(origins, directions, self.half)
        return torch.where((enter > 0) & (enter < leave), enter, torch.inf)

    def distance(self, points: Points) -> Values:
        beyond = points.abs() - points.new_tensor(self.half)
        return dot(beyond.clamp(min=0), beyond.clamp(min=0)).sqrt() + beyond.amax(-1).clamp(max=0)

    def normal(self, points: Points) -> Points:
        nearest_face = (points.abs() - points.new_tensor(self.half)).argmax(-1, keepdim=True)
        axis = torch.zeros_like(points).scatter_(-1, nearest_face, 1.0)
        return axis * points.sign()

    def sample(self, uniform: Points) -> Points:
        weights = uniform.new_tensor(self._face_weights())
        edges = (weights.cumsum(0) / weights.sum()).contiguous()
        axis, along = _pick(edges, uniform[..., 0])
        spread = torch.stack([along * 4 % 2 - 1, uniform[..., 1] * 2 - 1, uniform[..., 2] * 2 - 1], dim=-1)
        side = torch.where(along < 0.5, -1.0, 1.0)[..., None]
        on_face = torch.arange(3, device=uniform.device) == axis[..., None]
        return torch.where(on_face, side, spread) * uniform.new_tensor(self.half)


class Frustum(NamedTuple):
    """A body of revolution around z from ``base`` (radius at -half_height) to ``top`` (at +half_height).

    Cylinder, cone (``top`` = 0) and flower pot are the same shape.
    """

    base: float
    top: float
    half_height: float

    @property
    def reach(self) -> float:
        return math.hypot(max(self.base, self.top), self.half_height)

    @property
    def area(self) -> float:
        return sum(self._part_areas())

    @property
    def slope(self) -> float:
        """Change of radius per unit of height."""
        return (self.top - self.base) / (2 * self.half_height)

    def _part_areas(self) -> tuple[float, float, float]:
        slant = math.hypot(2 * self.half_height, self.top - self.base)
        return math.pi * (self.base + self.top) * slant, math.pi * self.base**2, math.pi * self.top**2

    def intersect(self, origins: Points, directions: Points) -> Values:
        return torch.minimum(self._enter_side(origins, directions), self._enter_caps(origins, directions))

    def _enter_side(self, origins: Points, directions: Points) -> Values:
        radius = (self.base + self.top) / 2 + self.slope * origins[..., 2]
        growth = self.slope * directions[..., 2]
        (x, y, _), (u, v, _) = origins.unbind(-1), directions.unbind(-1)
        a = u.square() + v.square() - growth.square()
        b = x * u + y * v - radius * growth
        c = x.square() + y.square() - radius.square()
        # Both roots of a t^2 + 2 b t + c without cancellation; a NaN or infinite root satisfies no comparison.
        q = -(b + torch.where(b < 0, -1.0, 1.0) * (b.square() - a * c).sqrt())
        first = torch.full_like(a, torch.inf)
        for t in (q / a, c / q):
            height = origins[..., 2] + t * directions[..., 2]
            enters = (t > 0) & (height.abs() <= self.half_height) & (a * t + b < 0)
            first = torch.where(enters & (t < first), t, first)
        return first

    def _enter_caps(self, origins: Points, directions: Points) -> Values:
        up = directions[..., 2] > 0
        height = torch.where(up, -self.half_height, self.half_height)
        t = (height - origins[..., 2]) / directions[..., 2]
        reached = _around(origins + t[..., None] * directions)
        limit = torch.where(up, self.base, self.top)
        return torch.where((t > 0) & (reached < limit), t, torch.inf)

    def distance(self, points: Points) -> Values:
        # In the half plane (radius, height) the nearest point lies on a cap or on the slanted side.
        radius, height = _around(points), points[..., 2]
        cap = torch.where(height < 0, self.base, self.top)
        cap_out, cap_up = (radius - cap).clamp(min=0), height.abs() - self.half_height
        run, rise = self.top - self.base, 2 * self.half_height
        along = ((radius - self.base) * run + (height + self.half_height) * rise) / (run**2 + rise**2)
        along = along.clamp(0, 1)
        side_out = radius - self.base - along * run
        side_up = height + self.half_height - along * rise
        outside = (radius > self.base + self.slope * (height + self.half_height)) | (cap_up > 0)
        squared = torch.minimum(cap_out.square() + cap_up.square(), side_out.square() + side_up.square())
        return squared.sqrt() * torch.where(outside, 1.0, -1.0)

    def normal(self, points: Points) -> Points:
        radius, height = _around(points)[..., None], points[..., 2:]
        tilt = math.hypot(1.0, self.slope)
        outward = points[..., :2] / radius.clamp(min=torch.finfo(points.dtype).tiny)
        side = torch.cat([outward / tilt, torch.full_like(height, -self.slope / tilt)], dim=-1)
        cap = torch.cat([torch.zeros_like(outward), height.sign()], dim=-1)
        to_side = (radius - self.base - self.slope * (height + self.half_height)).abs() / tilt
        return torch.where((height.abs() - self.half_height).abs() < to_side, cap, side)

    def sample(self, uniform: Points) -> Points:
        areas = uniform.new_tensor(self._part_areas())
        part, _ = _pick((areas.cumsum(0) / areas.sum()).contiguous(), uniform[..., 0])
        # Circumference is linear in height, so its distribution is inverted by interpolating squared radii.
        squared = self.base**2 + uniform[..., 1] * (self.top**2 - self.base**2)
        tapered = abs(self.top - self.base) > 1e-3 * max(self.base, self.top)
        along = (squared.sqrt() - self.base) / (self.top - self.base) if tapered else uniform[..., 1]
        height = torch.where(part == 0, (2 * along - 1) * self.half_height, self.half_height)
        height = torch.where(part == 1, -self.half_height, height)
        rim = torch.where(part == 0, self.base + along * (self.top - self.base), self.top)
        rim = torch.where(part == 1, self.base, rim)
        radius = torch.where(part == 0, rim, rim * uniform[..., 1].sqrt())
        angle = 2 * math.pi * uniform[..., 2]
        return torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=-1)


class Torus(NamedTuple):
    """A ring around z: a tube of radius ``tube`` whose centre line is the circle of radius ``ring``."""

    ring: float
    tube: float

    @property
    def reach(self) -> float:
        return self.ring + self.tube

    @property
    def area(self) -> float:
        return 4 * math.pi**2 * self.ring * self.tube

    def intersect(self, origins: Points, directions: Points) -> Values:
        # Sphere tracing (Hart 1996) in float64: a quartic's roots lose half their digits where they meet.
        start, ray = origins.double(), directions.double()
        enter, end = _slabs(start, ray, (self.reach, self.reach, self.tube))
        t = enter.clamp(min=0)
        found = torch.zeros_like(t, dtype=torch.bool)
        (active,) = (t < end).nonzero(as_tuple=True)
        for _ in range(TORUS_STEPS):
            points = start[active] + t[active, None] * ray[active]
            gap, fall = self.distance(points), -dot(self.normal(points), ray[active])
            found[active] = (gap.abs() < TORUS_PRECISION) & (fall > 0)
            # Far off, the distance is a safe step; close by, Newton's step is far longer for slanting rays. A ray
            # that leaves the surface must get away from it.
            close = gap / torch.where(gap < self.tube / 16, fall.clamp(min=0.2), 1.0)
            t[active] += torch.where(fall > 0, close, gap.clamp(min=self.tube / 64))
            active = active[~found[active] & (t[active] < end[active])]
        return torch.where(found, t, torch.inf).to(origins.dtype)

    def distance(self, points: Points) -> Values:
        off_line = _around(points) - self.ring
        return torch.hypot(off_line, points[..., 2]) - self.tube

    def normal(self, points: Points) -> Points:
        radius = _around(points)[..., None].clamp(min=torch.finfo(points.dtype).tiny)
        on_line = torch.cat([points[..., :2] * (self.ring / radius), torch.zeros_like(radius)], dim=-1)
        return torch.nn.functional.normalize(points - on_line, dim=-1)

    def sample(self, uniform: Points) -> Points:
        # Area grows with the distance from the axis: invert the distribution of the angle around the tube,
        # F(v) = (v + tube / ring sin v) / 2 pi, by bisection.
        ratio, goal = self.tube / self.ring, 2 * math.pi * uniform[..., 1]
        low, high = torch.zeros_like(goal), torch.full_like(goal, 2 * math.pi)
        for _ in range(BISECTIONS):
            around = (low + high) / 2
            below = around + ratio * around.sin() < goal
            low, high = torch.where(below, around, low), torch.where(below, high, around)
        around, angle = (low + high) / 2, 2 * math.pi * uniform[..., 0]
        radius = self.ring + self.tube * around.cos()
        return torch.stack([radius * angle.cos(), radius * angle.sin(), self.tube * around.sin()], dim=-1)


TORUS_STEPS = 48
TORUS_PRECISION = 1e-6  # scene units
BISECTIONS = 40


def dot(a: Points, b: Points) -> Values:
    """Scalar product over the last axis, written out: a sum over so short an axis is several times slower."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _around(points: Points) -> Values:
    """Distance from the z axis."""
    return (points[..., 0].square() + points[..., 1].square()).sqrt()


def _slabs(origins: Points, directions: Points, half: tuple[float, float, float]) -> tuple[Values, Values]:
    """Where rays enter and leave a box (Kay and Kajiya 1986); enter >= leave where they miss it.

    A ray that runs within a face's plane gives 0/0, NaN: it satisfies no comparison, so such a ray misses.
    """
    sides = origins.new_tensor(half)
    before, after = (-sides - origins) / directions, (sides - origins) / directions
    enters, leaves = torch.minimum(before, after).unbind(-1), torch.maximum(before, after).unbind(-1)
    enter = torch.maximum(torch.maximum(enters[0], enters[1]), enters[2])
    leave = torch.minimum(torch.minimum(leaves[0], leaves[1]), leaves[2])
    return enter, leave


def _on_unit_sphere(height: Values, turn: Values) -> Points:
    """Area-uniform on the unit sphere for uniform inputs (Archimedes: height is uniform)."""
    z, angle = 2 * height - 1, 2 * math.pi * turn
    radius = (1 - z.square()).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)


def _pick(edges: Float[Tensor, "parts"], uniform: Values) -> tuple[Tensor, Values]:
    """Which part of a cumulative distribution ``uniform`` falls into, and how far into it, uniform in [0, 1)."""
    part = torch.searchsorted(edges, uniform.contiguous(), right=True).clamp(max=edges.numel() - 1)
    low = torch.cat([edges.new_zeros(1), edges[:-1]])[part]
    return part, ((uniform - low) / (edges[part] - low)).clamp(0, 1)
