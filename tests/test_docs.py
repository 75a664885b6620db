"""The documentation agrees with the code: links, options, the example in Python, the table of modules."""

import json
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from benchmarks import results
from nerf.geometry.scene import Camera, Scene, Similarity, View
from pipeline.engine.stage_list import STAGES
from stages.evaluate.summary import FIGURES
from stages.io.photos import Photo
from tests.test_architecture import OURS
from tests.wording import codes_of, made

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
CHANGELOG = ROOT / "CHANGELOG.md"
GENERATED = {ROOT / "docs" / "NUMERICS.md", ROOT / "docs" / "results.md"}
MAX_PROSE = 128
MAX_RESULTS = 250
LINK = re.compile(r"\]\(([^)\s]+)\)")
OPTION = re.compile(rf"--({'|'.join(STAGES)})\.([a-z][a-z0-9_-]*(?:\.[a-z][a-z0-9_-]*)?)")
CALL = re.compile(r"(?m)^(?:\w+ = )?run\((\w+)\.STAGE, \1\.Config\(.*\)\)$")
CODE = re.compile(r"(?ms)^```(\w*)$\n(.*?)^```$\n")
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
ERROR = re.compile(r"`((?:ingest|io|sfm|render|mesh|normalise)\.[a-z]+(?:-[a-z]+)+)`")
MODULE = re.compile(r"(?m)^\| `((?:nerf|stages|pipeline)/[\w/]+\.py)` \|")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def options_of(stage: str) -> set[str]:
    """The dotted flags of a stage, without those that the command line fills in itself."""
    return {name.replace("_", "-") for name, _ in STAGES[stage].config.flags()}


def flags_of(stage: str) -> set[str]:
    """:func:`options_of`, and how switches are turned off."""
    switches = [name.replace("_", "-") for name, option in STAGES[stage].config.flags() if option.annotation is bool]
    return options_of(stage) | {re.sub(r"([\w-]+)$", r"no-\1", switch) for switch in switches}


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
    """Lines that are no code, no table and no picture."""
    return [line for line in CODE.sub("", text).splitlines() if not line.lstrip().startswith(("|", "!["))]


