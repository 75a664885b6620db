"""LPIPS (Zhang et al. 2018) between renders of stage evaluate and the photos, where the user has its weights."""

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.renders import read_render_and_photo
from nerf.geometry.scene import Scene
from stages.io.files import read_json

VGG = "vgg16-397923af.pth"  # torchvision's file in torch's cache
Distance = Callable[[Tensor, Tensor], Tensor]


def load_lpips() -> Distance | None:
    """The network of the package lpips; None, with the reason, where something would have to be downloaded."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG
    missing = "the package lpips is not installed" if find_spec("lpips") is None else f"{weights} is not there"
    if find_spec("lpips") is None or not weights.is_file():
        print(f"LPIPS is not computed: {missing}", file=sys.stderr)
        return None
    return import_module("lpips").LPIPS(net="vgg", verbose=False)


def mean_lpips(evaluate: Path, ingest: Path, scene: Scene, distance: Distance | None) -> float | None:
    """Over the test photos at the size of their renders, over the same background. None without a network."""
    if distance is None:
        return None
    background, found = read_json(evaluate / "metrics.json")["background"], []
    with torch.no_grad():
        for view in scene.of_split("test"):
            file = evaluate / "renders" / Path(view.file.removeprefix("images/")).with_suffix(".png")
            render, photo = read_render_and_photo(file, ingest, scene, view, background)
            found.append(float(distance(2 * render - 1, 2 * photo - 1)))
    return round(sum(found) / len(found), 3)
