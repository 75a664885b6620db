"""Shared by all tests: shape checking of nerf/, and where the real photo sets are."""

import functools
import gc
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import settings
from jaxtyping import config, install_import_hook

# Tests start hundreds of programs of ours, and none has to compile our source anew, whatever the environment says.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Every module by its name, and so none of nerf.kernels.warp: kernels are compiled from their source, undecorated.
NERF = Path(__file__).parents[1] / "nerf"
MODULES = [".".join(file.relative_to(NERF.parent).with_suffix("").parts) for file in NERF.glob("**/*.py")]
CHECKED = [name for name in MODULES if not name.startswith("nerf.kernels.warp") and not name.endswith("__init__")]
install_import_hook(CHECKED, "beartype.beartype")
CHECKED_STEPS = 20

# Tensors of tests are tiny: torch's threads would only wait for each other, most of all on a busy machine.
torch.set_num_threads(1)

# A slow machine is no failure.
settings.register_profile("default", deadline=None)
settings.load_profile("default")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: a fifth of the time of tests is waiting, for programs and browsers they start."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_finish() -> None:
    """What is imported by now lives as long as the process: no collection of garbage has to look through it again."""
    gc.freeze()


pytest_plugins = ["tests.ray_cluster", "tests.synthetic_photos"]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real photo sets that lies beside a checkout; tests that need it skip by name without it."""
    folder = Path(__file__).parents[1] / "../shared/data"
    if not folder.is_dir():
        pytest.skip(f"no real photo sets at {folder}")
    return folder.resolve()


class RecordedProgress:
    """A Progress that remembers what was said."""

    def __init__(self) -> None:
        self.updates: list[tuple[str, float | None]] = []
        self.notes: list[str] = []
        self.codes: list[str] = []  # of the notes

    def update(self, message: str, done: float | None = None) -> None:
        self.updates.append((message, done))

    def note(self, code: str, text: str) -> None:
        self.notes.append(text)
        self.codes.append(code)

    def said(self, code: str) -> list[str]:
        """The notes of this code."""
        return [text for text, each in zip(self.notes, self.codes, strict=True) if each == code]

    def names(self, code: str, *values: object) -> bool:
        """Whether a note of this code names all the ``values``."""
        return any(all(str(value) in text for value in values) for text in self.said(code))

    def clear(self) -> None:
        """Forget the notes."""
        self.notes.clear()
        self.codes.clear()


@pytest.fixture(scope="session", autouse=True)
def rates_are_measured_once() -> Iterator[None]:
    """The machine's rates, which every training measures at its end for half a second on all cores, and which no result
    depends on."""
    measure = pkgutil.resolve_name("nerf.runtime.machine_rates:measure_rates")  # here, for modules are checked by then
    once = functools.cache(lambda device: measure(device, width=64, rows=1 << 12, seconds=0.1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.train.profile.measure_rates", lambda device, *_: once(device))
        yield


@pytest.fixture(scope="session", autouse=True)
def shapes_of_some_steps_are_checked() -> Iterator[None]:
    """Of a training the first steps and every twentieth after them: the others have the same shapes, and checking these
    takes a third of a tiny step."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("nerf.training.hash_grid_trainer:HashGridTrainer", "nerf.training.vanilla_trainer:VanillaTrainer"):
            trainer = pkgutil.resolve_name(name)
            patch.setattr(trainer, "step", _checked_at_times(trainer.step))
        yield


def _checked_at_times(step: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(step)
    def at_times(trainer: object, number: int, *rest: Any) -> Any:
        config.jaxtyping_disable = number >= CHECKED_STEPS and number % CHECKED_STEPS > 0
        try:
            return step(trainer, number, *rest)
        finally:
            config.jaxtyping_disable = False

    return at_times


@pytest.fixture(scope="session", autouse=True)
def nothing_waits_for_the_disk() -> Iterator[None]:
    """No test cuts the power, and of a thousand files each would wait for milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def cores_are_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever took over the cores in another test (nerf/runtime/parallel.py)."""
    monkeypatch.setattr("nerf.runtime.parallel._taken", None)


@pytest.fixture
def use_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Sets the number of threads, both torch's and those of chunks."""
    before = torch.get_num_threads()

    def use(count: int) -> None:
        monkeypatch.setattr("nerf.runtime.parallel._taken", None)
        torch.set_num_threads(count)

    yield use
    torch.set_num_threads(before)


@pytest.fixture
def progress() -> RecordedProgress:
    """A Progress for calling a stage's run() directly."""
    return RecordedProgress()
