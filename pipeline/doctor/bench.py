"""``pipeline doctor --bench``: what this machine can do, and how fast training could be with nothing else to do."""

import torch

from nerf.fields import mlp
from nerf.fields.hash_grid import CORNERS, HashGridField
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.kernels import torch as reference
from nerf.runtime.machine_rates import Rates, copied_bytes, measure_copy, measure_gather, measure_matmul
from nerf.runtime.profiler import WorkCounts
from nerf.training.hash_grid_trainer import ADAM_BYTES
from stages.effects.decisions import Space
from stages.hardware.device import compute_device, cores
from stages.io.amounts import bytes_in_words, counted, short_count
from stages.train.config import Config
from stages.train.fields.hash_grid import SAMPLES_PER_RAY, field_settings, rays_per_step, timed, with_defaults

SECONDS = 0.3  # for each rate
TABLES = {"2¹⁷": 1 << 17, "2²⁰": 1 << 20}  # rows: of one grid, of all of a large field
# Of a ray while the hash-grid field trains: densities asked for, beside the colours of
# stages/train/fields/hash_grid.py. Over a run lego_400, fox, banana and fountain_p11 ask for 2.3 to 2.9 for each colour
# (docs/experiments/ray_samples.md).
DENSITIES: dict[Space, int] = {"bounded": 7, "contracted": 24}
WHERE: dict[Space, str] = {"bounded": "around an object", "contracted": "in unbounded space"}
VANILLA_RAYS = {"vanilla NeRF as published": (8, 256, 64, 128), "vanilla NeRF 4 × 64": (4, 64, 32, 32)}


def bench_lines(device: torch.device) -> list[str]:
    """Measure, and the table in lines."""
    compute_device()
    count = cores()
    products = {width: measure_matmul(device, width, SECONDS) for width in (64, 256)}
    reads = {name: measure_gather(device, rows, SECONDS) for name, rows in TABLES.items()}
    copied = measure_copy(device, SECONDS)
    words = f"{counted(count, 'core')} at once" if device.type == "cpu" else "the GPU"
    lines = [f"rates of {words}, float32" + (", per core and in all" if count > 1 else "")]
    for width, rate in products.items():
        lines.append(_line(f"matrix multiplication (8192, {width}) × ({width}, {width})", rate / 1e9, count, "GFLOP/s"))
    for name, rate in reads.items():
        lines.append(_line(f"random reads of 16 bytes, table of {name} rows", rate / 1e6, count, "million/s"))
    size = bytes_in_words(copied_bytes(device))
    lines.append(_line(f"memory, copying {size} (read and written)", copied / 1e9, count, "GB/s"))
    return [*lines, *_meaning(products, reads["2²⁰"], copied, count)]


def _line(name: str, rate: float, count: int, unit: str) -> str:
    return (
        f"  {name:<48} {rate:>8.1f} {rate * count:>8.1f} {unit}" if count > 1 else f"  {name:<48} {rate:>8.1f} {unit}"
    )


def _meaning(products: dict[int, float], reads: float, copied: float, count: int) -> list[str]:
    """What training can reach here at most: the work of a ray that nothing can save, at these rates."""
    lines = ["upper bounds of the training speed at these rates"]
    for space, densities in DENSITIES.items():
        work = grid_work(space, densities)
        most = count / Rates(products[64], reads, copied).seconds(work)
        text = f"hash-grid field {WHERE[space]} ({SAMPLES_PER_RAY[space]} colours, {densities} densities a ray)"
        lines.append(f"  {short_count(most):>8} rays/s  {text}")
    for name, sizes in VANILLA_RAYS.items():
        most = count / Rates(products[sizes[1]], reads, copied).seconds(WorkCounts(matmul_flops=vanilla_flops(*sizes)))
        lines.append(f"  {short_count(most):>8} rays/s  {name}")
    return lines


def grid_work(space: Space, densities: float) -> WorkCounts:
    """Of a ray in training, its share of the optimiser's included: a large field, in the steps that stage train takes
    on this machine."""
    asked = Config(space=space, view_dependence=True)
    config = timed(with_defaults(asked))
    model = HashGridField(field_settings(config, background_model=False), 0, reference)
    density, colour = mlp.density_flops(model.weights), mlp.colour_flops(model.weights)
    colours = SAMPLES_PER_RAY[space]
    rows = CORNERS * model.settings.num_levels * (densities + colours)
    adam = ADAM_BYTES * model.table.numel() / rays_per_step(config)
    return WorkCounts(densities * density + colours * (colour + 2 * (density + colour)), rows, adam)


def vanilla_flops(depth: int, width: int, coarse: int, fine: int) -> int:
    """Multiplications and additions of a ray of the vanilla NeRF in training."""
    model = VanillaNerf(VanillaSettings(depth=depth, width=width, samples_coarse=coarse, samples_fine=fine), 0)
    return model.settings.queries_per_ray * (model.fine.matmul_flops + model.fine.matmul_flops_backward)
