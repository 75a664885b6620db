"""Loaders answer or refuse in words, whatever they are given. The long run: ``python -m benchmarks.fuzz``."""

import json
import os
import struct
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.cameras import colmap_models, transforms
from tests.fuzz.loaders import LOADERS, attempt
from tests.fuzz.workspaces import manifest, run_file

SLOW = (HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much)
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))


@pytest.mark.parametrize("name", LOADERS)
def test_a_loader_answers_or_refuses_in_words(name: str) -> None:
    loader = LOADERS[name]
    taken = []

    @settings(max_examples=EXAMPLES, derandomize=True, database=None, suppress_health_check=SLOW)
    @given(files=loader.files())
    def check(files: dict[str, bytes]) -> None:
        taken.append(attempt(loader, files))

    check()
    assert any(taken) and not all(taken), "what is given must be valid at times, and damaged at times"


@pytest.mark.parametrize(
    ("name", "file", "content"),
    [
        ("run.json", "run.json", run_file() | {"version": "x" * 70_000}),
        ("camera path", "path.json", transforms() | {"fl_x": "x" * 70_000}),
        ("manifest.json", "manifest.json", manifest() | {"x" * 70_000: 1}),
    ],
)
def test_a_refusal_does_not_repeat_what_may_have_any_length(name: str, file: str, content: dict[str, Any]) -> None:
    assert not attempt(LOADERS[name], {file: json.dumps(content).encode()})


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 1e308])
def test_a_colmap_models_own_errors_are_not_believed(error: float) -> None:
    files = dict(colmap_models()["bin"])
    points = bytearray(files["points3D.bin"])
    struct.pack_into("<d", points, 8 + 8 + 24 + 3, error)
    assert attempt(LOADERS["colmap binary"], {**files, "points3D.bin": bytes(points)})


def test_a_lens_without_an_inverse_is_refused() -> None:
    files = dict(colmap_models()["bin"])
    cameras = bytearray(files["cameras.bin"])
    struct.pack_into("<d", cameras, 8 + 24 + 32, -1e16)
    assert not attempt(LOADERS["colmap binary"], {**files, "cameras.bin": bytes(cameras)})
