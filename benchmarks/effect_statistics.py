"""What stage effects measures on real sets: a row for each effect, a column for each set.

    python -m benchmarks.effect_statistics ../shared/data fox fern --workspaces /tmp/effects

Bold: the effect is on, or flagged.
"""

import argparse
from pathlib import Path

from benchmarks.nerfacto import pipeline, stage_folder
from benchmarks.record import Record, add_out
from stages.io.files import read_json


def main() -> None:
    """Run stage effects on every set and record its statistics."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the folder of the sets")
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--workspaces", type=Path, required=True)
    add_out(parser)
    given = parser.parse_args()
    tables = {}
    for name in given.sets:
        workspace = (given.workspaces / f"{name}.nerf").absolute()
        pipeline("run", (given.data / name).absolute(), "-o", workspace, "--until", "effects")
        tables[name] = read_json(stage_folder(workspace, "effects.json") / "effects.json")
    record = Record(given.out)
    for effect, first in tables[given.sets[0]].items():
        row = {}
        for name, table in tables.items():
            value = table[effect]["statistic"]
            shown = None if value is None else f"{value:.3g}"
            row[name] = f"**{shown}**" if shown and table[effect]["on"] else shown
        record.add(effect=effect.replace("_", " "), on_from=first["threshold"], **row)


if __name__ == "__main__":
    main()
