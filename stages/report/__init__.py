"""Stage report: everything that the other stages found, as one HTML file that needs no network, and summary.json.

It reads the stages' outputs and the manifest.json that the runner leaves beside them. Stages may be missing; what
they would have told is then left out, never made up.
"""

from pathlib import Path
from typing import Annotated

from pydantic import Field
from tyro.conf import Suppress

from stages.contract import READING_SECONDS, Inputs, Progress, Stage, StageConfig, StageResult, Workload
from stages.io.files import write_json


class Account(StageConfig):
    """What a budget of wall time allocated and what was spent, in seconds, by stage; none of what was there already."""

    seconds: float
    allocated: dict[str, float]
    spent: dict[str, float]


class Config(StageConfig):
    """What the report contains."""

    video_limit_mb: float = Field(
        default=12,
        ge=0,
        description="A video larger than this many megabytes is linked instead of embedded in the page.",
    )
    budget: Annotated[Account | None, Suppress] = Field(
        default=None, description="What the runner knows of the time given to the run; no flag is offered for it."
    )
    resumed: Annotated[tuple[str, ...] | None, Suppress] = Field(
        default=None, description="The stages of `pipeline resume`; no flag is offered for it (default: all)."
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """The page, and at most fifteen test photos beside their renders."""
    test_photos = workload.photos.number / workload.options["normalise"].test_every
    return 2.0 + READING_SECONDS * workload.photos.megapixels * min(15, test_photos)


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Write report.html and summary.json."""
    from stages.report.page import command_that_scores, page, read_results, summarise

    progress.update("reading results")
    results = read_results(inputs, STAGE.inputs)
    summary = summarise(results)
    summary["budget"] = config.budget and config.budget.model_dump()
    write_json(folder / "summary.json", summary)
    progress.update("writing the page")
    text = page(results, summary, config)
    (folder / "report.html").write_text(text, "utf-8", "backslashreplace")  # names of folders need not be Unicode
    doubt = "The cameras are doubtful. " if summary["cameras_doubtful"] else ""
    line = f"{doubt}{summary['verdict']}"
    if results.metrics is None:
        line += f" `{command_that_scores(inputs, config)}` runs it."
    return StageResult(("report.html", "summary.json"), line, facts={"verdict": line})


STAGE = Stage(
    name="report",
    inputs=(
        "ingest",
        "sfm",
        "normalise",
        "scale",
        "effects",
        "train",
        "evaluate",
        "render",
        "mesh",
        "viewer",
        "tradeoff",
    ),
    version=19,
    exit_code=18,
    published=("report.html", "summary.json"),
    config=Config,
    run=run,
    summary=True,
    expected_seconds=expected_seconds,
)
