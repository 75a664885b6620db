"""What scores of tiles are off by, against those of whole photos: by the size of the tiles and the fraction scored.

    python -m benchmarks.score_tiles WORKSPACE… --out benchmarks/results/score_tiles.json

Each workspace has been evaluated with ``--evaluate.fraction 1``: its renders are compared with the photos again.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.metrics import ssim

from benchmarks.record import Record, add_out
from benchmarks.renders import read_render_and_photo
from nerf.training.psnr import psnr
from stages.evaluate import tiles
from stages.evaluate.image_metrics import SSIM_WINDOW
from stages.io.files import read_json, read_scene

SIZES, FRACTIONS, CHOICES = (16, 24, 32, 64), (0.02, 0.05, 0.1, 0.25), 40


class Maps(NamedTuple):
    """Of a test photo: squared error and structural similarity, (height, width), that of a window at its upper left
    pixel."""

    error: torch.Tensor
    similarity: torch.Tensor


def maps(workspace: Path) -> list[Maps]:
    """Of every test photo."""
    output, found = workspace / "output", []
    scene, metrics = read_scene(output), read_json(output / "metrics.json")
    views = {view.name: view for view in scene.views}
    for image in metrics["images"]:
        given = output, scene, views[image["name"]], metrics["background"]
        one, other = read_render_and_photo(output / image["render"], *given)
        similarity = ssim(one, other, SSIM_WINDOW, eps=0.0, padding="valid")[0].mean(0)
        found.append(Maps((one - other)[0].square().mean(0), similarity))
    return found


def scores(of: Maps, chosen: tiles.Tiles) -> tuple[float, float]:
    """PSNR and SSIM of some tiles."""
    inside = tuple(length - SSIM_WINDOW + 1 for length in chosen.size)
    error = chosen.cut(of.error).mean()
    return psnr(float(error)), float(chosen._replace(size=inside).cut(of.similarity).mean())


def main() -> None:
    """Compare tiles of all sizes with whole photos."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for workspace in given.workspaces:
        photos = maps(workspace)
        whole = [(psnr(float(each.error.mean())), float(each.similarity.mean())) for each in photos]
        for size in SIZES:
            tiles.TILE_SIZE, tiles.MIN_TILES = size, 1
            for fraction in FRACTIONS:
                off = np.array(
                    [
                        np.subtract(scores(each, tiles.tiles_of(height, width, fraction, number)), truth)
                        for number in range(CHOICES)
                        for each, truth in zip(photos, whole, strict=True)
                        for height, width in [each.error.shape]
                    ]
                )
                psnr_off, ssim_off = np.sqrt((off**2).mean(0))
                record.add(
                    set=workspace.stem,
                    tile=f"{size} × {size}",
                    fraction=fraction,
                    psnr_off_db=round(float(psnr_off), 2),
                    psnr_bias_db=round(float(off[:, 0].mean()), 2),
                    ssim_off=round(float(ssim_off), 4),
                )


if __name__ == "__main__":
    main()
