"""How soon the page of `pipeline view` shows a training that runs, and that a kill of either side loses nothing.

    python -m benchmarks.viewer_live WORKSPACE

WORKSPACE is finished up to stage effects. A training begins, OPENS pages are opened one after the other, each when
nobody has watched for QUIET_SECONDS. Then the server is killed, and another shows a page as soon as it has started;
server and training are killed, the training is resumed, and two pages of two servers follow it to the end that one of
them asks for. Seconds count from the opening of a page until it has a field, and until this is drawn: here in
software, on the cores that train.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from benchmarks.record import Record, add_out
from tests.stages.viewer.browser import Viewer, chromium

OPENS, QUIET_SECONDS = 3, 12.0  # more than a server and a training take to forget a page
SIZE = (320, 240)
LONG = 3600 + int(time.time()) % 3600  # seconds of the training, which is asked to finish before; one like it is cached


@contextmanager
def program(*words: str) -> Iterator[subprocess.Popen[str]]:
    """`pipeline` with these words, killed in the end."""
    running = subprocess.Popen([sys.executable, "-m", "pipeline", *words], stdout=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        running.kill()
        running.wait()


@contextmanager
def served(root: Path) -> Iterator[str]:
    """The address of a server of the workspace."""
    with program("view", str(root), "--json") as server:
        assert server.stdout is not None
        yield json.loads(server.stdout.readline())["url"]


def wait_for_fields(url: str) -> None:
    """Until the training has loaded its photos: a page that was opened before would load anew."""
    state: dict[str, Any] = {}
    while state.get("phase") != "training" or not state["field"]:
        time.sleep(1)
        with urlopen(url + "state") as answer:
            state = json.load(answer)


def opened(browser: Any, url: str) -> tuple[Viewer, dict[str, float]]:
    """A page, once it shows a field, and when it did."""
    began = time.monotonic()
    page = Viewer(browser, url, *SIZE)
    page.until("follower.shown")
    shown = time.monotonic() - began
    page.until("viewer.renderer.presented")
    return page, {"field_seconds": round(shown, 1), "picture_seconds": round(time.monotonic() - began, 1)}


def opened_unwatched(browser: Any, url: str, record: Record) -> Viewer:
    """A page, opened when nobody has watched for a while."""
    time.sleep(QUIET_SECONDS)
    page, times = opened(browser, url)
    record.add(what="a page is opened", step=page.run("follower.state.step"), **times)
    return page


def step_after(page: Viewer, step: int) -> int:
    """The step that the page tells once the training has done another."""
    page.until(f"follower.state.phase === 'training' && follower.state.step > {step}")
    return page.run("follower.state.step")


def follow(browser: Any, root: Path, record: Record) -> None:
    """One training: opened, killed, resumed, finished."""
    train = ("train", str(root), "--train.seconds", str(LONG), "--train.checkpoint-seconds", "10")
    with program(*train):
        with served(root) as url:
            wait_for_fields(url)
            for _ in range(OPENS):
                opened_unwatched(browser, url, record).close()
        with served(root) as url:
            page, times = opened(browser, url)
            record.add(what="the server was killed; another starts", step=page.run("follower.state.step"), **times)
            step = step_after(page, page.run("follower.state.step"))
    page.until("document.getElementById('live-phase').textContent.includes('server has ended')")
    page.close()
    with program(*train) as training, served(root) as one, served(root) as two:
        wait_for_fields(one)
        page, times = opened(browser, one)
        resumed = step_after(page, 0)
        record.add(what=f"both were killed after step {step} and started again", step=resumed, **times)
        other, times = opened(browser, two)
        record.add(what="a second viewer", step=other.run("follower.state.step"), **times)
        step_after(page, max(600, resumed))
        other.run("document.getElementById('finish').click()")
        for each in (page, other):
            each.until("follower.shown === 'finished'")
        steps = [each.run("follower.state.step") for each in (page, other)]
        assert training.wait() == 0 and steps[0] == steps[1] and page.faults == other.faults == []
        record.add(what="finished, in both viewers", step=steps[0])


def main() -> None:
    """The rows of one workspace."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    add_out(parser)
    given = parser.parse_args()
    with chromium() as browser:
        follow(browser, given.workspace, Record(given.out))


if __name__ == "__main__":
    main()
