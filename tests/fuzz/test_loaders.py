"""Loaders answer or refuse in words, whatever they are given. The long run: ``python -m benchmarks.fuzz``."""

import os

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.loaders import LOADERS, attempt

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))


@pytest.mark.parametrize("name", LOADERS)
def test_a_loader_answers_or_refuses_in_words(name: str) -> None:
    loader = LOADERS[name]
    taken = []

    @settings(max_examples=EXAMPLES, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(files=loader.files())
    def check(files: dict[str, bytes]) -> None:
        taken.append(attempt(loader, files))

    check()
    assert any(taken) and not all(taken), "what is given must be valid at times, and damaged at times"
