"""Whatever a user can act on ends a stage in words."""

import pytest

from pipeline.engine.failures import StageFailed, worded
from pipeline.engine.stage_list import STAGES


@pytest.mark.parametrize(("stage", "has_an_option"), [("train", True), ("mesh", True), ("ingest", False)])
def test_short_memory_names_an_option_of_the_stage(stage: str, has_an_option: bool):
    with pytest.raises(StageFailed) as failure, worded(STAGES[stage]):
        raise MemoryError
    assert failure.value.error.code == "pipeline.out-of-memory"
    assert (f"--{stage}." in failure.value.error.hint) == has_an_option
