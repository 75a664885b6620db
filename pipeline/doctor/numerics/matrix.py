"""All cases, and the table of what was measured."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch

from nerf.kernels import Backend
from nerf.kernels import torch as reference
from pipeline.doctor.numerics import Bound, Case, Measured, effects, light, losses, measure, networks, space

CASES: tuple[Case, ...] = (*space.CASES, *light.CASES, *effects.CASES, *losses.CASES, *networks.CASES)


class Row(NamedTuple):
    """A case with what was measured, by the name of the backend."""

    case: Case
    measured: dict[str, Measured]

    @property
    def passed(self) -> bool:
        """Whether every backend keeps the bounds."""
        return all(measured.within(self.case) for measured in self.measured.values())


def matrix(backends: Mapping[str, Backend], device: torch.device | str) -> Iterator[Row]:
    """Every case on ``device``; those of kernels on each of ``backends``, the others once, as "torch"."""
    for case in CASES:
        used: Mapping[str, Backend] = backends if case.kernels else {"torch": reference}
        yield Row(case, {name: measure(case, backend, device) for name, backend in used.items()})


def figure(error: float | None) -> str:
    """An error to one digit; — where there is nothing to measure."""
    return "—" if error is None else "0" if error == 0 else f"{error:.0e}".replace("e-0", "e-")


def limit(bound: Bound | None) -> str:
    """A bound and what it is a share of."""
    return "" if bound is None else f"≤ {figure(bound.error)} of {bound.of}"
