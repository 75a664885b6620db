"""Where tests of kernels run: on the CPU and, where there is one, on a GPU."""

import pytest
import torch

from nerf.kernels import warp

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def skip_without(device: str) -> None:
    """Skip the test, with the reason, where torch or Warp cannot use ``device``."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch finds no GPU")
    if why := warp.unavailable_reason(device):
        pytest.skip(why)
