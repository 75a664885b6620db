"""What several processes that train one field bring each other, and whether it is the field that one trains.

    python -m benchmarks.data_parallel WORKSPACE … [--devices 1 2] [--steps 500] [--seeds 0 1 2]

Each line is `pipeline train WORKSPACE --train.steps N --train.devices D` from the start, and `pipeline evaluate`; each
workspace has its stages up to effects. ``same_field``: whether the field has the bytes of the one that the first number
of devices trained with the same seed. ``received_bytes_per_step`` come to each process; ``exchange_percent`` is the
share of a step in which rank 0 sends, receives or waits. On one CPU processes share the cores that one process has, so
seconds tell what the exchange costs there, not what more devices gain.
"""

import argparse
from hashlib import sha256
from pathlib import Path
from typing import Any

from benchmarks.nerfacto import pipeline, stage_folder
from benchmarks.record import Record, add_out
from stages.io.files import read_json


def train(workspace: Path, steps: int, devices: int, seed: int) -> tuple[str, dict[str, Any]]:
    """The digest of the field, and the figures of its training."""
    options = {"steps": steps, "devices": devices, "seed": seed}
    pipeline("train", workspace, *(f"--train.{name}={value}" for name, value in options.items()), "--force")
    pipeline("evaluate", workspace)
    folder = stage_folder(workspace, "curve.json")
    facts, metrics = read_json(folder / "manifest.json")["facts"], read_json(workspace / "output" / "metrics.json")
    share = facts.get("exchange_share")
    return sha256((folder / "field.safetensors").read_bytes()).hexdigest(), {
        "psnr": round(metrics["psnr"], 3),
        "train_seconds": facts["train_seconds"],
        "table_gradient": facts["ranks"]["table_gradient"] if "ranks" in facts else None,
        "received_bytes_per_step": facts.get("received_bytes_per_step"),
        "exchange_percent": None if share is None else round(100 * share, 1),
    }


def main() -> None:
    """All workspaces, seeds and numbers of devices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for workspace in given.workspaces:
        for seed in given.seeds:
            first = None
            for devices in given.devices:
                digest, figures = train(workspace, given.steps, devices, seed)
                first = first or digest
                run = {"set": workspace.stem, "steps": given.steps, "seed": seed, "devices": devices}
                record.add(**run, **figures, same_field="yes" if digest == first else "no")


if __name__ == "__main__":
    main()
