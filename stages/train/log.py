"""What a training run leaves on record: log.jsonl, and the same curves for TensorBoard where asked."""

import json
from pathlib import Path
from typing import Any

from stages.contract import StageError


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
            for name in ("train_psnr", "heldout_psnr", "heldout_ssim"):
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
