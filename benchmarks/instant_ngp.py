"""Instant-ngp as in nerfacc's example, on photos in the format of Blender: test PSNR by seconds of training.

    git clone https://github.com/nerfstudio-project/nerfacc
    python -m benchmarks.instant_ngp ../shared/data/lego_400 --examples nerfacc/examples --seconds 10 30 60 [--out JSON]

Needs a GPU, nerfacc, tiny-cuda-nn's extension for torch and imageio; nothing is installed. Beside it stands
``benchmarks.gpu_field`` on the same photos.

The same for both: the photos and their cameras, all test photos on white at the trained size, PSNR as the mean of each
one's own. Training starts afresh for each number of seconds, with a schedule of that length. The first steps, which
load kernels, and the evaluation are not counted.

The radiance field, the reader of the photos and the renderer are the modules of the example; nerfacc's occupancy grid
tells where samples are. The loop is that of its ``train_ngp_nerf_occ.py`` with the settings for synthetic scenes: 2^18
samples a step, a white background, Adam, smooth L1 loss. Of its 20,000 steps the learning rate falls after 1/2, 3/4 and
9/10; here it falls after these shares of the seconds.
"""

import argparse
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch.nn import functional

from benchmarks.record import Record, add_out

HALF_WIDTH = 1.5  # of the box, from the origin
GRID_RESOLUTION, RENDER_STEP_SIZE, OCCUPANCY_THRESHOLD = 128, 5e-3, 1e-2
TARGET_SAMPLES, FIRST_RAYS = 1 << 18, 1024  # of a step; rays follow from the samples of the step before
LEARNING_RATE, EPS, WEIGHT_DECAY, LOSS_SCALE = 1e-2, 1e-15, 1e-6, 2.0**10
RISING_STEPS, MILESTONES, DECAY = 100, (1 / 2, 3 / 4, 9 / 10), 0.33  # of the learning rate
WARMUP_STEPS, SEED = 30, 42


def read_photos(data: Path, split: str, rays: int | None, device: str) -> Any:
    """The example's reader of a split at the photos' own size, of random ``rays`` or, without them, of whole photos."""
    width, height = Image.open(next((data / split).glob("*.png"))).size
    reader = import_module("datasets.nerf_synthetic").SubjectLoader
    own = type("Reader", (reader,), {"SUBJECT_IDS": [data.name], "WIDTH": width, "HEIGHT": height})
    return own(subject_id=data.name, root_fp=str(data.parent), split=split, num_rays=rays, device=device)


def learning_rate(step: int, share: float) -> float:
    """Of a step, when so large a share of the seconds is spent."""
    rise = min(1.0, 0.01 + 0.99 * step / RISING_STEPS)
    return LEARNING_RATE * rise * DECAY ** sum(share >= milestone for milestone in MILESTONES)


class InstantNgp:
    """A fresh radiance field with its occupancy grid and optimizer."""

    def __init__(self, device: str) -> None:
        box = torch.tensor([-HALF_WIDTH] * 3 + [HALF_WIDTH] * 3, device=device)
        estimator = import_module("nerfacc.estimators.occ_grid").OccGridEstimator
        self.grid = estimator(roi_aabb=box, resolution=GRID_RESOLUTION, levels=1).to(device)
        self.field = import_module("radiance_fields.ngp").NGPRadianceField(aabb=self.grid.aabbs[-1]).to(device)
        parameters = self.field.parameters()
        self.optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE, eps=EPS, weight_decay=WEIGHT_DECAY)

    def render(self, rays: Any, background: torch.Tensor) -> tuple[torch.Tensor, int]:
        """Colours of rays, and how many samples they took."""
        render = import_module("utils").render_image_with_occgrid
        options = {"near_plane": 0.0, "render_step_size": RENDER_STEP_SIZE, "render_bkgd": background}
        colours, _, _, samples = render(self.field, self.grid, rays, **options)
        return colours, samples

    def step(self, photos: Any, step: int, share: float) -> int:
        """Train on a batch of rays; how many."""
        self.field.train()
        self.grid.train()
        batch = photos[0]  # of all photos, whatever the index
        self.grid.update_every_n_steps(
            step=step,
            occ_eval_fn=lambda points: self.field.query_density(points) * RENDER_STEP_SIZE,
            occ_thre=OCCUPANCY_THRESHOLD,
        )
        colours, samples = self.render(batch["rays"], batch["color_bkgd"])
        rays = len(batch["pixels"])
        if not samples:
            return rays
        photos.update_num_rays(int(rays * TARGET_SAMPLES / samples))
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(step, share)
        self.optimizer.zero_grad()
        (LOSS_SCALE * functional.smooth_l1_loss(colours, batch["pixels"])).backward()  # Adam divides by the scale
        self.optimizer.step()
        return rays


def wait_for(device: str) -> None:
    """Until all that a GPU was asked for is computed."""
    if device != "cpu":
        torch.cuda.synchronize()


def train(model: InstantNgp, photos: Any, seconds: float, device: str) -> dict[str, float]:
    """Train for so many seconds; seconds, steps and rays."""
    for step in range(WARMUP_STEPS):
        model.step(photos, step, 0.0)
    wait_for(device)
    started, step, rays = time.perf_counter(), WARMUP_STEPS, 0
    while (elapsed := time.perf_counter() - started) < seconds:
        rays += model.step(photos, step, elapsed / seconds)
        step += 1
    wait_for(device)
    elapsed, steps = time.perf_counter() - started, step - WARMUP_STEPS
    return {
        "train_seconds": round(elapsed, 2),
        "steps": steps,
        "step_ms": round(1000 * elapsed / steps, 2),
        "rays": rays,
        "rays_per_second": round(rays / elapsed),
    }


@torch.no_grad()
def score(model: InstantNgp, photos: Any, device: str) -> dict[str, float]:
    """Mean PSNR (dB) of whole photos, and the seconds that one takes."""
    model.field.eval()
    model.grid.eval()
    started, values = time.perf_counter(), []
    for photo in range(len(photos)):
        truth = photos[photo]
        colours, _ = model.render(truth["rays"], truth["color_bkgd"])
        values.append(-10 * torch.log10(functional.mse_loss(colours, truth["pixels"])).item())
    wait_for(device)
    seconds = time.perf_counter() - started
    return {"psnr": round(sum(values) / len(values), 2), "frame_ms": round(1000 * seconds / len(values), 1)}


def run(given: argparse.Namespace) -> None:
    sys.path.insert(0, str(given.examples.absolute()))
    record, data = Record(given.out), given.data.absolute()
    test = read_photos(data, "test", None, given.device)
    for seconds in given.seconds:
        import_module("utils").set_random_seed(SEED)
        photos, model = read_photos(data, "train", FIRST_RAYS, given.device), InstantNgp(given.device)
        trained = train(model, photos, seconds, given.device)
        record.add(set=data.name, method="instant-ngp", **score(model, test, given.device), **trained)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with transforms_train.json and transforms_test.json")
    parser.add_argument("--examples", type=Path, required=True, help="folder of nerfacc's examples")
    parser.add_argument("--seconds", type=float, nargs="+", default=[10.0], help="of training")
    parser.add_argument("--device", default="cuda")
    add_out(parser)
    run(parser.parse_args())


if __name__ == "__main__":
    main()
