import contextlib
import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import pytest

import nerf.kernels
from nerf.kernels import torch as reference
from nerf.kernels import warp
from stages import evaluate, mesh, render, train
from stages.contract import Stage, StageConfig, StageError, run_stage
from stages.hardware.backend import chosen_backend, load_backend
from stages.io.field_files import load_field
from stages.io.files import write_json
from stages.train import Config
from stages.train.fields.hash_grid_options import HashGridOptions
from tests.refusals import refused
from tests.stages.photo_scene import photographed

ROOT = Path(__file__).parents[3]
TINY: dict[str, Any] = {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024}
OLD_DRIVER = "Warp 1.19.0 finds no CUDA driver that is new enough for it"
NOTE, AS_TRAINED = "hardware.torch-alone", "hardware.trained-without-warp"


@pytest.fixture
def useless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp loads, but its kernels do not run."""
    monkeypatch.setattr(warp, "unavailable_reason", lambda device: OLD_DRIVER)


@pytest.fixture
def missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp does not load."""
    monkeypatch.delattr(nerf.kernels, "warp")
    monkeypatch.setitem(sys.modules, "nerf.kernels.warp", None)


def test_warp_is_chosen_where_it_runs_and_nothing_is_said(progress) -> None:
    assert chosen_backend("cpu", progress) == "warp"
    assert progress.notes == []


def test_otherwise_torch_is_chosen_and_the_reason_said(useless: None, progress) -> None:
    assert chosen_backend("cuda", progress) == "torch"
    assert progress.codes == [NOTE] and progress.names(NOTE, OLD_DRIVER)
    assert chosen_backend("cuda") == "torch"


def test_a_warp_that_does_not_load_is_no_failure(missing: None, progress) -> None:
    assert chosen_backend("cpu", progress) == "torch"
    assert progress.names(NOTE, "warp-lang", "import of nerf.kernels.warp halted")


def test_where_kernels_cannot_be_kept_the_way_out_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file")}
    code = "from stages.hardware.backend import chosen_backend as c, why_not_warp as w; print(c('cpu'), w('cpu'))"
    answer = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert answer.stdout.startswith("torch ") and "([Errno " in answer.stdout, answer.stderr
    assert "WARP_CACHE_PATH" in answer.stdout

    def full(device: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/home/.cache")

    monkeypatch.setattr(warp, "compile_kernels", full)
    with refused("hardware.kernel-cache", "WARP_CACHE_PATH", "--train.grid.backend torch"):
        load_backend("warp", "cpu")


def test_why_not_says_what_is_wrong_with_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp.is_cuda_available", lambda: False)
    assert warp.unavailable_reason("cpu") is None
    why = warp.unavailable_reason("cuda")
    assert why and why.startswith("Warp 1.") and why.endswith(" finds no CUDA driver that is new enough for it")
    monkeypatch.setattr("warp.is_cuda_available", lambda: True)
    assert warp.unavailable_reason("cuda") is None


def test_a_backend_is_loaded_by_name(progress) -> None:
    assert load_backend("torch", "cpu", progress) is reference
    assert progress.updates == []
    assert load_backend("warp", "cpu", progress) is warp
    assert progress.updates == [("compiling kernels, once on each machine", None)]


@pytest.mark.parametrize(("trouble", "why"), [("useless", OLD_DRIVER), ("missing", "warp-lang")])
def test_warp_asked_for_by_name_is_not_replaced_silently(
    trouble: str, why: str, request: pytest.FixtureRequest
) -> None:
    request.getfixturevalue(trouble)
    with refused("hardware.no-warp", why, "--train.grid.backend torch"):
        load_backend("warp", "cuda")


def test_loading_warp_says_nothing_and_leaves_stderr_open() -> None:
    code = (
        "import sys; from stages.hardware.backend import chosen_backend as c; "
        "print(c('cpu')); print('heard', file=sys.stderr)"
    )
    answer = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "warp\n", "heard\n")


def tiny(backend: Literal["torch", "warp"] | None = None, **settings: Any) -> Config:
    return Config(downscale=1.0, grid=HashGridOptions(**TINY, backend=backend), **settings)


def test_planning_chooses_and_keeps_a_backend(tmp_path: Path, progress, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, _ = photographed(tmp_path)
    sized = tiny(steps=10)
    assert train.plan(sized, inputs, progress).grid.backend == "warp"
    monkeypatch.setattr(warp, "unavailable_reason", lambda device: OLD_DRIVER)
    assert train.plan(sized, inputs, progress).grid.backend == "torch"
    assert progress.codes.count(NOTE) == 1 and progress.names(NOTE, OLD_DRIVER)
    with refused("hardware.no-warp", "--train.grid.backend torch"):
        train.plan(tiny("warp", steps=10), inputs, progress)


def test_both_backends_train_the_same_field_from_photos(tmp_path: Path, progress) -> None:
    """Rounding parts them step by step, but little: over seeds 0 ... 3 they ended at most 0.04 dB apart, and the seeds
    themselves 0.3 dB."""
    inputs, _ = photographed(tmp_path, channels=4)
    found = {}
    backends: tuple[Literal["torch", "warp"], ...] = ("warp", "torch")
    for backend in backends:
        folder = tmp_path / backend
        folder.mkdir()
        result = run_stage(train.STAGE, tiny(backend, steps=120), inputs, folder, progress)
        found[backend] = result.facts["probe_psnr"]
        assert load_field(folder)[1]["kind"] == "grid"
    flat = 11.0  # dB, of the best single colour
    assert flat + 2 < found["torch"] < 60
    assert found["warp"] == pytest.approx(found["torch"], abs=0.1)


LATER: dict[Stage, StageConfig] = {
    evaluate.STAGE: evaluate.Config(fraction=1),
    render.STAGE: render.Config(frames=2, width=16),
    mesh.STAGE: mesh.Config(resolution=16),
}


@pytest.mark.parametrize("stage", LATER, ids=lambda stage: stage.name)
def test_what_torch_trained_stays_with_torch_in_every_stage(stage: Stage, tmp_path: Path, progress) -> None:
    inputs, _ = photographed(tmp_path, channels=4)
    for name in ("train", "later", "scale"):
        (tmp_path / name).mkdir()
    write_json(tmp_path / "scale/scale.json", {"metres_per_unit": None})
    inputs = inputs | {"scale": tmp_path / "scale"}
    run_stage(train.STAGE, tiny("torch", steps=2), inputs, tmp_path / "train", progress)
    assert AS_TRAINED not in progress.codes
    with contextlib.suppress(StageError):  # two steps may leave no surface
        run_stage(stage, LATER[stage], inputs | {"train": tmp_path / "train"}, tmp_path / "later", progress)
    assert progress.codes.count(AS_TRAINED) == 1
