"""What the user sees while stages run; and that a run goes on where nobody sees it."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pipeline.cli.commands import run_command
from pipeline.cli.terminal import PlainDisplay, choose_display, end_line
from pipeline.engine.display import Display
from stages.contract import StageError


def say_everything(display: Display) -> None:
    display.headline("two cores")
    for stage in ("sfm", "train"):
        display.begin(stage)
        display.update("step 1", 0.5)
        display.note("train.code", "a note " * 2000)  # more than a buffer holds
        display.end(stage, "it is done", 1.0, cached=False)
    display.failed("train", StageError("train.code", "what", "why", "what to try"))
    display.finished("at last", {})


@pytest.mark.parametrize("as_json", [False, True], ids=["plain", "json"])
@pytest.mark.parametrize("fault", ["nobody reads", "full disk"])
def test_a_run_goes_on_when_nothing_can_be_said(as_json: bool, fault: str, monkeypatch: pytest.MonkeyPatch):
    if fault == "full disk" and not Path("/dev/full").exists():
        pytest.skip("this system has no disk that is always full")
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe, open("/dev/full" if fault == "full disk" else os.devnull, "w") as full:
        unread = pipe if fault == "nobody reads" else full
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, unread)
        with choose_display(as_json) as display:
            say_everything(display)
        unread.flush()
        monkeypatch.undo()


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="terminals of another kind")
def test_a_run_goes_on_when_its_terminal_is_closed(monkeypatch: pytest.MonkeyPatch):
    faults = list[object]()
    monkeypatch.setattr(threading, "excepthook", faults.append)
    master, slave = os.openpty()
    with open(slave, "w") as terminal:
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, terminal)
        with choose_display(as_json=False) as display:
            display.headline("two cores")
            shown = b""
            while b"two cores" not in shown:
                shown += os.read(master, 4096)
            os.close(master)
            with pytest.raises(OSError, match="Input/output error"):
                os.write(slave, b"nobody is there")
            say_everything(display)
        terminal.flush()
        monkeypatch.undo()
    assert faults == []


AT_WORK = """
import os
from pipeline.cli import commands as cli
def at_work(words):
    os.write(1, b"at work")
    try:
        os.read(0, 1)  # until the terminal is closed
    except OSError:
        pass
    return os.system("kill -HUP $$")  # nor does it end what a stage started
cli.command_doctor = at_work
os._exit(cli.run_command(["doctor"]))
"""


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="terminals of another kind")
def test_the_end_of_its_terminal_does_not_end_a_run():
    import fcntl
    import termios

    master, slave = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", AT_WORK],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # the terminal that this session belongs to
    )
    os.close(slave)
    shown = b""
    while b"at work" not in shown:
        shown += os.read(master, 4096)
    os.close(master)
    assert process.wait(timeout=20) == 0


@pytest.mark.skipif(os.name == "nt", reason="a shell of another kind")
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_streams_that_were_closed_are_no_error(closed: str, tmp_path: Path):
    for words, code in (["--version", 0], [f"status {tmp_path}", 3]):
        command = f"{sys.executable} -m pipeline {words} {closed}"
        ended = subprocess.run(command, shell=True, capture_output=True, text=True)
        assert ended.returncode == code and "Traceback" not in ended.stderr


def test_plain_lines_are_due_only_with_news(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    seconds = iter([0.0, 5.0, 11.0, 22.0, 33.0, 34.0, 50.0, 51.0, 62.0])
    monkeypatch.setattr("pipeline.cli.terminal.time.monotonic", lambda: next(seconds))
    display = PlainDisplay()
    display.begin("sfm")
    for message, done in (("a", 0.0), ("a", 0.0), ("a", 0.0), ("b", 0.001), ("c", 0.0), ("c", 0.2)):
        display.update(message, done)  # too early, due, nothing new, due, too early, due
    display.begin("train")
    display.update("c", 0.2)
    assert [line.split()[-1] for line in capsys.readouterr().out.splitlines()] == ["a", "b", "c", "c"]


def test_updates_before_the_first_stage_have_no_line(capsys: pytest.CaptureFixture[str]):
    for as_json in (False, True):
        with choose_display(as_json) as display:
            display.update("reading 3 photos")
    assert capsys.readouterr().out == ""


def test_events_are_lines_of_json(capsys: pytest.CaptureFixture[str]):
    with choose_display(as_json=True) as display:
        say_everything(display)
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    kinds = ["start", *["begin", "progress", "note", "end"] * 2, "error", "finished"]
    assert [event["event"] for event in events] == kinds


def test_end_lines():
    assert end_line("sfm", "all good", 61.0, cached=False) == "sfm        all good  [1 min 1 s]"
    assert end_line("sfm", "all good", 61.0, cached=True) == "sfm        all good  [cached]"


def test_plain_output_is_not_flooded(capsys: pytest.CaptureFixture[str]):
    display = PlainDisplay()
    display.begin("train")
    for k in range(1000):
        display.update(f"step {k}", k / 1000)
    display.note("train.code", "a line that stays")
    assert capsys.readouterr().out == "train      a line that stays\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no disk that is always full")
def test_an_error_that_cannot_be_said_keeps_its_exit_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        assert run_command(["status", str(tmp_path)]) == 3
        full.flush()  # as the program does when it ends
        monkeypatch.undo()
