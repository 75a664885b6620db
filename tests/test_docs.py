"""The documentation agrees with the code: links, options, the example in Python, the table of rooms."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from tyro.conf import Suppress

from pipeline.engine.stage_list import STAGES

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CHANGELOG = ROOT / "CHANGELOG.md"
GENERATED = ROOT / "docs" / "NUMERICS.md"
MAX_PROSE = 128
LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(rf"--({'|'.join(STAGES)})\.([a-z][a-z0-9_-]*)")
CALL = re.compile(r"(?m)^(?:\w+ = )?run\((\w+), \1\.Config\(.*?\)(?:, \[(.*)\])?\)$")
CODE = re.compile(r"(?ms)^```(\w*)$\n(.*?)^```$\n")
STUDIES = re.compile(r"(?s)<!-- studies -->.*<!-- end of studies -->")
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


def anchors(text: str) -> Iterator[str]:
    """What GitHub calls the headings of a page."""
    seen: dict[str, int] = {}
    for heading in re.findall(r"(?m)^#+ (.+)$", CODE.sub("", text)):
        slug = re.sub(r"[^\w -]", "", LINK.sub("", heading).lower()).replace(" ", "-")
        yield f"{slug}-{seen[slug]}" if slug in seen else slug
        seen[slug] = seen.get(slug, 0) + 1


def prose(text: str) -> list[str]:
    """Lines that are no code, no table, no picture and not written by a program."""
    lines = STUDIES.sub("", CODE.sub("", text)).splitlines()
    return [line for line in lines if not line.lstrip().startswith(("|", "!["))]


def calls_of_run(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """Stage and names of every ``run(stage, stage.Config(...), [names])``."""
    return [(stage, tuple(re.findall(r'"(\w+)"', names))) for stage, names in CALL.findall(text)]


@pytest.mark.parametrize("page", [*PAGES, CHANGELOG], ids=name_of)
def test_links_lead_somewhere(page: Path):
    for target in LINK.findall(page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        other = page.parent / path if path else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other.read_text("utf-8")), target


@pytest.mark.parametrize("page", [page for page in [*PAGES, CHANGELOG] if page != GENERATED], ids=name_of)
def test_prose_is_wrapped(page: Path):
    assert not [line for line in prose(page.read_text("utf-8")) if len(line) > MAX_PROSE]


def test_the_example_in_python_gives_stages_what_they_need():
    calls = calls_of_run((ROOT / "docs" / "PYTHON.md").read_text("utf-8"))
    assert len(calls) > 5
    assert calls == [(stage, STAGES[stage].INPUTS) for stage, _ in calls]


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
    assert MODULE.findall("| `nerf/geometry/rays.py` | rays |\nnerf/model.py") == ["nerf/geometry/rays.py"]
    headings = "# A `b`, c_d\n```\n# e\n```\n## See [f](g)\n## A b c_d\n"
    assert list(anchors(headings)) == ["a-b-c_d", "see-f", "a-b-c_d-1"]
    assert prose("Words\n```\ncode\n```\n| table |\n<!-- studies -->\nx\n<!-- end of studies -->\n") == ["Words", ""]
    assert calls_of_run('run(a, inputs)\nrun(a, a.Config())\nc = run(b, b.Config(d=(1, 2)), ["a", "e"])\n') == [
        ("a", ()),
        ("b", ("a", "e")),
    ]
