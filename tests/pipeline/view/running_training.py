"""A workspace, made up, in which a thread trains a tiny field as stage train does it."""

import os
import threading
import time
import traceback
from pathlib import Path
from typing import Any

import psutil

from nerf.training.trainer import StepResult
from pipeline.engine import manifest_file
from pipeline.engine.manifest_file import Manifest
from pipeline.engine.run_file import RunFile, write
from pipeline.engine.workspace import Workspace
from stages import train
from stages.contract import StageResult, plan_stage
from stages.io.files import write_json
from stages.train import training
from tests.conftest import RecordedProgress
from tests.stages.photo_scene import photographed
from tests.stages.viewer.made_fields import NAMES

KEYS = {
    name: f"{number:064x}"
    for number, name in enumerate(("ingest", "normalise", "effects", "scale", "train", "viewer"), 1)
}
GRID: dict[str, Any] = {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024}
MANY_STEPS = 1_000_000
PAUSE_SECONDS = 0.02  # between steps: it leaves the cores to who looks on, a browser that draws in software


def manifest_of(stage: str, folder: Path, result: StageResult, inputs: dict[str, str] | None = None) -> Manifest:
    """Of ``result`` in ``folder``, made of ``inputs``: the digest of each stage's outputs."""
    outputs, records = (manifest_file.describe_outputs(folder, names) for names in (result.outputs, result.records))
    digest = manifest_file.outputs_digest(outputs)
    return Manifest(stage, 1, KEYS[stage], {}, inputs or {}, outputs, digest, records, result.facts, "", 1.0, "")


class Over(BaseException):
    """The test is."""


class RunningTraining:
    """``root`` is its workspace, which it holds locked as a run does. Photos have names that break careless pages."""

    def __init__(self, folder: Path, steps: int = MANY_STEPS, field: str = "grid") -> None:
        self.root = folder / "w.nerf"
        made, self.scene = photographed(folder / "made", channels=4)
        content = self.scene.to_json()
        for view, name in zip(content["views"][::2], NAMES, strict=False):
            view["name"] = name
        self.inputs = {name: self.root / name / KEYS[name][:16] for name in ("ingest", "normalise", "effects", "scale")}
        for name, finished in self.inputs.items():
            finished.parent.mkdir(parents=True)
            made[name].rename(finished) if name in made else finished.mkdir()
            manifest_file.write(finished, manifest_of(name, finished, StageResult((), "")))
        write_json(self.inputs["normalise"] / "scene.json", content)
        write_json(self.inputs["scale"] / "scale.json", {"metres_per_unit": None})
        write(self.root, RunFile(keys=KEYS))
        self.workspace, self.partial = Workspace(self.root), Workspace(self.root).partial("train", KEYS["train"])
        sizes = {"grid": GRID} if field == "grid" else {"vanilla": {"depth": 2, "width": 16, "batch_rays": 64}}
        self.config = train.Config(downscale=1.0, steps=steps, field=field, checkpoint_seconds=1e3, **sizes)  # pyright: ignore
        self.thread = threading.Thread(target=self._train, daemon=True)
        self.error: BaseException | None = None
        self.over = False

    def __enter__(self) -> "RunningTraining":
        self.workspace.__enter__()
        self.partial.mkdir(parents=True, exist_ok=True)
        self.thread.start()
        return self

    def _train(self) -> None:
        try:
            config = plan_stage(train.STAGE, self.config, self.inputs, RecordedProgress())
            loaded = training.load(config, self.inputs, self.partial, RecordedProgress())
            trainer, step = loaded.run.trainer, loaded.run.trainer.step

            def step_unless_over(number: int, progress: float, lr_scale: float) -> StepResult:
                if self.over:
                    raise Over
                time.sleep(PAUSE_SECONDS)
                return step(number, progress, lr_scale)

            trainer.step = step_unless_over  # pyright: ignore[reportAttributeAccessIssue]
            training.compute(loaded)
            result = training.save(loaded, self.partial, RecordedProgress())
            self._finish("train", self.partial, result, "normalise")
        except BaseException as error:
            self.error = error
            if not isinstance(error, Over):
                traceback.print_exc()

    def _finish(self, stage: str, partial: Path, result: StageResult, of: str) -> None:
        """As the runner does, of the outputs of one other stage."""
        inputs = {of: manifest_file.read(self.workspace.folder(of, KEYS[of])).outputs_digest}
        finished = self.workspace.folder(stage, KEYS[stage])
        self.workspace.finish(partial, finished, manifest_of(stage, partial, result, inputs))

    def make_page(self, text: str) -> None:
        """What stage viewer makes of the finished training."""
        partial = self.workspace.partial("viewer", KEYS["viewer"])
        partial.mkdir(parents=True)
        (partial / "viewer.html").write_text(text)
        self._finish("viewer", partial, StageResult(("viewer.html",), ""), "train")

    def wait(self) -> None:
        """Until it has ended."""
        self.thread.join(120)
        assert not self.thread.is_alive() and self.error is None, self.error

    def __exit__(self, *_: object) -> None:
        self.over = True
        self.thread.join(120)
        self.workspace.__exit__()


def can_reach_other_address() -> str | None:
    """An address of this machine other than those of the loop; None where there is none."""
    addresses = [each.address for of in psutil.net_if_addrs().values() for each in of if each.family.name == "AF_INET"]
    return next((address for address in addresses if not address.startswith("127.")), None)


def quiet_environment() -> dict[str, str]:
    """Without a screen: no browser opens."""
    return {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
