"""A GPU runs the whole chain, and trains the same field with either backend; skipped by name where there is none."""

from pathlib import Path

import pytest
import torch

from nerf.geometry.rays import Rays, rays_of_view
from nerf.rendering.images import render_image
from nerf.synthetic.scenes import ring_of_cameras
from nerf.training.psnr import mean_squared_error, psnr
from pipeline.cli.commands import run_command
from stages.io.field_files import load_field
from stages.io.files import read_json
from tests.devices import skip_without
from tests.small_scenes import pinhole_directions, write_blender_scene

pytestmark = pytest.mark.gpu
SMALL = "--train.steps 150 --train.downscale 1 --render.frames 4 --render.width 48 --mesh.resolution 40".split()


@pytest.fixture(autouse=True)
def gpu() -> None:
    skip_without("cuda")


def trained(workspace: Path) -> Path:
    """The folder of the training that a workspace shows."""
    return (workspace / "output/curve.json").resolve().parent


def probe_psnr(photos: Path, workspace: Path, *flags: str) -> float:
    assert run_command(["run", str(photos), "-o", str(workspace), "--until", "train", *flags]) == 0
    curve = read_json(trained(workspace) / "curve.json")
    assert curve["device"] == "cuda"
    return curve["points"][-1]["probe_psnr"]


def test_the_chain_on_a_gpu_agrees_with_the_cpu(tmp_path: Path) -> None:
    photos = write_blender_scene(tmp_path / "photos", train=14, test=3)
    assert run_command(["run", str(photos), "-o", str(tmp_path / "w.nerf"), *SMALL]) == 0
    summary = read_json(tmp_path / "w.nerf/output/summary.json")
    assert summary["psnr"] > summary["psnr_mean_image"] > 5 and summary["mesh"]["faces"] > 500
    pose = torch.tensor(ring_of_cameras(5)[0], dtype=torch.float32)
    rays = rays_of_view(pinhole_directions(40, 40, 52.0), pose, 0.5, 10.0)
    pictures = []
    for device in ("cpu", "cuda"):
        model, _ = load_field(trained(tmp_path / "w.nerf"), device)
        seen = render_image(model, Rays(*(part.to(device) for part in rays)), torch.ones(3, device=device))
        pictures.append(seen.colour.cpu())
    assert pictures[0].std() > 0.05
    assert psnr(mean_squared_error(*pictures)) > 45


def test_both_backends_train_lego(shared_data: Path, tmp_path: Path) -> None:
    flags = "--train.steps 200 --train.downscale 2 --train.grid.target-samples 65536".split()
    if not (photos := shared_data / "lego_400").is_dir():
        pytest.skip(f"no photos at {photos}")
    by_torch, by_warp = (
        probe_psnr(photos, tmp_path / f"{name}.nerf", *flags, "--train.grid.backend", name)
        for name in ("torch", "warp")
    )
    assert min(by_torch, by_warp) > 22
    assert abs(by_torch - by_warp) < 0.5
