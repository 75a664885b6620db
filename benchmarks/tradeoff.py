"""The studies in the documentation: runs `pipeline tradeoff` on photo sets and writes plots and tables into docs/.

    nice python -m benchmarks.tradeoff ../shared/data lego_400 fox --budget 30m --workspaces /tmp/studies

Writes docs/images/tradeoff_SET.png and ablation_SET.png, and recommendation and table of each set into docs/numbers.md,
in place of what is between its two marks. Every set is trained as by default first: that field is a point, too.
Run it on an idle machine. Interrupted, the same command goes on where it stopped.
"""

import argparse
from pathlib import Path

from pipeline.cli.display import PlainDisplay
from pipeline.cli.durations import seconds_from
from pipeline.cli.settings import with_source
from pipeline.engine import machine
from pipeline.engine.runner import Runner
from pipeline.engine.settings import Settings
from pipeline.engine.stage_list import needed_for
from pipeline.engine.workspace import Workspace
from stages.tradeoff import Config

DOCS = Path(__file__).parents[1] / "docs"
FIRST_MARK, LAST_MARK = "<!-- studies -->\n", "<!-- end of studies -->"


def study(photos: Path, root: Path, seconds: float) -> Path:
    """The folder of a finished study of ``photos`` in the workspace ``root``."""
    settings = with_source(Settings(tradeoff=Config(seconds=seconds)), photos, None)
    with Workspace(root) as workspace:
        runner = Runner(workspace, settings, PlainDisplay())
        runner.run([*needed_for("train"), "tradeoff"])  # so that the field of a default run is among the points
        return workspace.folder("tradeoff", runner.done["tradeoff"].key)


def documented(name: str, folder: Path) -> str:
    """Copies a study's pictures into docs/images; its section of docs/numbers.md."""
    lines = [
        f"### A study of {name}",
        "",
        f"![quality against training time of {name}](images/tradeoff_{name}.png)",
        "",
    ]
    (DOCS / "images" / f"tradeoff_{name}.png").write_bytes((folder / "tradeoff.png").read_bytes())
    if (folder / "ablation.png").exists():
        (DOCS / "images" / f"ablation_{name}.png").write_bytes((folder / "ablation.png").read_bytes())
        lines += [f"![the method and its ablations on {name}](images/ablation_{name}.png)", ""]
    return "\n".join([*lines, (folder / "tradeoff.md").read_text("utf-8")])


def main() -> None:
    """Study every set and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the folder of the sets")
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--budget", default="30m")
    parser.add_argument("--workspaces", type=Path, required=True)
    given = parser.parse_args()
    seconds = seconds_from(given.budget)
    facts = machine.facts()
    where = f"{facts['cores']} cores, {facts['gpu'] or 'no GPU'}, torch {facts['torch']}; {given.budget} each."
    sections = [
        documented(name, study(given.data / name, given.workspaces / f"{name}.nerf", seconds)) for name in given.sets
    ]
    page = DOCS / "numbers.md"
    before, rest = page.read_text("utf-8").split(FIRST_MARK)
    after = rest.split(LAST_MARK)[1]
    page.write_text(before + FIRST_MARK + "\n".join([where, "", *sections]) + LAST_MARK + after, "utf-8")


if __name__ == "__main__":
    main()
