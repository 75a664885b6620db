"""``pipeline doctor``: what this machine has, and whether its arithmetic can be trusted, in about five seconds; with
``--selftest``, formula by formula (pipeline/selftest.py); with ``--bench``, how fast it is (pipeline/bench.py)."""

import platform
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline import machine
from pipeline.bench import bench_lines
from pipeline.selftest import numerical_matrix
from stages.device import processors

if TYPE_CHECKING:
    import torch

PACKAGES = (
    "torch", "pycolmap", "kornia", "opencv-contrib-python-headless", "trimesh", "numpy", "scikit-image", "pillow",
    "safetensors", "imageio-ffmpeg",
)  # fmt: skip
LOW_DISK_GB = 2.0


def examine(folder: Path, selftest: bool = False, bench: bool = False) -> int:
    """Print versions, device, threads, free disk and the self-test, the long one and the machine's rates if asked for.
    0 if all is well, 1 otherwise."""
    import torch

    print(f"python {platform.python_version()} on {platform.platform()}")
    found = machine.versions(PACKAGES)
    print("\n".join(f"  {name:<32} {version}" for name, version in found.items()))
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none that torch can use"
    free_gb = machine.free_bytes(folder) / 2**30
    print(f"cores {processors()} · torch threads {torch.get_num_threads()} · GPU {gpu} · {free_gb:.1f} GB free")
    problems = [f"{name} is not installed" for name, version in found.items() if version == "missing"]
    if free_gb < LOW_DISK_GB:
        problems.append(f"only {free_gb:.1f} GB free: a run needs about {LOW_DISK_GB:.0f} GB")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    problems += [f"self-test: {name}: {error}" for name, error in self_test(device) if error]
    if selftest:
        problems += numerical_matrix(device.type)
    if bench:
        print("\n".join(bench_lines(device)))
    print("\n".join(f"problem: {problem}" for problem in problems) or "all well")
    return 1 if problems else 0


def self_test(device: "torch.device") -> list[tuple[str, str]]:
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


def _check_fog(device: "torch.device") -> str:
    """Constant density over [0, 2] has opacity 1 - exp(-2 sigma), however it is cut into intervals."""
    import torch

    from nerf.compositing import composite

    t = torch.linspace(0, 2, 129, device=device)[None]
    sigma = torch.full((1, 128), 0.7, device=device)
    rendering, _ = composite(sigma, sigma.new_ones(1, 128, 3), t, sigma.new_zeros(3))
    error = abs(rendering.opacity.item() - -torch.expm1(torch.tensor(-1.4, dtype=torch.float64)).item())
    return "" if error < 1e-5 else f"opacity is off by {error:.1e}"


def _check_gradient(device: "torch.device") -> str:
    import torch

    from nerf.compositing import composite

    t = torch.tensor([[0.1, 0.4, 0.9, 1.0, 2.0]], dtype=torch.float64, device=device)
    colour = torch.linspace(0, 1, 12, dtype=torch.float64, device=device).view(1, 4, 3)
    sigma = torch.tensor([[0.2, 3.0, 0.0, 9.0]], dtype=torch.float64, device=device, requires_grad=True)
    try:
        torch.autograd.gradcheck(lambda s: composite(s, colour, t, colour.new_ones(3))[0].colour, (sigma,))
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return ""


def _check_extremes(device: "torch.device") -> str:
    import torch

    from nerf.compositing import composite

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


def _check_learning(device: "torch.device") -> str:
    """Forward, backward and optimiser together: the loss must fall a hundredfold."""
    import torch

    from nerf.paper import PaperNerf, PaperSettings
    from nerf.rays import Rays

    settings = PaperSettings(depth=2, width=32, skip=1, samples_coarse=8, samples_fine=8)
    model = PaperNerf(settings, seed=0).to(device)
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
