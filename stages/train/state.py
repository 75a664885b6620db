"""What a training run is given and what it keeps: budget, evaluation sets, state, speed, log."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.contract import StageError

if TYPE_CHECKING:
    from nerf.training.evaluation_pixels import EvaluationPixels
    from stages.train.validation_images import HeldOutEvaluation, Target

SPEED_AVERAGING_SECONDS = 5.0  # of the speed and the batch PSNR that are shown
# Between checkpoints, at most; of a run in seconds a twentieth of them, but saving takes no more than a hundredth.
CHECKPOINT_SECONDS, CHECKPOINT_FRACTION, MAX_SAVING_FRACTION = 30.0, 0.05, 0.01
MAX_STEP_SLOWDOWN = 3.0  # a longer step counts as so many mean ones: a machine that sleeps is not slower


class TrainingBudget(NamedTuple):
    """How long to train: exactly one of the first two is given. Seconds count training steps alone. ``after``: the
    folder of a finished run to continue; the budget is then for the additional steps."""

    steps: int | None
    seconds: float | None
    after: Path | None = None


class EvaluationSets(NamedTuple):
    """Fixed pixels to evaluate on: of training photos (health checks), of ``test`` photos (reported, deciding nothing;
    None without any), and of validation photos with a ``target`` at which to stop."""

    train: "EvaluationPixels"
    test: "HeldOutEvaluation | None" = None
    target: "Target | None" = None


@dataclass
class RunState:
    """What a checkpoint keeps beside the tensors. ``seconds``, ``rays`` and ``colour_evaluations`` include steps that
    were rolled back, and those of the finished run that this one continues."""

    step: int = 0
    seconds: float = 0.0
    rays: int = 0
    colour_evaluations: int = 0
    restarts: int = 0
    rollbacks: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    validation_psnr: float | None = None
    steps_before: int = 0  # of the finished run that this one continues
    seconds_before: float = 0.0
    validation_before: float | None = None
    timings: dict[str, Any] = field(default_factory=dict)
    failure_reason: str | None = None  # of an undertrained field

    def restarted(self, restarts: int, rollbacks: int) -> "RunState":
        """The state of a restarted run with fresh weights: it keeps only what was spent, and what was before."""
        names = ("seconds", "rays", "colour_evaluations", "steps_before", "seconds_before", "validation_before")
        return RunState(restarts=restarts, rollbacks=rollbacks, **{name: getattr(self, name) for name in names})

    def pending_target(self, psnr: float | None) -> float | None:
        """The target, unless the finished run that this one continues has reached it: more was asked for since."""
        reached = psnr is not None and self.validation_before is not None and self.validation_before >= psnr
        return None if reached else psnr


def checkpoint_interval(budget: TrainingBudget, cost: float) -> float:
    """Seconds until the next checkpoint by default; the last one took ``cost`` seconds."""
    wanted = CHECKPOINT_SECONDS if budget.seconds is None else CHECKPOINT_FRACTION * budget.seconds
    return min(CHECKPOINT_SECONDS, max(wanted, cost / MAX_SAVING_FRACTION))


def lost_seconds(elapsed_file: Path, state: RunState) -> float:
    """The seconds that a killed run trained after ``state``, by its ``elapsed_file``; 0 if that cannot be read."""
    try:
        return max(0.0, float(elapsed_file.read_text()) - state.seconds)
    except (OSError, ValueError):
        return 0.0


class TrainingSpeed:
    """Moving averages of a run's speed and batch PSNR over a few seconds. Shown, and used for the schedule.

    The first step of a process also fills caches and loads libraries: it counts only until there is a second one.
    """

    def __init__(self) -> None:
        self.count, self.seconds_per_step, self.rays_per_step, self.psnr = 0, 0.0, 0.0, 0.0

    def add(self, seconds: float, rays: int, psnr: float) -> None:
        """Add one step."""
        self.count += 1
        if self.count > 2:
            seconds = min(seconds, MAX_STEP_SLOWDOWN * self.seconds_per_step)
        new = max(1 / max(1, self.count - 1), 1 - math.exp(-seconds / SPEED_AVERAGING_SECONDS))
        self.seconds_per_step += new * (seconds - self.seconds_per_step)
        self.rays_per_step += new * (rays - self.rays_per_step)
        self.psnr += new * (psnr - self.psnr)


class TrainingLog:
    """Appends events to ``log.jsonl`` in the stage's folder, one JSON object a line."""

    def __init__(self, folder: Path, tensorboard: bool) -> None:
        self.path = folder / "log.jsonl"
        self.board = _board(folder / "tensorboard") if tensorboard else None

    def event(self, kind: str, step: int, **values: Any) -> None:
        """Log that ``kind`` happened before ``step``."""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"event": kind, "step": step, **values}) + "\n")

    def point(self, point: dict[str, Any]) -> None:
        """Log one point of the curve."""
        self.event("evaluated", **point)
        if self.board is not None:
            for name in ("train_psnr", "probe_psnr", "probe_ssim"):
                if point[name] is not None:
                    self.board.add_scalar(name, point[name], point["step"])
            self.board.flush()


def _board(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        why = "the tensorboard package is not installed"
        hint = "Install it with `pip install tensorboard`, or leave out --train.tensorboard."
        raise StageError("train.no-tensorboard", "cannot write TensorBoard files", why, hint) from error
    return SummaryWriter(str(folder))
