"""Shared by the tests of stages."""

from pathlib import Path

import pytest


@pytest.fixture
def tmp_path(tmp_path: Path) -> Path:
    """A folder that stands alone: beside a set of photos, those of tests about masks would look like folders of its
    masks."""
    alone = tmp_path / "alone"
    alone.mkdir()
    return alone
