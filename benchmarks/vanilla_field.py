"""How fast the vanilla NeRF is, where its time goes, and how near it comes to its matrix products alone.

    python -m benchmarks.vanilla_field [--preset small|published] [--threads N]

Run it on an idle machine: torch's threads wait for each other, so one busy core slows all of them.

The floor is arithmetic: a ray of the small preset (4 x 64, 32 + 32 samples) is 4.3 MFLOP forward in training, 3.9 in
rendering (the coarse network leaves out colour) and three times the former, less the gradient of the encoding, forward
and backward. One core of an AMD EPYC (AVX2, 2 in the machine, others at work on it, torch 2.13) does 50-60 GFLOP/s in
products of these shapes. The shares there, one thread, 256 rays at a time: forward reaches 69 % of the floor,
forward+backward 68 %; encoding takes 7 % of the forward pass, sampling and compositing 2 %. The rest is memory:
bias, ReLU and their gradients pass over activations, and above some 512 rays at a time the allocator returns and
fetches its pages anew at every step (a third to a half of training's time).
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks.record import Record, add_out
from nerf.fields.positional_encoding import positional_encoding
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays, points_on
from nerf.rendering.sampling import midpoint_edges, sample_pdf, stratified
from nerf.rendering.volume_rendering import composite
from nerf.runtime.randomness import generator

PRESETS = {
    "small": VanillaSettings(depth=4, width=64, samples_coarse=32, samples_fine=32),
    "published": VanillaSettings(),
}
BACKGROUND = torch.ones(3)


def seconds(*works: Callable[[], object], least: float = 1.0) -> list[float]:
    """The fastest run of each, taken in turn so that a disturbance meets all alike, for ``least`` seconds each."""
    times: list[list[float]] = [[] for _ in works]
    while sum(map(sum, times)) < least * len(works) or len(times[0]) < 4:
        for work, mine in zip(works, times, strict=True):
            start = time.perf_counter()
            work()
            mine.append(time.perf_counter() - start)
    return [min(mine) for mine in times]


def random_rays(count: int) -> Rays:
    """Rays from a distance of 3 towards the region of interest."""
    random = generator("cpu", 0)
    origins = 3 * torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    targets = torch.rand(count, 3, generator=random) - 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return Rays(origins, directions, torch.full((count,), 2.0), torch.full((count,), 4.0))


def products(model: VanillaNerf, rays: int, backward: bool) -> Callable[[], None]:
    """The bare matrix products of both networks, into memory that is already there."""
    settings = model.settings
    triples: list[tuple[Tensor, Tensor, Tensor]] = []
    for name, weight in model.named_parameters():
        if not name.endswith("weight"):
            continue
        outputs, inputs = weight.shape
        if "colour_hidden" in name:
            inputs = settings.width  # the direction's part is one row per ray: left out of the floor
        rows = rays * (settings.samples_coarse + settings.samples_fine * name.startswith("fine"))
        x, w, y = torch.rand(rows, inputs), torch.rand(outputs, inputs), torch.rand(rows, outputs)
        triples.append((x, w.T, y))
        if backward:
            triples.append((y.T, x, torch.empty(outputs, inputs)))
            if "trunk.0" not in name:
                triples.append((y, w, torch.empty_like(x)))

    def work() -> None:
        for a, b, out in triples:
            torch.mm(a, b, out=out)

    return work


def forward(model: VanillaNerf, rays: Rays) -> None:
    with torch.no_grad():
        model.render_training(rays, BACKGROUND, generator("cpu", 0))


def forward_and_backward(model: VanillaNerf, rays: Rays) -> None:
    coarse, fine = model.render_training(rays, BACKGROUND, generator("cpu", 0))
    (coarse.colour.square().sum() + fine.colour.square().sum()).backward()


def print_rates(model: VanillaNerf, batches: tuple[int, ...], record: Record) -> None:
    for count in batches:
        rays = random_rays(count)
        render, train = seconds(partial(model.render, rays, BACKGROUND), partial(forward_and_backward, model, rays))
        record.add(rays_at_a_time=count, render_rays_per_second=round(count / render), rays_per_second=count / train)


def print_parts(model: VanillaNerf, count: int) -> None:
    """Time of each part alone on inputs of its size, as a share of training's forward pass."""
    settings, rays, random = model.settings, random_rays(count), generator("cpu", 1)
    assert model.coarse is not None
    n, m = settings.samples_coarse, settings.samples_fine
    first, union = (stratified(rays.near, rays.far, k, random) for k in (n, n + m))
    weights, points = torch.rand(count, n, generator=random), [points_on(rays, t[:, :-1]) for t in (first, union)]
    sigma, colour = model.fine(points[1], rays.directions)

    def sample() -> None:
        drawn = sample_pdf(midpoint_edges(first, rays.near), weights, m, random)
        torch.sort(torch.cat([first, drawn], -1))

    parts = {
        "encoding": lambda: [positional_encoding(x, settings.position_frequencies) for x in points],
        "coarse network and its encoding": partial(model.coarse, points[0], rays.directions),
        "fine network and its encoding": partial(model.fine, points[1], rays.directions),
        "fine sampling": sample,
        "fine compositing": partial(composite, sigma, colour, union, BACKGROUND),
    }
    with torch.no_grad():
        whole, *times = seconds(partial(forward, model, rays), *parts.values())
    print(f"forward pass of {count} rays: {1e3 * whole:.1f} ms, of which")
    for name, part in zip(parts, times, strict=True):
        print(f"  {name:32s} {100 * part / whole:5.1f} %")


def print_floor(model: VanillaNerf, count: int) -> None:
    """The share of the time that the matrix products alone would take."""
    rays = random_rays(count)
    for run in (forward, forward_and_backward):
        floor, whole = seconds(products(model, count, run is forward_and_backward), partial(run, model, rays))
        print(f"{run.__name__}: products alone {count / floor:.0f} rays/s, reached {100 * floor / whole:.0f} % of it")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=PRESETS, default="small")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    add_out(parser)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    model = VanillaNerf(PRESETS[options.preset], seed=0)
    print(f"{options.preset}, {options.threads} threads, torch {torch.__version__}")
    print_rates(model, (128, 256, 1024, 4096) if options.preset == "small" else (16, 64, 256), Record(options.out))
    count = 256 if options.preset == "small" else 32
    print_parts(model, count)
    print_floor(model, count)


if __name__ == "__main__":
    main()
