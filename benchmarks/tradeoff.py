"""A study for the documentation: runs `pipeline tradeoff` on a photo set and records its points.

    nice python -m benchmarks.tradeoff ../shared/data/fox --budget 30m --workspace /tmp/fox.nerf \
        --out benchmarks/results/tradeoff_fox.json

With ``--out`` its plots become docs/images/tradeoff_SET.png and ablation_SET.png. The set is trained as by default
first: that field is a point, too. Run it on an idle machine. Interrupted, the same command goes on where it stopped.
"""

import argparse
from pathlib import Path

from benchmarks.record import Record, add_out
from pipeline.cli.durations import seconds_from
from pipeline.cli.options import with_source
from pipeline.cli.terminal import PlainDisplay
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import needed_for
from pipeline.engine.workspace import Workspace
from stages.io.amounts import resolution_name
from stages.io.files import read_json
from stages.tradeoff import Config

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def study(photos: Path, root: Path, seconds: float) -> Path:
    """The folder of a finished study of ``photos`` in the workspace ``root``."""
    settings = with_source(Settings(tradeoff=Config(seconds=seconds)), photos, None)
    with Workspace(root) as workspace:
        runner = Runner(workspace, settings, PlainDisplay())
        trained = needed_for("train", runner.options)  # so that the field of a default run is among the points
        runner.run([*trained, "tradeoff"])
        return workspace.folder("tradeoff", runner.done["tradeoff"].key)


def main() -> None:
    """Study the set and record its points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--budget", default="30m")
    parser.add_argument("--workspace", type=Path, required=True)
    add_out(parser)
    given = parser.parse_args()
    folder, record = study(given.photos, given.workspace, seconds_from(given.budget)), Record(given.out)
    for point in read_json(folder / "tradeoff.json")["points"]:
        record.add(
            field=point["variant"],
            photos=resolution_name(point["downscale"]),
            **{key: point[key] for key in ("steps", "train_seconds", "frame_seconds")},
            memory=point["peak_memory_mb"] and f"{point['peak_memory_mb']:,.0f} MB",
            model=f"{point['model_mb']:.1f} MB",
            psnr=point["psnr"] if point["psnr_std"] is None else [point["psnr"], point["psnr_std"]],
            ssim=point["ssim"] if point["ssim_std"] is None else [point["ssim"], point["ssim_std"]],
            seeds=point["seeds"],
            front=point["pareto_front"],
        )
    if given.out:
        for plot in folder.glob("*.png"):
            (IMAGES / f"{plot.stem}_{given.photos.name}.png").write_bytes(plot.read_bytes())


if __name__ == "__main__":
    main()
