"""What effects add to a training step, and what those take that are off.

    python -m benchmarks.effect_costs ../shared/data/fox --workspace /tmp/fox.nerf [--seconds 60] [--rounds 60]

Trains the same field with every choice, a step of each in turn, and gives the median of each step's time over that of
the step beside it in which no effect of images is on (as many colours a step everywhere). "off": how much of that step
passes in the identity that stands in place of effects which are off (nerf/effects), where a trainer that knows of no
effects would only take the difference of two colours; so it is a bound from above.
"""

import argparse
import time
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.grid_parts import loaded
from benchmarks.nerfacto import pipeline
from benchmarks.record import Record, add_out
from nerf.effects import NO_EFFECTS
from nerf.geometry.scene import Scene
from nerf.runtime.matmul_precision import use_matmul_precision
from nerf.training.ray_dataset import RayDataset
from nerf.training.trainer import FieldTrainer
from stages.effects.decisions import Decisions
from stages.effects.image_effects import image_effects
from stages.train import Config
from stages.train.fields.field_list import make_trainer

WARM_STEPS = 300
PROGRESS = 0.5  # the learning rate is still whole, steps along rays are short


class Timed:
    """Stands in place of an object and keeps how many seconds pass in each thing it does, on whichever thread."""

    def __init__(self, timed: Any) -> None:
        self.timed = timed
        self.seconds: list[float] = []

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.timed, name)
        if not callable(found):
            return found

        def timed(*given: Any) -> Any:
            began = time.perf_counter()
            made = found(*given)
            self.seconds.append(time.perf_counter() - began)
            return made

        return timed


def arms(
    config: Config, scene: Scene, dataset: RayDataset, decided: Decisions, identity: Timed
) -> dict[str, FieldTrainer]:
    """A trainer for each choice; ``identity`` stands in the first one."""
    views = scene.of_split("train")
    gains = decided.on.get("exposure", {view.name: [0.0, 0.0, 0.0] for view in views})
    none = decided.having("view_dependence").without("pose_refinement").without("exposure")
    choices = {
        "exposure": none.having("exposure", gains),
        "pose refinement": none.having("pose_refinement"),
        "both": none.having("exposure", gains).having("pose_refinement"),
        "no view dependence": none.without("view_dependence"),
    }

    def trainer(decisions: Decisions, effects: Any) -> FieldTrainer:
        of_choice = config.model_copy(update={"view_dependence": "view_dependence" in decisions.on})
        return make_trainer(of_choice, scene, dataset, config.seed, effects)

    return {"off": trainer(none, identity)} | {
        name: trainer(each, image_effects(each, scene, views, dataset)) for name, each in choices.items()
    }


def main() -> None:
    """Time every choice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--workspace", type=Path, required=True, help="made if it is not there")
    parser.add_argument("--seconds", type=float, default=60.0, help="of training that sizes are for")
    parser.add_argument("--rounds", type=int, default=60, help="steps of each choice that are timed")
    add_out(parser)
    given = parser.parse_args()
    workspace = given.workspace.absolute()
    pipeline("run", given.photos.absolute(), "-o", workspace, "--until", "effects")
    config, scene, dataset, decided = loaded(workspace, Config(seconds=given.seconds))
    identity = Timed(NO_EFFECTS)
    trainers = arms(config, scene, dataset, decided, identity)
    seconds: dict[str, list[float]] = {name: [] for name in trainers}
    with use_matmul_precision(config.matmul):
        for each in trainers.values():
            for step in range(WARM_STEPS):
                each.step(step, PROGRESS, 1.0)
        identity.seconds.clear()
        for step in range(WARM_STEPS, WARM_STEPS + given.rounds):
            for name, each in trainers.items():
                began = time.perf_counter()
                each.step(step, PROGRESS, 1.0)
                seconds[name].append(time.perf_counter() - began)
    off = seconds.pop("off")
    share = sum(identity.seconds) / sum(off)
    more = {name: median(a / b for a, b in zip(mine, off, strict=True)) - 1 for name, mine in seconds.items()}
    percent = {f"{name.replace(' ', '_')}_percent": round(100 * value, 1) for name, value in more.items()}
    Record(given.out).add(**percent, all_off_percent=round(100 * share, 2), step_ms=round(1e3 * median(off)))


if __name__ == "__main__":
    main()
