"""The method's own ablation (Mildenhall et al. 2020, table 2) at reduced width: what each of its parts is worth.

    python -m benchmarks.vanilla_ablation ../shared/data/lego_400 --workspace /tmp/ablation.nerf

Trains the complete method, and the method without view dependence, without positional encoding and without
hierarchical sampling, for the same number of steps with several seeds, in one workspace: interrupted, it goes on where
it stopped. Prints held-out PSNR and SSIM, the difference to the complete method seed by seed, and writes a sheet of
pictures beside the workspace.
"""

import argparse
import statistics
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.record import Record, add_out
from pipeline.cli.options import settings_from, with_source
from pipeline.cli.terminal import PlainDisplay
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.workspace import Workspace
from stages.io.files import read_json

VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "complete": {},
    "no view dependence": {"force": {"view_dependence": "off"}},
    "no positional encoding": {"vanilla": {"positional_encoding": False}},
    "no hierarchical sampling": {"vanilla": {"hierarchical": False}},
}
AS_PUBLISHED = {"exposure": "off", "view_dependence": "on", "pose_refinement": "off"}
STAGES = ("ingest", "sfm", "normalise", "effects", "train", "evaluate")


def settings_of(photos: Path, variant: str, seed: int, steps: int, downscale: float) -> Settings:
    """The reduced vanilla NeRF (4 layers of 64, 32 + 32 samples) in one variant."""
    chosen = VARIANTS[variant]
    train = {"steps": steps, "seed": seed, "downscale": downscale}
    train |= {"field": "vanilla", "vanilla": chosen.get("vanilla", {})}
    values = {"train": train, "effects": {"force": AS_PUBLISHED | chosen.get("force", {})}}
    return with_source(settings_from(values, "the benchmark"), photos, None)


def score(root: Path, settings: Settings) -> tuple[dict, Path]:
    """Train and evaluate (or find both cached); metrics and the folder of the evaluation."""
    with Workspace(root) as workspace:
        runner = Runner(workspace, settings, PlainDisplay())
        runner.run(STAGES)
        folder = workspace.folder("evaluate", runner.done["evaluate"].key)
    return read_json(folder / "metrics.json"), folder


def table(found: dict[str, list[dict]], out: Path | None) -> None:
    """A row per variant: PSNR, SSIM and the paired difference to the complete method, each mean ± deviation."""
    record = Record(out)
    for variant, metrics in found.items():
        psnr = [m["psnr"] for m in metrics]
        difference = [m["psnr"] - c["psnr"] for m, c in zip(metrics, found["complete"], strict=True)]
        ssim = statistics.mean(m["ssim"] for m in metrics)
        record.add(variant=variant, psnr=spread(psnr), ssim=ssim, difference_db=spread(difference))


def spread(values: list[float]) -> list[float]:
    """Mean and standard deviation over the seeds."""
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return [round(statistics.mean(values), 2), round(deviation, 2)]


def sheet(folders: dict[str, Path], file: Path) -> None:
    """One row per variant: the same four test photos as each of them renders them."""
    rows = []
    for folder in folders.values():
        pictures = [Image.open(p) for p in sorted((folder / "renders").rglob("*.png"))[::6][:4]]
        row = Image.new("RGB", (sum(p.width for p in pictures), pictures[0].height))
        for index, picture in enumerate(pictures):
            row.paste(picture, (index * picture.width, 0))
        rows.append(row)
    whole = Image.new("RGB", (rows[0].width, sum(r.height for r in rows)))
    for index, row in enumerate(rows):
        whole.paste(row, (0, index * row.height))
    whole.save(file)


def main() -> None:
    """Run every variant and seed and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--workspace", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--downscale", type=float, default=4.0)
    add_out(parser)
    given = parser.parse_args()
    found: dict[str, list[dict]] = {variant: [] for variant in VARIANTS}
    folders: dict[str, Path] = {}
    for seed in range(given.seeds):
        for variant in VARIANTS:
            print(f"--- {variant}, seed {seed}", flush=True)
            settings = settings_of(given.photos, variant, seed, given.steps, given.downscale)
            metrics, folders[variant] = score(given.workspace, settings)
            found[variant].append(metrics)
        table(found, given.out)
    sheet(folders, given.workspace.with_suffix(".png"))


if __name__ == "__main__":
    main()
