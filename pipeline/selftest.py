"""``pipeline doctor --selftest``: every formula of docs/NUMERICS.md measured on this machine's own device."""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerf.kernels import Backend
    from nerf.numerics.matrix import Row

HEADER = f"  {'':<7}{'formula':<58} {'on':<6}{'value':>7}  {'limit':<18} {'gradient':>8}  limit"


def numerical_matrix(device: str) -> list[str]:
    """Print the table, a line for each formula and backend; what is wrong, in sentences."""
    from nerf.numerics.matrix import matrix

    started, wrong, count = time.monotonic(), [], 0
    print(f"numerical self-test on {device}: worst errors in float32 against float64")
    print(HEADER)
    for row in matrix(_backends(device), device):
        count += 1
        print("\n".join(_lines(row)))
        if not row.passed:
            wrong.append(f"self-test: {row.case.formula} ({row.case.where}) is off by more than its limit")
    print(f"{count} formulas, {count - len(wrong)} within their limits, {time.monotonic() - started:.0f} s")
    return wrong


def _backends(device: str) -> "dict[str, Backend]":
    """Torch's, and Warp's where they run."""
    from stages.backend import chosen_backend, load_backend

    names = ("torch", "warp") if chosen_backend(device) == "warp" else ("torch",)
    return {name: load_backend(name, device) for name in names}


def _lines(row: "Row") -> list[str]:
    from nerf.numerics.matrix import figure, limit

    case, lines = row.case, []
    for name, found in row.measured.items():
        verdict = "ok" if found.within(case) else "FAILED"
        value, gradient = f"{figure(found.value):>7}  {limit(case.value):<18}", f"{figure(found.gradient):>8}"
        lines.append(
            f"  {verdict:<7}{case.formula:<58.58} {name:<6}{value} {gradient}  {limit(case.gradient)}".rstrip()
        )
    return lines