def dead_links(page: Path) -> Iterator[str]:
    """What a page points at and nobody finds."""
    for target in LINK.findall(page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        other = page.parent / path if path else page
        if not other.exists() or (anchor and anchor not in anchors(other.read_text("utf-8"))):
            yield f"{page.name}: {target}"


def unlike_the_code(stage: str, page: str) -> Iterator[str]:
    """Options whose default in the table is not the code's. One that is chosen (None) is described in words."""
    for name, option in STAGES[stage].config.flags():
        if isinstance(option.default, bool) or not isinstance(option.default, int | float):
            continue
        flag = f"--{stage}.{name.replace('_', '-')}"
        row = re.search(rf"(?m)^\| `{flag}` \| ([^|]+) \|", page)
        if not row or float(row[1]) != option.default:
            yield flag


def page_of(stage: str) -> str:
    return (ROOT / "docs" / "stages" / f"{stage}.md").read_text("utf-8")


def test_links_lead_somewhere():
    assert [dead for page in [*PAGES, CHANGELOG] for dead in dead_links(page)] == []


def test_prose_is_wrapped():
    lines = {name_of(page): prose(page.read_text("utf-8")) for page in [*PAGES, CHANGELOG] if page not in GENERATED}
    assert [f"{page}: {line}" for page in lines for line in lines[page] if len(line) > MAX_PROSE] == []


def test_results_are_what_the_json_files_give():
    assert results.PAGE.read_text("utf-8") == results.page(), "python -m benchmarks.results"
    assert len(results.page().splitlines()) <= MAX_RESULTS


def test_every_file_of_figures_says_where_they_come_from():
    records = {path.name: json.loads(path.read_text("utf-8")) for path in results.RESULTS.glob("*.json")}
    assert len(records) > 20
    wanted = {"command", "date", "machine", "commit", "figures"}
    assert not [name for name, record in records.items() if not (wanted <= record.keys() and record["figures"])]


def test_the_example_in_python_gives_stages_what_they_need():
    stages = CALL.findall((ROOT / "docs" / "PYTHON.md").read_text("utf-8"))
    assert len(stages) > 5
    assert [stage for k, stage in enumerate(stages) if not {*STAGES[stage].inputs} <= {*stages[:k]}] == []


def test_the_pages_are_linked():
    linked = {
        (page.parent / target.split("#")[0]).resolve() for page in PAGES for target in LINK.findall(page.read_text())
    }
    folders = {path for path in linked if path.is_dir()}
    assert not [name_of(page) for page in PAGES[1:] if page not in linked and page.parent not in folders]


def test_options_named_exist():
    """In documents, and in what the program says."""
    texts = {name_of(page): page.read_text("utf-8") for page in PAGES} | {module.name: module.text for module in OURS}
    named = [(name, stage, option) for name, text in texts.items() for stage, option in sorted(documented(text))]
    assert [f"{name}: --{stage}.{option}" for name, stage, option in named if option not in flags_of(stage)] == []


def test_every_option_is_on_its_stages_page():
    named = {stage: {option for of, option in documented(page_of(stage)) if of == stage} for stage in STAGES}
    missing = [f"--{stage}.{option}" for stage in STAGES for option in sorted(options_of(stage) - named[stage])]
    assert missing == []


def test_defaults_in_the_tables_are_those_of_the_code():
    assert [option for stage in STAGES for option in unlike_the_code(stage, page_of(stage))] == []


def test_the_table_of_modules_is_complete():
    listed = MODULE.findall((ROOT / "docs" / "ARCHITECTURE.md").read_text("utf-8"))
    modules = [name_of(path) for package in ("nerf", "stages", "pipeline") for path in (ROOT / package).rglob("*.py")]
    assert len(modules) > 60
    assert sorted(listed) == sorted(modules)


def test_examples_of_files_name_every_key():
    page = (ROOT / "docs" / "FILES.md").read_text("utf-8")
    wanted = {
        "photos.json": {field.name for field in fields(Photo)},
        "scene.json": {field.name for kind in (Scene, View, Camera, Similarity) for field in fields(kind)},
        "metrics.json": set(FIGURES),
    }
    shown = {name: set(re.findall(r'"(\w+)"', page.split(f"## {name} ")[1].split("\n## ")[0])) for name in wanted}
    assert {name: keys - shown[name] for name, keys in wanted.items() if keys - shown[name]} == {}


def test_formats_name_tests_and_codes_that_exist():
    page = (ROOT / "docs" / "FORMATS.md").read_text("utf-8").replace("TESTS/", "tests/stages/")
    tests = set(TEST.findall(page))
    gone = [f"{path}::{name}" for path, name in tests if f"\ndef {name}(" not in (ROOT / path).read_text("utf-8")]
    assert len(tests) > 60 and gone == []
    codes = {code for module in OURS for call in made(module.tree) for code in codes_of(call, module)}
    named = set(ERROR.findall(page))
    assert len(named) > 30 and named <= codes, named - codes
    rows = [row for row in page.splitlines() if row.startswith("| ") and not row.endswith((" test |", " out |"))]
    assert [row for row in rows if "::" not in row and "](#" not in row] == []


def test_the_checks_can_fail(tmp_path: Path):
    assert documented("`--train.steps 500` and --mesh.max-faces") == {("train", "steps"), ("mesh", "max-faces")}
    assert "photos" not in options_of("ingest") and "cameras" not in options_of("sfm")
    assert "cameras" in options_of("render") and "no-depth" in flags_of("render")
    assert "steppes" not in flags_of("train") and "vanilla.no-hierarchical" in flags_of("train")
    assert documented("`--train.grid.max-res 9`, --train.seconds.") == {("train", "grid.max-res"), ("train", "seconds")}
    assert list(unlike_the_code("train", page_of("train").replace("| 0 |", "| 1 |"))) == ["--train.seed"]
    nowhere = tmp_path / "page.md"
    nowhere.write_text("# Here\n[a](b.md) [b](#here) [c](#there) [d](https://example.org)\n", "utf-8")
    assert [dead.split(": ")[1] for dead in dead_links(nowhere)] == ["b.md", "#there"]
    assert MODULE.findall("| `nerf/geometry/rays.py` | rays |\nnerf/model.py") == ["nerf/geometry/rays.py"]
    headings = "# A `b`, c_d\n```\n# e\n```\n## See [f](g)\n## A b c_d\n"
    assert list(anchors(headings)) == ["a-b-c_d", "see-f", "a-b-c_d-1"]
    assert prose("Words\n```\ncode\n```\n| table |\n![picture](a.png)\n") == ["Words"]
    assert CALL.findall("run(a, inputs)\nrun(a.STAGE, a.Config())\nc = run(b.STAGE, b.Config(d=(1, 2)))\n") == [
        "a",
        "b",
    ]
