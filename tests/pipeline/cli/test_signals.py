"""Signals that arrive where Python ignores what is raised, and what is said of them."""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from pipeline.cli.commands import run_command

STRUCK_IN_A_FINALISER = """
import signal, sys, time
from pipeline.cli.signals import Terminated, heed_signals

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs begin with SIGINT ignored
heed_signals()

class Place:
    def __del__(self):
        signal.raise_signal(signal.Signals(int(sys.argv[1])))

try:
    Place()
    time.sleep(20)
except (KeyboardInterrupt, Terminated) as ending:
    print(type(ending).__name__)
"""


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Terminated")])
def test_a_signal_that_python_ignores_arrives_all_the_same(number: signal.Signals, name: str) -> None:
    command = [sys.executable, "-c", STRUCK_IN_A_FINALISER, str(int(number))]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=15, check=True)
    assert (ended.stdout, ended.stderr) == (f"{name}\n", "")


def test_other_exceptions_that_python_ignores_are_told_as_ever() -> None:
    program = """
from pipeline.cli.signals import heed_signals

heed_signals()

class Place:
    def __del__(self):
        raise ValueError("lost")

Place()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=15, check=True)
    assert "Exception ignored in" in ended.stderr and "ValueError: lost" in ended.stderr


def test_ctrl_c_before_the_program_is_read_shows_no_traceback() -> None:
    """The command's own entry point reads next to nothing, so that it is there in time."""
    program = """
import runpy, sys

class Struck:
    def find_spec(self, name, *_):
        if name == "pipeline.cli.commands":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Struck())
runpy.run_module("pipeline", run_name="__main__")
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=15)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["scripts"] == {"pipeline": "pipeline.__main__:main"}


@pytest.mark.parametrize(
    "words, way",
    [
        ("run photos --from train", "`pipeline resume WORKSPACE` continues"),
        ("resume w", "`pipeline resume WORKSPACE` continues"),
        ("tradeoff w --budget 30m", "the same command continues"),
        ("demo", "the same command continues"),
        ("train w --force", "the same command starts over"),
        ("train w --replan", "the same command without --replan continues"),
    ],
)
def test_what_was_stopped_is_told_how_to_go_on(
    words: str, way: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(_: str):
        raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.cli.commands._command", interrupted)
    assert run_command(words.split()) == 130
    assert f"Finished stages are kept; {way}.\n" in capsys.readouterr().err
