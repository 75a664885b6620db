"""``pipeline doctor``'s checks of this machine's arithmetic: four quick ones, and with ``--selftest`` every formula of
docs/NUMERICS.md."""

import time

import torch

from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays
from nerf.kernels import Backend
from nerf.rendering.volume_rendering import composite
from pipeline.doctor.numerics.matrix import Row, figure, limit, matrix
from stages.hardware.backend import chosen_backend, load_backend

HEADER = f"  {'':<7}{'formula':<58} {'on':<6}{'value':>7}  {'limit':<18} {'gradient':>8}  limit"


def self_test(device: torch.device) -> list[tuple[str, str]]:
    """(check, error or "") for each check, printed as it goes."""
    results = []
    for name, check in (
        ("a homogeneous fog renders as its closed form", _check_fog),
        ("the gradient of a rendered colour agrees with differences", _check_gradient),
        ("optical depths from 0 to 1e30 stay finite, value and gradient", _check_extremes),
        ("a small field learns one colour in 40 steps", _check_learning),
    ):
        started = time.monotonic()
        error = check(device)
        print(f"  {'FAILED' if error else 'ok':<7}{name} ({time.monotonic() - started:.1f} s)")
        results.append((name, error))
    return results


def _check_fog(device: torch.device) -> str:
    """Constant density over [0, 2] has opacity 1 - exp(-2 sigma), however it is cut into intervals."""
    t = torch.linspace(0, 2, 129, device=device)[None]
    sigma = torch.full((1, 128), 0.7, device=device)
    rendering, _ = composite(sigma, sigma.new_ones(1, 128, 3), t, sigma.new_zeros(3))
    error = abs(rendering.opacity.item() - -torch.expm1(torch.tensor(-1.4, dtype=torch.float64)).item())
    return "" if error < 1e-5 else f"opacity is off by {error:.1e}"


def _check_gradient(device: torch.device) -> str:
    t = torch.tensor([[0.1, 0.4, 0.9, 1.0, 2.0]], dtype=torch.float64, device=device)
    colour = torch.linspace(0, 1, 12, dtype=torch.float64, device=device).view(1, 4, 3)
    sigma = torch.tensor([[0.2, 3.0, 0.0, 9.0]], dtype=torch.float64, device=device, requires_grad=True)
    try:
        torch.autograd.gradcheck(lambda s: composite(s, colour, t, colour.new_ones(3))[0].colour, (sigma,))
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return ""


def _check_extremes(device: torch.device) -> str:
    for extreme in (0.0, 1e-38, 1e-6, 1.0, 1e6, 1e30):
        sigma = torch.full((1, 8), extreme, device=device, requires_grad=True)
        rendering, _ = composite(
            sigma, torch.rand(1, 8, 3, device=device), torch.arange(9.0, device=device)[None], sigma.new_zeros(3)
        )
        (rendering.colour.sum() + rendering.depth.sum() + rendering.opacity.sum()).backward()
        assert sigma.grad is not None
        if not all(torch.isfinite(x).all() for x in (*rendering, sigma.grad)):
            return f"not finite at optical depth {extreme:g}"
    return ""


def _check_learning(device: torch.device) -> str:
    """Forward, backward and optimiser together: the loss must fall a hundredfold."""
    settings = VanillaSettings(depth=2, width=32, skip=1, samples_coarse=8, samples_fine=8)
    model = VanillaNerf(settings, seed=0).to(device)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    directions = torch.nn.functional.normalize(torch.randn(256, 3, device=device), dim=-1)
    ones = torch.ones(256, device=device)
    rays = Rays(-0.8 * directions, directions, 0.1 * ones, 1.6 * ones)
    target, losses = torch.tensor([0.8, 0.2, 0.4], device=device), []
    for _ in range(40):
        rendering = model.render_training(rays, target.new_zeros(3), None)[1]
        loss = (rendering.colour - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return "" if losses[-1] < 0.01 * losses[0] else f"the loss went from {losses[0]:.3g} to {losses[-1]:.3g} only"


# --- formula by formula


def numerical_matrix(device: str) -> list[str]:
    """Print the table, a line for each formula and backend; what is wrong, in sentences."""
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


def _backends(device: str) -> dict[str, Backend]:
    """Torch's, and Warp's where they run."""
    names = ("torch", "warp") if chosen_backend(device) == "warp" else ("torch",)
    return {name: load_backend(name, device) for name in names}


def _lines(row: Row) -> list[str]:
    case, lines = row.case, []
    for name, found in row.measured.items():
        verdict = "ok" if found.within(case) else "FAILED"
        value, gradient = f"{figure(found.value):>7}  {limit(case.value):<18}", f"{figure(found.gradient):>8}"
        lines.append(
            f"  {verdict:<7}{case.formula:<58.58} {name:<6}{value} {gradient}  {limit(case.gradient)}".rstrip()
        )
    return lines
