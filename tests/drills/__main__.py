"""The long form of the drills: ``python -m tests.drills --kills 40 --signals 36`` prints what was done and lost."""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.drills.campaigns import Chain, interruptions, kills
from tests.small_scenes import write_blender_scene
from tests.synthetic_photos import write_synthetic_photos

FEW_FEATURES = ("--sfm.max-features", "800")


def main() -> int:
    """Run the drills that were asked for; 1 if anything was lost or not clean."""
    parser = argparse.ArgumentParser(prog="python -m tests.drills", description=__doc__)
    parser.add_argument("--kills", type=int, default=0, help="SIGKILLs, a quarter of them while COLMAP is at work")
    parser.add_argument("--signals", type=int, default=0, help="SIGTERMs and Ctrl-Cs, a quarter of them in COLMAP")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        known = Chain(write_blender_scene(folder / "known"), folder / "known.nerf")
        colmap = Chain(
            write_synthetic_photos(folder / "colmap").folder, folder / "colmap.nerf", FEW_FEATURES, until="normalise"
        )
        for name, campaign, count in (("SIGKILL", kills, given.kills), ("signals", interruptions, given.signals)):
            for words, chain, stages, share in (
                ("cameras known", known, list(known.seconds), count - count // 4),
                ("COLMAP", colmap, ["sfm"], count // 4),
            ):
                if share:
                    tally = campaign(chain, stages, share, given.seed, folder)
                    print(f"{name}, {words}: {tally}", flush=True)
                    bad += len(tally.lost) + len(tally.faults)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
