"""The rays of a workspace, done up to normalise, in one file, which ``benchmarks.gpu_field`` trains on elsewhere.

python -m benchmarks.gpu_dataset WORKSPACE FILE
"""

import argparse
import json
from pathlib import Path

from safetensors.torch import save_file

from pipeline.cli.terminal import PlainDisplay
from stages.io.files import read_scene
from stages.train.data import dataset_with_depths, training_dataset

SHOWN = {"ingest": "images", "normalise": "scene.json"}  # by what output/ links to, the folder of a stage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    folders = {name: (given.workspace / "output" / shown).resolve().parent for name, shown in SHOWN.items()}
    scene = read_scene(folders["normalise"])
    datasets = {
        "train": dataset_with_depths(folders, scene, 1.0, PlainDisplay()),
        "test": training_dataset(folders["ingest"], scene, "test", 1.0, PlainDisplay()),
    }
    tables = {
        f"{split}.{name}": table.contiguous()
        for split, dataset in datasets.items()
        for name, table in dataset._asdict().items()
        if name != "pixels" and table is not None
    }
    views = {split: [view.file for view in scene.of_split(split)] for split in ("train", "test")}
    facts = {"files": views, "alpha": scene.has_alpha, "bounded": scene.bounded}
    save_file(tables, given.file, {"facts": json.dumps(facts)})


if __name__ == "__main__":
    main()
