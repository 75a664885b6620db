"""The references of pipeline/doctor/numerics against 50 digits: formulas as they stand in the papers, one number at a
time."""

from collections.abc import Callable

import pytest
import torch
from mpmath import mp, mpf
from torch import Tensor

from nerf.fields.vanilla import SOFTPLUS_SHIFT
from nerf.kernels import RayStepping
from nerf.kernels.torch.adam import EPSILON
from pipeline.doctor.numerics import Case, error
from pipeline.doctor.numerics.losses import GROWING
from pipeline.doctor.numerics.matrix import CASES
from pipeline.doctor.numerics.networks import COUNT
from pipeline.doctor.numerics.space import CONTRACTED, OCTAVES

mp.dps = 50
Row = list[mpf]


def encoding(x: Row) -> Row:
    with mp.workdps(100):  # 1e30 has 30 digits before the point
        angles = [2**k * mp.pi * each for each in x for k in range(OCTAVES)]
        return [mp.sin(a) for a in angles] + [mp.cos(a) for a in angles]


def contraction(x: Row) -> Row:
    r = max(map(abs, x))
    return [(2 - 1 / r) * each / r for each in x] if r > 1 else x


def expansion(y: Row) -> Row:
    m = max(1, *map(abs, y))
    return [each / (m * (2 - m)) for each in y]


def distance(s: Row, stepping: RayStepping = CONTRACTED) -> Row:
    step, cone = mpf(stepping.step_size), mpf(stepping.cone_angle)
    return [step / cone * mp.exp(cone * each - 1) if cone * each > 1 else step * each for each in s]


def coordinate(t: Row) -> Row:
    step, cone = mpf(CONTRACTED.step_size), mpf(CONTRACTED.cone_angle)
    return [(1 + mp.log(each * cone / step)) / cone if each * cone > step else each / step for each in t]


def log_strata(near: Row, far: Row) -> Row:
    bins = 8
    return [near[0] * (far[0] / near[0]) ** ((mpf(i) + 0.5) / bins) for i in range(bins)] + far


def opacity(sigma: Row) -> Row:
    return [1 - mp.exp(-each) for each in sigma]


def ends() -> Row:
    steps = [mpf(each) / 8 for each in (1, 4, 2, 8, 1, 6, 3, 7)]
    return [2 + mp.fsum(steps[:i]) for i in range(len(steps) + 1)]


def rendering(sigma: Row, colour: Row, background: Row) -> Row:
    """As the product of what each interval lets through."""
    t, light, seen, depth, weights = ends(), mpf(1), [mpf(0)] * 3, mpf(0), []
    for i, each in enumerate(sigma):
        through = mp.exp(-each * (t[i + 1] - t[i]))
        weights.append(light * (1 - through))
        seen = [s + weights[-1] * c for s, c in zip(seen, colour[3 * i : 3 * i + 3], strict=True)]
        depth += weights[-1] * t[i]
        light *= through
    return [*(s + light * b for s, b in zip(seen, background, strict=True)), depth + light * t[-1], 1 - light, *weights]


def spread(weights: Row, grows: bool) -> Row:
    at, length = ends()[:-1], [b - a for a, b in zip(ends(), ends()[1:], strict=False)]
    far = mpf(768 if grows else 3)
    t, dt = [far * (1 + each / 64) for each in at], [far / 64 * each for each in length]
    from_there = mpf(GROWING.step_size) / mpf(GROWING.cone_angle)
    m = [1 + mp.log(each / from_there) for each in t] if grows else t
    lengths = [b / a for a, b in zip(t, dt, strict=True)] if grows else dt
    pairs = [w * v * abs(a - b) for w, a in zip(weights, m, strict=True) for v, b in zip(weights, m, strict=True)]
    return [mp.fsum(pairs) + mp.fsum(w * w * each for w, each in zip(weights, lengths, strict=True)) / 3]


def decibel(error: Row) -> Row:
    return [-10 * mp.log10(each) if each > mpf("1e-10") else mpf(100) for each in error]


def occupied(density: Row) -> Row:
    return [1 - mpf(2) ** (-each / 7) for each in density]


def limited_exponential(x: Row) -> Row:
    return [mp.exp(min(each, 15)) for each in x]


def softplus(x: Row) -> Row:
    with mp.workdps(500):  # 1 + e^-200
        return [mp.log(1 + mp.exp(each + SOFTPLUS_SHIFT)) if each > -1000 else mpf(0) for each in x]


def adam(gradient: Row, mean: Row, square: Row) -> Row:
    g, m = gradient[0], mpf(0.9) * mean[0] + (1 - mpf(0.9)) * gradient[0]
    v = mpf(0.99) * square[0] + (1 - mpf(0.99)) * g * g
    root = max(mpf(EPSILON), mp.sqrt(v / (1 - mpf(0.99) ** COUNT)))
    return [-m / (1 - mpf(0.9) ** COUNT) / root if g else mpf(0)]


PLAIN: dict[str, Callable[..., Row]] = {
    "γ(x)": encoding,
    "contraction": contraction,
    "its inverse y": expansion,
    "t(s)": distance,
    "s(t)": coordinate,
    "stratified samples near": log_strata,
    "opacity of thin": opacity,
    "w_i =": rendering,
    "the same of packed": rendering,
    "distortion ΣΣ": lambda weights: spread(weights, False),
    "distortion where": lambda weights: spread(weights, True),
    "PSNR": decibel,
    "occupancy": occupied,
    "density exp": limited_exponential,
    "density log": softplus,
    "Adam": adam,
}


def case_of(formula: str) -> Case:
    (case,) = (case for case in CASES if case.formula.startswith(formula))
    return case


def rows_of(inputs: tuple[Tensor, ...]) -> list[list[Row]]:
    """Each row of each input as numbers of 50 digits."""
    return [[[mpf(x) for x in part[i].flatten().tolist()] for part in inputs] for i in range(len(inputs[0]))]


@pytest.mark.parametrize("formula", PLAIN)
def test_the_reference_is_the_formula(formula: str) -> None:
    """To 1e-12 of itself (of one, where a sine or a weight may be near zero), on a few typical and the extreme rows."""
    case = case_of(formula)
    inputs = tuple(torch.cat([a[:8], b[:24]]) for a, b in zip(case.typical(), case.extreme(), strict=True))
    wanted = torch.tensor([[float(x) for x in PLAIN[formula](*row)] for row in rows_of(inputs)], dtype=torch.float64)
    found = case.reference(*(part.double() for part in inputs))
    of = "one" if case.value.of == "one" else "itself"
    assert error(found.view_as(wanted), wanted, of) < 1e-12
    assert len(wanted.unique()) > 8, "the rows are not all alike"


def test_fifty_digits_find_a_reference_that_cancels() -> None:
    tau = torch.tensor([[1e-9]], dtype=torch.float64)
    wanted = torch.tensor([[float(opacity([mpf(1e-9)])[0])]], dtype=torch.float64)
    assert error(-torch.expm1(-tau), wanted, "itself") < 1e-15
    assert error(1 - torch.exp(-tau), wanted, "itself") > 1e-9
