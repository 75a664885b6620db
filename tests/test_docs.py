"""The documentation agrees with the code: links, options, the table of rooms."""

import re
from pathlib import Path

import pytest
from tyro.conf import Suppress

from pipeline.chain import STAGES

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(rf"--({'|'.join(STAGES)})\.([a-z][a-z0-9_-]*)")
MODULE = re.compile(r"(?m)^\| `((?:nerf|stages|pipeline)/[\w/]+\.py)` \|")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def options_of(stage: str) -> set[str]:
    """The dotted flags of a stage, without those that the command line fills in itself."""
    fields = STAGES[stage].Config.model_fields
    return {name.replace("_", "-") for name, field in fields.items() if Suppress not in field.metadata}


def flags_of(stage: str) -> set[str]:
    """:func:`options_of`, and how switches are turned off."""
    fields = STAGES[stage].Config.model_fields
    switches = {name.replace("_", "-") for name, field in fields.items() if field.annotation is bool}
    return options_of(stage) | {f"no-{switch}" for switch in switches}


def documented(text: str) -> set[tuple[str, str]]:
    return set(OPTION.findall(text))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path):
    for target in LINK.findall(page.read_text("utf-8")):
        if not re.match(r"[a-z]+:|#", target):
            assert (page.parent / target.split("#")[0]).exists(), target


def test_the_pages_are_linked():
    linked = {
        (page.parent / target.split("#")[0]).resolve() for page in PAGES for target in LINK.findall(page.read_text())
    }
    folders = {path for path in linked if path.is_dir()}
    assert not [name_of(page) for page in PAGES[1:] if page not in linked and page.parent not in folders]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_options_named_exist(page: Path):
    wrong = [f"--{stage}.{option}" for stage, option in documented(page.read_text()) if option not in flags_of(stage)]
    assert not wrong


@pytest.mark.parametrize("stage", STAGES)
def test_every_option_is_on_its_stages_page(stage: str):
    page = (ROOT / "docs" / "stages" / f"{stage}.md").read_text("utf-8")
    assert options_of(stage) == {option for of, option in documented(page) if of == stage and option in options_of(of)}


@pytest.mark.parametrize("stage", STAGES)
def test_defaults_in_the_tables_are_those_of_the_code(stage: str):
    """Compared where the default is a number; one that is chosen (None) is described in words."""
    page = (ROOT / "docs" / "stages" / f"{stage}.md").read_text("utf-8")
    for name, field in STAGES[stage].Config.model_fields.items():
        if isinstance(field.default, bool) or not isinstance(field.default, int | float):
            continue
        row = re.search(rf"(?m)^\| `--{stage}\.{name.replace('_', '-')}` \| ([^|]+) \|", page)
        assert row and float(row[1]) == field.default, name


def test_the_table_of_rooms_is_complete():
    rooms = MODULE.findall((ROOT / "docs" / "ARCHITECTURE.md").read_text("utf-8"))
    modules = [name_of(path) for package in ("nerf", "stages", "pipeline") for path in (ROOT / package).rglob("*.py")]
    assert len(modules) > 60
    assert sorted(rooms) == sorted(modules)


def test_the_checks_can_fail():
    assert documented("`--train.steps 500` and --mesh.max-faces") == {("train", "steps"), ("mesh", "max-faces")}
    assert "photos" not in options_of("ingest") and "cameras" not in options_of("sfm")
    assert "cameras" in options_of("render") and "no-depth" in flags_of("render")
    assert "steppes" not in flags_of("train")
    assert MODULE.findall("| `nerf/rays.py` | rays |\nnerf/model.py") == ["nerf/rays.py"]
