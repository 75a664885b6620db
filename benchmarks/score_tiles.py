"""What scores of tiles are off by, against those of whole photos: by the size of the tiles and the fraction scored.

    python -m benchmarks.score_tiles WORKSPACE… --out benchmarks/results/score_tiles.json

Each workspace has been evaluated with ``--evaluate.fraction 1``: its renders are compared with the photos again.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import Record, add_out
from nerf.training.metrics import psnr
from stages.evaluate import tiles
from stages.evaluate.image_metrics import ssim
from stages.io.files import read_json
from stages.io.pixels import load_pixels

SIZES, FRACTIONS, CHOICES = (16, 24, 32, 64), (0.02, 0.05, 0.1, 0.25), 40


def pictures(workspace: Path) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Render and photo of every test photo, (H, W, 3) in [0, 1]."""
    output = workspace / "output"
    files = {photo["name"]: photo["file"] for photo in read_json(output / "photos.json")["photos"]}
    found = []
    for image in read_json(output / "metrics.json")["images"]:
        render = load_pixels(output / image["render"], *_size(output / image["render"]))
        photo = load_pixels(output / files[image["name"]], render.shape[1], render.shape[0])[..., :3]
        found.append((torch.from_numpy(render.copy()) / 255, torch.from_numpy(photo.copy()) / 255))
    return found


def _size(file: Path) -> tuple[int, int]:
    from PIL import Image

    with Image.open(file) as image:
        return image.size


def scores(render: torch.Tensor, photo: torch.Tensor, chosen: tiles.Tiles) -> tuple[float, float]:
    """PSNR and SSIM of some tiles."""
    one, other = chosen.cut(render), chosen.cut(photo)
    similarity = ssim(one, other)
    assert similarity is not None
    mask = chosen.mask(*render.shape[:2])
    return psnr(float((render[mask] - photo[mask]).square().mean())), similarity


def main() -> None:
    """Compare tiles of all sizes with whole photos."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for workspace in given.workspaces:
        pairs = pictures(workspace)
        whole = [(psnr(float((a - b).square().mean())), ssim(a, b)) for a, b in pairs]
        for size in SIZES:
            tiles.TILE_SIZE, tiles.MIN_TILES = size, 1
            for fraction in FRACTIONS:
                off = np.array(
                    [
                        np.subtract(scores(*pair, tiles.tiles_of(*pair[0].shape[:2], fraction, number)), truth)
                        for number in range(CHOICES)
                        for pair, truth in zip(pairs, whole, strict=True)
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
