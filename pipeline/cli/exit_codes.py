"""How a command ends, as a number: 0 done; 1 a bug in this program; 2 usage; 3 the workspace; 4 a scene of a batch
failed; 10 to 22 the stage that failed, by what it declares; 130 Ctrl-C; 143 SIGTERM."""

from pipeline.engine.stage_list import STAGES

DEFECT, USAGE, WORKSPACE, BATCH, INTERRUPT, TERMINATED = 1, 2, 3, 4, 130, 143


def of_stage(name: str) -> int:
    """That this stage failed."""
    return STAGES[name].exit_code
