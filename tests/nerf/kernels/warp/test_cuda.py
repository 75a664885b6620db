"""The CUDA side of Warp's kernels is compiled where there is no GPU, so that it cannot rot unseen."""

from pathlib import Path

import pytest
import warp as wp

import nerf.kernels.warp
from nerf.kernels.warp.launch import PACKAGE

assert nerf.kernels.warp.adam  # the package defines all kernels when it is imported

# With their kernels.
MODULES = {
    "adam": 3,
    "colour_sampling": 3,
    "compositing": 4,
    "early_termination": 2,
    "encoding": 5,
    "gather": 1,
    "marching": 4,
    "mlp": 5,
    "occupancy": 3,
    "depth_loss": 2,
    "distortion_loss": 2,
    "spherical_harmonics": 1,
}


@pytest.mark.parametrize(("arch", "kind"), [(80, "ptx"), (90, "cubin")])
@pytest.mark.parametrize("name", MODULES)
def test_all_kernels_compile_for_cuda(name: str, arch: int, kind: str, tmp_path: Path) -> None:
    """As text for the driver of any GPU from Ampere on, and as code for one kind of GPU."""
    files = wp.compile_aot_module(f"{PACKAGE}.{name}", arch=arch, module_dir=tmp_path, use_ptx=kind == "ptx")
    assert [path.suffix for path in files] == [f".{kind}"] and f"sm{arch}" in files[0].name
    kernels = wp.get_module(f"{PACKAGE}.{name}").kernels
    assert len(kernels) == MODULES[name]
    code = files[0].read_bytes()
    assert all(f"{key}_".encode() in code for key in kernels)


def test_no_module_of_kernels_is_left_out() -> None:
    folder = Path(nerf.kernels.warp.__file__).parent
    assert set(MODULES) == {path.stem for path in folder.glob("*.py") if "@wp.kernel" in path.read_text("utf-8")}
