"""What stage effects decided, as the stages after it read it: ``decisions.json``."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from stages.io.files import read_dataclass, write_json

Space = Literal["bounded", "contracted", "ndc"]


@dataclass(frozen=True)
class Decisions:
    """``on``: by the name of each effect that is modelled what it begins with: numbers by the name of each training
    photo (as exposure has natural logarithms of gains in linear light), or nothing."""

    on: dict[str, dict[str, list[float]]] = field(default_factory=dict)

    def having(self, name: str, measured: dict[str, list[float]] | None = None) -> "Decisions":
        """These, with one effect more."""
        return Decisions({**self.on, name: measured or {}})

    def without(self, name: str) -> "Decisions":
        """These, with one effect less."""
        return Decisions({other: measured for other, measured in self.on.items() if other != name})


def write_decisions(folder: Path, decisions: Decisions) -> None:
    """Write decisions.json."""
    write_json(folder / "decisions.json", asdict(decisions))


def read_decisions(folder: Path) -> Decisions:
    """Read decisions.json. Raises StageError where it is missing or damaged."""
    return read_dataclass(folder / "decisions.json", Decisions)
