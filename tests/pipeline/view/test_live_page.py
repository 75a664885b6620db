"""The page of a running training, in a browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.pipeline.view.running_training import RunningTraining
from tests.pipeline.view.test_server import Served
from tests.stages.viewer.browser import Viewer, chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


def test_it_says_when_its_server_is_gone(browser: Any, tmp_path: Path) -> None:
    server = Served(RunningTraining(tmp_path).root)
    page = Viewer(browser, server.server.url)
    page.until("document.getElementById('live-phase').textContent.includes('No training')")
    server.close()
    page.until("document.getElementById('live-phase').textContent.includes('server has ended')")
    page.close()


def test_a_vanilla_training_shows_its_figures(browser: Any, tmp_path: Path) -> None:
    with RunningTraining(tmp_path, field="vanilla") as training:
        server = Served(training.root)
        page = Viewer(browser, server.server.url)
        page.until("follower.cannot")
        assert "hash-grid" in page.run("document.getElementById('message').textContent")
        page.until("follower.state.step > 1")
        assert page.faults == []
        page.close()
        server.close()
