"""Whether stage effects decides right on synthetic scenes, and what the effects that are called for gain.

    python -m benchmarks.effects_matrix [--seeds 5] [--gain-steps 600] [--only exposure …]

Every row is a kind of photos of the demo's still life (24 photos of 240 × 180, exact tracks); every seed another still
life, walk and draw of the effect. "right": in how many seeds exactly the effects named were on, view dependence aside,
which is counted by itself. "gain": right halves of validation photos, with the effect against without, after
--gain-steps steps, mean over three trainings of the first seed; of the background only on plain photos, where nothing
else is at stake.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.record import Record, add_out
from nerf.runtime.parallel import take_over_cores
from stages import effects
from stages.contract import SilentProgress, run_stage
from stages.effects.ab_runs import pilot_scene, run_pilot
from stages.effects.decisions import Decisions, read_decisions
from stages.io.files import read_scene
from tests.effect_scenes import Effects, effect_scene


class Cell(NamedTuple):
    """Photos, which effects they call for, and which are only seen."""

    made: Effects
    on: frozenset[str]
    seen: frozenset[str] = frozenset()


def cell(made: Effects, on: str = "", seen: str = "") -> Cell:
    """Names separated by spaces."""
    return Cell(made, frozenset(on.split()), frozenset(seen.split()))


MIRROR = 3.0  # times white: a mirrored sun is brighter than anything that is lit by it

CELLS = {
    "plain": cell(Effects(), "background"),
    "exposure": cell(Effects(exposure_ev=1.0), "background exposure"),
    "highlights": cell(Effects(highlight=MIRROR), "background"),
    "alpha": cell(Effects(alpha=True)),
    "poses, 1 px": cell(Effects(jitter_px=1.0), "background pose_refinement"),
    "poses, 3 px": cell(Effects(jitter_px=3.0), "background pose_refinement"),
    "poses, 5 px": cell(Effects(jitter_px=5.0), "background pose_refinement"),
    "exposure, alpha": cell(Effects(exposure_ev=1.0, alpha=True), "exposure"),
    "exposure, highlights": cell(Effects(exposure_ev=1.0, highlight=MIRROR), "background exposure"),
    "exposure, poses": cell(Effects(exposure_ev=1.0, jitter_px=3.0), "background exposure pose_refinement"),
    "highlights, alpha": cell(Effects(highlight=MIRROR, alpha=True)),
    "highlights, poses": cell(Effects(highlight=MIRROR, jitter_px=3.0), "background pose_refinement"),
    "poses, alpha": cell(Effects(jitter_px=3.0, alpha=True), "pose_refinement"),
    "vignetting": cell(Effects(vignetting_ev=1.0), "background vignetting"),
    "exposure, vignetting": cell(Effects(exposure_ev=1.0, vignetting_ev=1.0), "background exposure vignetting"),
    "vignetting, 0.3 EV": cell(Effects(vignetting_ev=0.3), "background"),
    "exposure, vignetting, 0.3 EV": cell(Effects(exposure_ev=1.0, vignetting_ev=0.3), "background exposure"),
    "passers-by": cell(Effects(strangers=0.15), "background", "transients"),
    "4 × distance": cell(Effects(farther=4.0), "background", "scale_variation"),
}


class Outcome(NamedTuple):
    """What the stage decided, where its inputs are, and what photos they were made of."""

    decisions: Decisions
    table: dict
    inputs: dict[str, Path]
    made: Effects

    @property
    def on(self) -> set[str]:
        """The modelled effects that are on, camera model and view dependence aside."""
        aside = ("camera_model", "view_dependence")
        return {name for name, entry in self.table.items() if entry["on"] and entry["modelled"] and name not in aside}


def decide(folder: Path, made: Effects, seed: int) -> Outcome:
    """Make the photos and run the stage on them."""
    inputs, out = effect_scene(folder / "scene", made, seed), folder / "effects"
    out.mkdir()
    run_stage(effects.STAGE, effects.Config(seed=seed), inputs, out, SilentProgress())
    return Outcome(read_decisions(out), json.loads((out / "effects.json").read_text("utf-8")), inputs, made)


def gains(found: Outcome, wanted: Cell, steps: int) -> str:
    """What each effect that a scene calls for gains over leaving it out, in dB."""
    trial = pilot_scene(found.inputs, read_scene(found.inputs["normalise"]), SilentProgress())
    assert not isinstance(trial, str), trial
    called_for = (wanted.on & found.on) | ({"view_dependence"} if wanted.made.highlight else set())
    tried, parts = ["exposure", "pose_refinement", "vignetting", "view_dependence"], []
    if found.made == Effects():
        tried.append("background")
    for name in tried:
        if name in called_for:
            pilot = run_pilot(trial, found.decisions.without(name), found.decisions, steps, 0, SilentProgress())
            parts.append(f"{name} {pilot.gain_db:+.2f} ± {pilot.noise_db:.2f}, {pilot.cost:+.0%} time")
    return "; ".join(parts)


def figures(name: str, seeds: int, steps: int) -> dict[str, Any]:
    """The row of the table."""
    wanted, right, depends, seen, wrong, gain = CELLS[name], 0, 0, 0, [], ""
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            found = decide(Path(folder), wanted.made, seed)
            right += found.on == wanted.on
            wrong += [f"seed {seed}: {' '.join(sorted(found.on ^ wanted.on))}"] if found.on != wanted.on else []
            depends += found.table["view_dependence"]["on"]
            seen += all(found.table[flag]["on"] for flag in wanted.seen)
            if seed == 0:
                gain = gains(found, wanted, steps)
    return {
        "photos": name,
        "single": len(wanted.on - {"background"}) <= 1 and not (wanted.made.alpha and wanted.on),
        "right": f"{right}/{seeds}",
        "flagged": f"{seen}/{seeds}" if wanted.seen else None,
        "gain": gain or None,
        "view_dependence_on": f"{depends}/{seeds}",
        "wrong": ", ".join(wrong) or None,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--gain-steps", type=int, default=600)
    parser.add_argument("--only", nargs="*", default=list(CELLS))
    add_out(parser)
    given = parser.parse_args()
    take_over_cores()  # torch's threads wait for each other: photos are drawn ten times as slowly
    record = Record(given.out)
    for name in given.only:
        record.add(**figures(name, given.seeds, given.gain_steps))


if __name__ == "__main__":
    main()
