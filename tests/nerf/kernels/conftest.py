"""Where the tests of Warp's kernels run."""

from collections.abc import Iterator

import pytest
import torch

from tests.devices import DEVICES, skip_without


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """Tests that ask for it run on the CPU and, where there is one, on a GPU."""
    skip_without(request.param)
    with torch.device(request.param):
        yield request.param
