"""Every case of pipeline/doctor/numerics within its bounds, its gradient that of differences, and docs/NUMERICS.md the
result."""

import ast
import functools
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerf.kernels import Backend, warp
from nerf.kernels import torch as reference
from pipeline.doctor.numerics import Bound, Case, Measured, cotangent, error, measure
from pipeline.doctor.numerics.matrix import CASES, Row, figure, limit
from tests.devices import skip_without
from tests.numerics.document import DOCUMENT, ELSEWHERE, NO_FORMULA, REPEATED, STATISTICS, document

ROOT = Path(__file__).parents[2]
BACKENDS: dict[str, Backend] = {"torch": reference, "warp": warp}
SLACK = 50.0
FIGURE = re.compile(r"(?<![\w.])(?:\d(?:e[+-]?\d+)|0|—|inf)(?= /| \(≤)")


@functools.cache
def row_of(case: Case) -> Row:
    """A case measured on the CPU."""
    return Row(case, {name: measure(case, BACKENDS[name], "cpu") for name in backends_of(case)})


def backends_of(case: Case) -> list[str]:
    return ["torch", "warp"] if case.kernels else ["torch"]


def named(case: Case) -> str:
    return f"{case.where.split(':')[1].strip()} {case.formula}"


@pytest.mark.parametrize("case", CASES, ids=named)
def test_errors_keep_their_bounds_and_the_bounds_mean_something(case: Case) -> None:
    row = row_of(case)
    measured = row.measured.values()
    assert row.passed, measured
    assert max(each.value for each in measured) >= case.value.error / SLACK
    if case.gradient:
        assert max(each.gradient or 0.0 for each in measured) >= case.gradient.error / SLACK


@pytest.mark.gpu
@pytest.mark.parametrize("case", CASES, ids=named)
def test_a_gpu_keeps_the_bounds_too(case: Case) -> None:
    skip_without("cuda")
    measured = {name: measure(case, BACKENDS[name], "cuda") for name in backends_of(case)}
    assert Row(case, measured).passed, measured


class ByHand(torch.autograd.Function):
    """A case's function with the gradient that was written by hand."""

    @staticmethod
    def forward(ctx: Any, case: Case, *inputs: Tensor) -> Tensor:
        ctx.case = case
        ctx.save_for_backward(*inputs)
        return case.function(reference, *inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.case.backward(reference, grads[0].contiguous(), *ctx.saved_tensors)
        return (None, *given, *(None for _ in ctx.saved_tensors[len(given) :]))


DIFFERENTIABLE = [case for case in CASES if case.gradient]


@pytest.mark.parametrize("case", DIFFERENTIABLE, ids=named)
def test_gradients_are_those_of_differences(case: Case) -> None:
    """In float64, on typical rows. The whole table counts as one input, of which few rows are tried."""
    inputs = [part.double().requires_grad_(place < case.differentiable) for place, part in enumerate(case.typical())]
    if "table" not in case.formula:
        inputs = [part.detach()[:4].requires_grad_(part.requires_grad) for part in inputs]

    def function(*given: Tensor) -> Tensor:
        if case.backward is None:
            return case.function(reference, *given)
        return ByHand.apply(case, *given)  # pyright: ignore[reportReturnType]

    assert torch.autograd.gradcheck(function, inputs, fast_mode=True, atol=1e-6)


def test_every_formula_has_its_place() -> None:
    """A row that names functions which are there, a reason in ELSEWHERE, or nothing to measure: exactly one of them."""
    of_rows = {case.where.split(":")[0] for case in CASES}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "nerf").rglob("*.py") if defines_something(path)}
    left = {name for name in modules if not name.startswith(REPEATED + STATISTICS)}
    assert of_rows | set(ELSEWHERE) | NO_FORMULA == left
    assert len(of_rows) + len(ELSEWHERE) + len(NO_FORMULA) == len(left)
    for case in CASES:
        module, functions = case.where.split(": ")
        defined = {node.name for node in ast.walk(ast.parse((ROOT / module).read_text())) if hasattr(node, "name")}  # pyright: ignore
        assert set(functions.split(", ")) <= defined, case.where


def defines_something(module: Path) -> bool:
    """Most ``__init__.py`` hold a docstring, constants and imports alone."""
    return any(hasattr(node, "name") for node in ast.parse(module.read_text("utf-8")).body)


def test_the_reasons_name_tests_that_exist() -> None:
    named_tests = {name for words in ELSEWHERE.values() for name in re.findall(r"tests/[\w/]+\.py", words)}
    assert len(named_tests) > 10 and all((ROOT / name).exists() for name in named_tests)


def test_the_document_is_what_would_be_written() -> None:
    """But for the figures measured, which depend on the machine: those written must keep the limits beside them."""
    written = DOCUMENT.read_text("utf-8")
    found, wanted = FIGURE.sub("#", written), FIGURE.sub("#", document(map(row_of, CASES)))
    assert found == wanted, "run python -m tests.numerics"
    lines = [line for line in written.splitlines() if line.startswith("| ")][1:]
    for case, line in zip(CASES, lines, strict=True):
        for bound, cell in zip((case.value, case.gradient), line.strip("| ").split(" | ")[-2:], strict=True):
            if bound:
                figures = [float(text) for text in FIGURE.findall(cell)]
                assert len(figures) == len(backends_of(case)) and max(figures) <= 1.05 * bound.error, line


def test_the_error_sees_errors() -> None:
    wanted = torch.tensor([[4.0, 1e-3], [0.0, 2.0]], dtype=torch.float64)
    found = wanted + torch.tensor([[0.0, 1e-4], [0.0, 0.0]])
    assert error(wanted, wanted, "itself") == 0
    assert error(found, wanted, "itself") == pytest.approx(0.1)
    assert error(found, wanted, "row") == pytest.approx(1e-4 / 4)
    assert error(found, wanted, "one") == pytest.approx(1e-4)
    assert error(torch.full((1,), 1e-40), torch.zeros(1).double(), "itself") == pytest.approx(
        1e-40 / 1.17549e-38, rel=1e-3
    )
    assert error(torch.tensor([torch.nan]), torch.ones(1), "one") == float("inf")
    for bad in (torch.ones(2), torch.ones(0)):
        with pytest.raises(ValueError, match="found"):
            error(bad, bad[:1] if len(bad) else bad, "one")


def test_a_wrong_value_or_gradient_is_found() -> None:
    good = next(case for case in CASES if "contraction" in case.formula)
    assert measure(good, reference, "cpu").within(good)
    off = good._replace(function=lambda backend, x: good.function(backend, x) * (1 + 1e-5))
    assert not measure(off, reference, "cpu").within(off)
    flat = good._replace(backward=lambda backend, grad, x: (0.999 * grad,))
    assert measure(flat, reference, "cpu").value < 1e-6 and not measure(flat, reference, "cpu").within(flat)
    assert not Measured(0.0, float("inf"), 1).within(good)


def test_the_cotangent_repeats_and_favours_no_direction() -> None:
    assert torch.equal(cotangent(torch.zeros(5, 3)), cotangent(torch.ones(5, 3)))
    assert 0.8 < cotangent(torch.zeros(10_000)).std() < 1.2


def test_figures_have_one_digit() -> None:
    assert [figure(x) for x in (1.26e-7, 0.0, None, 4e-16)] == ["1e-7", "0", "—", "4e-16"]
    assert limit(Bound(2e-5, "row")) == "≤ 2e-5 of row" and limit(None) == ""
