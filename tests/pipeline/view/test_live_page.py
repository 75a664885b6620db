"""The page of a running training, in a browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.engine.run_file import RunFile, write
from stages import viewer
from stages.contract import run_stage
from stages.io.files import write_json
from stages.train.live import LIVE, STATE
from tests.conftest import RecordedProgress
from tests.pipeline.view.running_training import KEYS, RunningTraining
from tests.pipeline.view.test_server import Served
from tests.stages.viewer.browser import Viewer, chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


def test_it_follows_a_training_to_the_end_it_asks_for(browser: Any, tmp_path: Path) -> None:
    with RunningTraining(tmp_path) as training:
        write_json(training.inputs["scale"] / "scale.json", {"metres_per_unit": 0.5})
        server = Served(training)
        page = Viewer(browser, server.server.url)
        page.until("follower.shown")
        metres = 0.5 / training.scene.scene_from_sfm.scale
        assert page.run("viewer.contents.scene.metres_per_unit") == pytest.approx(metres)
        first, field = page.drawn(), page.run("follower.shown")
        assert page.run("document.querySelectorAll('b').length") == 0, "a name is text and no HTML"
        page.until(f"follower.shown !== '{field}' && document.querySelector('#live-curve polyline')")
        assert np.abs(page.drawn() - first).max() > 10
        page.run("document.getElementById('finish').click()")
        training.wait()
        page.until("follower.shown === 'finished'")
        assert page.run("document.getElementById('live-phase').textContent").startswith("Finished")
        assert page.run("document.getElementById('finish').hidden")
        assert np.ptp(page.shown()) > 100
        assert page.faults == []
        page.run("window.before = true")
        write(training.root, RunFile(keys=KEYS | {"train": "e" * 64}))
        # Another training was begun. The page loads anew meanwhile, which Viewer.until would not outlive.
        page.page.get_by_text("The training has not begun.").wait_for(state="attached")
        assert page.run("!window.before")
        server.close()
        page.close()


def test_what_cannot_be_drawn_is_no_end_of_the_server(browser: Any, tmp_path: Path) -> None:
    with RunningTraining(tmp_path) as training:
        server = Served(training)
        page = Viewer(browser, server.server.url)
        page.until("follower.shown")
        page.run("() => { viewer.replace = () => { throw new TypeError('broken'); }; }")
        page.until("document.getElementById('message').textContent.includes('broken')")
        step = page.run("follower.state.step")
        page.until(f"follower.state.step > {step}")
        assert page.run("document.getElementById('live-phase').textContent").startswith("Training")
        page.close()
        server.close()


def test_a_finished_page_notices_another_training(browser: Any, tmp_path: Path) -> None:
    with RunningTraining(tmp_path, steps=60) as training:
        training.wait()
        train, out = training.workspace.folder("train", KEYS["train"]), tmp_path / "out"
        out.mkdir()
        config = viewer.Config(bits="8", mesh="off")
        run_stage(viewer.STAGE, config, training.inputs | {"train": train}, out, RecordedProgress())
        training.make_page((out / "viewer.html").read_text("utf-8"))
    server = Served(training)
    page = Viewer(browser, server.server.url)
    page.until("window.viewer && !window.follower")
    page.run("window.before = true")
    write(training.root, RunFile(keys=KEYS | {"train": "e" * 64}))
    page.page.wait_for_event("response")
    page.page.wait_for_event("response")
    assert page.run("window.before"), "nothing has been trained yet: what is there stays"
    with training.workspace:
        live = training.workspace.partial("train", "e" * 64) / LIVE
        live.mkdir(parents=True)
        write_json(live / STATE, {"field": "one", "step": 1, "total_steps": 2, "progress": 0.5, "curve": []})
        page.page.get_by_text("Training · step 1 of 2").wait_for(state="attached")
        assert not page.run("window.before") and page.faults == []
    page.close()
    server.close()


def test_it_says_when_its_server_is_gone(browser: Any, tmp_path: Path) -> None:
    server = Served(RunningTraining(tmp_path))
    page = Viewer(browser, server.server.url)
    page.until("document.getElementById('live-phase').textContent.includes('No training')")
    assert page.run("byId('live-phase').textContent === byId('message').textContent"), "also beside a closed menu"
    server.close()
    page.until("document.getElementById('live-phase').textContent.includes('server has ended')")
    page.close()


def test_a_vanilla_training_shows_its_figures(browser: Any, tmp_path: Path) -> None:
    with RunningTraining(tmp_path, field="vanilla") as training:
        server = Served(training)
        page = Viewer(browser, server.server.url)
        page.until("follower.cannot")
        assert "hash-grid" in page.run("document.getElementById('message').textContent")
        page.until("follower.state.step > 1")
        assert page.faults == []
        page.close()
        server.close()
