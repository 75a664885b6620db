"""The chain of all drills: run once, copied by each."""

import pytest

from tests.drills.campaigns import Chain
from tests.small_scenes import write_blender_scene


@pytest.fixture(scope="session")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """A run that nobody disturbed. Do not write into its workspace."""
    folder = tmp_path_factory.mktemp("drills")
    return Chain(write_blender_scene(folder / "photos"), folder / "undisturbed.nerf")
