"""How exact the formulas of nerf/ are in float32: a case each, measured against float64 on ordinary and extreme input.

The cases are data that three readers share: ``tests/numerics`` holds them to their bounds, ``docs/NUMERICS.md`` is
written from them, and ``pipeline doctor --selftest`` runs them on the user's own device. A new formula gets a case in
one of the modules beside this one (or in a new one that ``matrix.py`` adds) and a description in
``tests/numerics/descriptions.py``, and thereby a row, a test and a line of the self-test.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from nerf.kernels import Backend

Scale = Literal["itself", "row", "one"]
SMALLEST = torch.finfo(torch.float32).tiny  # below it float32 has fewer digits: errors there count as shares of it


class Bound(NamedTuple):
    """The largest error that may be measured, as a share of the true number ``itself``, of the largest true number in
    its ``row`` (the last axis), or of ``one``."""

    error: float
    of: Scale


class Case(NamedTuple):
    """A formula, ``where`` it is (file and functions), and how to find out what float32 does to it.

    ``typical`` and ``extreme`` give the inputs, float32 tensors that agree in their first axis, the rows; the first
    ``differentiable`` of them get gradients. ``function`` takes a backend and the inputs, ``reference`` float64 inputs;
    both answer with one tensor of as many rows. ``backward`` is a gradient written by hand: from a backend, the
    gradient of the result and the inputs to gradients of the differentiable ones; without one autograd's is measured.
    ``kernels``: whether it is measured on every backend.
    """

    formula: str
    where: str
    typical: Callable[[], tuple[Tensor, ...]]
    extreme: Callable[[], tuple[Tensor, ...]]
    function: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    value: Bound
    gradient: Bound | None = None
    differentiable: int = 0
    backward: Callable[..., tuple[Tensor, ...]] | None = None
    kernels: bool = False

    def inputs(self) -> tuple[Tensor, ...]:
        """The typical rows, then the extreme ones."""
        return tuple(torch.cat(parts) for parts in zip(self.typical(), self.extreme(), strict=True))


class Measured(NamedTuple):
    """Worst errors of value and gradient (None without one), infinite where something was not finite."""

    value: float
    gradient: float | None
    rows: int

    def within(self, case: Case) -> bool:
        """Whether both errors keep the case's bounds."""
        return self.value <= case.value.error and (case.gradient is None or (self.gradient or 0) <= case.gradient.error)


def measure(case: Case, backend: Backend, device: torch.device | str) -> Measured:
    """Run a case in float32 on ``device``, its reference in float64."""
    inputs = tuple(part.to(device) for part in case.inputs())
    exact = tuple(part.double() for part in inputs)
    rows = len(inputs[0])
    if case.gradient is None:
        with torch.no_grad():
            return Measured(error(case.function(backend, *inputs), case.reference(*exact), case.value.of), None, rows)
    found, gradients = _found(case, backend, inputs)
    wanted, exact_gradients = _by_autograd(case.reference, exact, case.differentiable)
    pairs = zip(gradients, exact_gradients, strict=True)
    worst = max(error(one, right, case.gradient.of) for one, right in pairs)
    return Measured(error(found, wanted, case.value.of), worst, rows)


def error(found: Tensor, wanted: Tensor, of: Scale) -> float:
    """The largest difference in the given scale; infinite if something found is not finite. Raises ValueError for
    tensors of different shapes, or none at all: they would compare nothing."""
    if found.shape != wanted.shape or not wanted.numel():
        raise ValueError(f"found {tuple(found.shape)}, wanted {tuple(wanted.shape)}")
    if not (found.isfinite().all() and wanted.isfinite().all()):
        return float("inf")
    size = wanted.abs()
    scale = {"itself": size, "row": size.amax(-1, keepdim=True), "one": torch.ones_like(size)}[of]
    difference = (found.double() - wanted).abs()
    if found.is_cuda:  # atomic additions take subnormal numbers for zero (PTX ISA, atom.add.f32)
        difference = (difference - SMALLEST).clamp(min=0)
    return float((difference / scale.clamp(min=SMALLEST)).max())


def cotangent(result: Tensor) -> Tensor:
    """The gradient of a made-up loss with respect to ``result``: the same normal numbers for the same shape."""
    random = torch.Generator().manual_seed(0)
    return torch.randn(result.shape, generator=random).to(result)


def _found(case: Case, backend: Backend, inputs: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
    """What the code answers, and the gradients of its inputs."""
    if case.backward is None:
        return _by_autograd(lambda *given: case.function(backend, *given), inputs, case.differentiable)
    with torch.no_grad():
        result = case.function(backend, *inputs)
        return result, case.backward(backend, cotangent(result), *inputs)


def _by_autograd(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], differentiable: int
) -> tuple[Tensor, tuple[Tensor, ...]]:
    followed = [part.detach().requires_grad_(place < differentiable) for place, part in enumerate(inputs)]
    result = function(*followed)
    return result.detach(), torch.autograd.grad(result, followed[:differentiable], cotangent(result))
