"""What a training run is given and what it keeps: budget, probes, state, pace, log."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stages.contract import StageError

if TYPE_CHECKING:
    from nerf.training.validation_probe import Probe
    from stages.train.validation_images import Target, Unseen

RATE_MEMORY_SECONDS = 5.0  # how far back the measured speed and the shown PSNR look
# Between checkpoints: at most this. Of a run in seconds a twentieth of them, if saving takes no more than a hundredth.
CHECKPOINT_SECONDS, CHECKPOINT_SHARE, MAX_SAVING = 30.0, 0.05, 0.01
MAX_OF_A_STALL = 3.0  # of the pace: as much of a longer step counts. A machine that sleeps for seconds is not slower


class TrainingBudget(NamedTuple):
    """How long to train: exactly one of the first two is given. Seconds count training steps alone. ``after``: the
    folder of a finished run from whose end to go on; the budget is then for what comes on top."""

    steps: int | None
    seconds: float | None
    after: Path | None = None


class Probes(NamedTuple):
    """Fixed pixels to measure on; ``test`` is None without test photos, is reported and decides nothing. A
    ``target`` decides when to stop."""

    train: "Probe"
    test: "Unseen | None" = None
    target: "Target | None" = None


@dataclass
class RunState:
    """What a checkpoint keeps beside the tensors. ``seconds``, ``rays`` and ``samples`` include what was discarded, and
    what was done before in the finished run that this one goes on from."""

    step: int = 0
    seconds: float = 0.0
    rays: int = 0
    samples: int = 0
    restarts: int = 0
    rollbacks: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    validation_psnr: float | None = None
    steps_before: int = 0  # of the finished run that this one goes on from
    seconds_before: float = 0.0
    validation_before: float | None = None
    timings: dict[str, Any] = field(default_factory=dict)
    symptom: str | None = None  # of a field that ended within its warm-up

    def anew(self, restarts: int, rollbacks: int) -> "RunState":
        """The state of a run that begins again with fresh weights: only what was spent is kept, and what was before."""
        names = ("seconds", "rays", "samples", "steps_before", "seconds_before", "validation_before")
        return RunState(restarts=restarts, rollbacks=rollbacks, **{name: getattr(self, name) for name in names})

    def open_target(self, psnr: float | None) -> float | None:
        """The target, unless the finished run that this one goes on from has reached it: more was asked for since."""
        reached = psnr is not None and self.validation_before is not None and self.validation_before >= psnr
        return None if reached else psnr


def checkpoint_interval(budget: TrainingBudget, cost: float) -> float:
    """Seconds until the next checkpoint, where nobody says; the last one took ``cost`` seconds."""
    wanted = CHECKPOINT_SECONDS if budget.seconds is None else CHECKPOINT_SHARE * budget.seconds
    return min(CHECKPOINT_SECONDS, max(wanted, cost / MAX_SAVING))


def lost_seconds(spent: Path, state: RunState) -> float:
    """How much more training than ``state`` knows of a killed run has noted in the file ``spent``; 0 if it cannot be
    read."""
    try:
        return max(0.0, float(spent.read_text()) - state.seconds)
    except (OSError, ValueError):
        return 0.0


class Pace:
    """Running means of a run's speed and batch PSNR, forgetting after a few seconds. Shown, and used for planning.

    The first step of a process also wakes caches and libraries: it counts until there is a second one.
    """

    def __init__(self) -> None:
        self.count, self.seconds_per_step, self.rays_per_step, self.psnr = 0, 0.0, 0.0, 0.0

    def add(self, seconds: float, rays: int, psnr: float) -> None:
        """Take one step into account."""
        self.count += 1
        if self.count > 2:
            seconds = min(seconds, MAX_OF_A_STALL * self.seconds_per_step)
        new = max(1 / max(1, self.count - 1), 1 - math.exp(-seconds / RATE_MEMORY_SECONDS))
        self.seconds_per_step += new * (seconds - self.seconds_per_step)
        self.rays_per_step += new * (rays - self.rays_per_step)
        self.psnr += new * (psnr - self.psnr)


class TrainingLog:
    """Appends events to ``log.jsonl`` in the stage's folder, one JSON object a line."""

    def __init__(self, folder: Path, tensorboard: bool) -> None:
        self.path = folder / "log.jsonl"
        self.board = _board(folder / "tensorboard") if tensorboard else None

    def event(self, kind: str, step: int, **values: Any) -> None:
        """Record that ``kind`` happened before ``step``."""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"event": kind, "step": step, **values}) + "\n")

    def point(self, point: dict[str, Any]) -> None:
        """Record one point of the curve."""
        self.event("measured", **point)
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
