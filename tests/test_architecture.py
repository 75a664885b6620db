"""The rules of the house, checked on the source as it stands: one test a rule, which lists who breaks it."""

import ast
import graphlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest

from pipeline.engine.stage_list import STAGES
from stages.contract import Stage

ROOT = Path(__file__).parents[1]
PACKAGES = ("nerf", "stages", "pipeline")
MAY_IMPORT = {"nerf": {"nerf"}, "stages": {"nerf", "stages"}, "pipeline": {"nerf", "stages", "pipeline"}}
PIPELINE_ORDER = (
    "schedule",
    "engine",
    "doctor",
    "demo",
    "view",
    "batch",
    "cli",
    "__main__",
)  # each imports those before it alone
NERF_MAY_USE = {"torch", "numpy", "jaxtyping"}
DISK = {"pathlib", "os", "io", "shutil", "tempfile"}
KERNELS = "nerf/kernels/warp/"  # alone may use Warp, whose kernels name all their arrays
COLMAP = "stages/sfm/colmap/"
MAX_FUNCTION_LINES, MAX_ARGUMENTS, MAX_MEDIAN_FUNCTION_LINES = 60, 8, 20
MAX_KERNEL_ARGUMENTS = 16
MAX_ENTRIES = 15
MAX_TEST_NAME_WORDS = 10
ALLOWED_BASES = {"Module", "Function", "Exception", "BaseException", "Enum", "IntEnum", "NamedTuple", "Protocol"} | {
    "BaseModel",
    "Generic",
    "Options",
    "StageConfig",
}
# 20 ms to 4 s each, so the command line starts without them.
SLOW = {
    *("torch", "warp", "pycolmap", "kornia", "cv2", "trimesh", "skimage", "scipy", "matplotlib", "PIL", "pillow_heif"),
    *("numpy", "jaxtyping", "safetensors", "jinja2", "rich", "fast_simplification", "imageio_ffmpeg"),
    *("starlette", "uvicorn", "ray"),
}
ONLY_ON_UNIX = {"resource", "fcntl", "termios"}
LATE = {
    "pipeline/__main__.py": "Ctrl-C ends the program quietly while Python still reads it",
    "stages/train/validation_images.py": "kornia takes seconds, and few trainings score whole patches",
    "pipeline/view/workspace_state.py": "the page is there at once, and torch takes seconds, which only a field needs",
    "benchmarks/nerfacto.py": "a part runs in nerfstudio's environment, where ours is not installed",
}
# What a test may replace beside the package that it mirrors (tests/stages/mesh: stages/mesh), and libraries.
BOUNDARIES = {
    "nerf.runtime.parallel.": "how many threads work",
    "nerf.kernels.warp": "whether Warp runs here",
    "nerf.training.hash_grid_trainer.HashGridTrainer.": "a step, at which training is interrupted or spoilt",
    "stages.hardware.": "the machine",
    "stages.io.stopwatch.": "time",
    "stages.render.renderer.": "how fast which field renders",
    "stages.train.profile.measure_rates": "how fast the machine is",
    "pipeline.engine.runner.STAGES": "a chain of made-up stages",
}
MACHINE = ("time", "cores", "processors", "compute_device", "available_bytes", "available_on")  # wherever imported
PATCHING = ("setattr", "setitem", "delattr")
NO_SUBJECT = ("utils.py", "util.py", "helpers.py", "misc.py", "common.py")
BACKENDS = ("torch", "warp")
PLURAL_ENDINGS = ("s", "es", "ies")
BANNED_CALLS = ("cumprod", "torch.load", "eval")
BANNED_TEXT = ("nan_to_num", "pickle.load", "except Exception: pass", "except:")


class Module(NamedTuple):
    """A file of source: its path from the root, its text, and what Python reads in it."""

    name: str
    text: str
    tree: ast.Module


Rule = Callable[[Module], Iterator[str]]


def module(name: str, text: str) -> Module:
    return Module(name, text, ast.parse(text))


def read(folders: Iterable[str]) -> list[Module]:
    paths = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    return [module(path.relative_to(ROOT).as_posix(), path.read_text("utf-8")) for path in paths]


OURS = read(PACKAGES)
NERF = [module for module in OURS if module.name.startswith("nerf/")]
AROUND = read(("tests", "benchmarks"))


def offenders(rule: Rule, modules: Iterable[Module]) -> list[str]:
    """``file: what is wrong`` for everything in the modules that breaks the rule."""
    return [f"{module.name}: {wrong}" for module in modules for wrong in rule(module)]


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (function.end_lineno or 0) - function.lineno + 1


def imported(tree: ast.AST) -> set[str]:
    """Top-level names of every module imported anywhere in ``tree``."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def calls(tree: ast.AST) -> set[str]:
    """Names of all that is called, as it is written."""
    return {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}


def renamed_imports(module: Module) -> Iterator[str]:
    """Modules and functions of ours under another name than their own. Backends may stand beside torch and Warp."""
    for node in ast.walk(module.tree):
        if not isinstance(node, ast.ImportFrom) or (node.module or "").split(".")[0] not in (*PACKAGES, "tests"):
            continue
        for alias in node.names:
            if alias.asname and alias.name.islower() and alias.name not in BACKENDS:
                yield f"{node.module}.{alias.name} as {alias.asname}"


def dotted(module: Module) -> str:
    return module.name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports_of(tree: ast.AST, in_function: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Imports that run, and whether in a function; those for types alone do not."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, in_function
        elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield from imports_of(node, in_function or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def loaded_by(node: ast.Import | ast.ImportFrom, known: Iterable[str]) -> set[str]:
    """Modules that an import loads, the packages around them not counted."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    names = {f"{node.module}.{alias.name}" for alias in node.names}
    return {name if name in known else node.module or "" for name in names}


def with_packages(name: str) -> set[str]:
    """a.b.c → a, a.b, a.b.c: all are loaded."""
    parts = name.split(".")
    return {".".join(parts[:count]) for count in range(1, len(parts) + 1)}


def late_imports(modules: Iterable[Module]) -> list[str]:
    """Imports in functions that keep nothing slow out of the start: the module loads what is slow anyway, or what it
    imports late is not slow."""
    by_name = {dotted(module): module for module in modules}
    found = {name: [*imports_of(module.tree)] for name, module in by_name.items()}
    loaded = {
        name: {
            part
            for node, late in found[name]
            if not late
            for n in loaded_by(node, by_name)
            for part in with_packages(n)
        }
        | (with_packages(name) - {name})
        for name in by_name
    }
    slow = set(SLOW)
    while more := {name for name in loaded if name not in slow and loaded[name] & slow}:
        slow |= more
    wrong = []
    for name, module in by_name.items():
        late = [node for node, in_function in found[name] if in_function and module.name not in LATE]
        for node in late:
            parts = {part for loaded in loaded_by(node, by_name) for part in with_packages(loaded)}
            if (name in slow or not parts & slow) and not parts & ONLY_ON_UNIX:
                wrong.append(f"{module.name}: {ast.unparse(node)}")
    return wrong


def modules_imported(module: Module, known: set[str]) -> set[str]:
    """Modules among ``known`` that this one imports as it runs, at its top or in a function."""
    return {name for node, _ in imports_of(module.tree) for name in loaded_by(node, known)} & known


def cycle(modules: Iterable[Module]) -> list[str]:
    """Modules that import each other in a circle; [] where there are none."""
    by_name = {dotted(module): module for module in modules}
    graph = {name: modules_imported(module, set(by_name)) - {name} for name, module in by_name.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def imports_out_of_order(module: Module) -> Iterator[str]:
    """Of modules of pipeline, what they import of packages of it that stand after theirs."""
    parts = dotted(module).split(".")
    if parts[0] != "pipeline" or len(parts) < 2:
        return
    names = [node.module or "" for node in ast.walk(module.tree) if isinstance(node, ast.ImportFrom)]
    for name in (name.split(".") for name in names):
        later = (
            PIPELINE_ORDER.index(parts[1]) < PIPELINE_ORDER.index(name[1]) if name[0] == "pipeline" and name[1:] else 0
        )
        if later:
            yield f"imports {'.'.join(name)}"


def imports_against_the_current(module: Module) -> Iterator[str]:
    yield from sorted(imported(module.tree) & set(PACKAGES) - MAY_IMPORT[module.name.split("/")[0]])


def what_nerf_does_without(module: Module) -> Iterator[str]:
    allowed = NERF_MAY_USE | ({"warp"} if module.name.startswith(KERNELS) else set())
    used = imported(module.tree)
    yield from sorted(used - (set(sys.stdlib_module_names) - {"__future__"}) - {"nerf"} - allowed)
    yield from sorted(used & DISK)
    yield from calls(module.tree) & {"open"}


def users_of_pycolmap(module: Module) -> Iterator[str]:
    if "pycolmap" in imported(module.tree) and not module.name.startswith(COLMAP):
        yield "pycolmap"


def names_without_a_subject(module: Module) -> Iterator[str]:
    if module.name.split("/")[-1] in NO_SUBJECT:
        yield "says nothing of what is in it"


def long_functions(module: Module) -> Iterator[str]:
    for function in functions(module.tree):
        if (lines := lines_of(function)) > MAX_FUNCTION_LINES:
            yield f"{function.name} has {lines} lines"


def functions_of_many_arguments(module: Module) -> Iterator[str]:
    most = MAX_KERNEL_ARGUMENTS if module.name.startswith(KERNELS) else MAX_ARGUMENTS
    for function in functions(module.tree):
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        count = len([argument for argument in arguments if argument.arg not in ("self", "cls")])
        if count > most:
            yield f"{function.name} takes {count} arguments"


def unusual_bases(module: Module) -> Iterator[str]:
    for node in ast.walk(module.tree):
        for base in node.bases if isinstance(node, ast.ClassDef) else ():
            inner = base.value if isinstance(base, ast.Subscript) else base
            name = inner.attr if isinstance(inner, ast.Attribute) else getattr(inner, "id", "")
            if name not in ALLOWED_BASES:
                yield f"{ast.unparse(base)} is inherited from"


def masked_faults(module: Module) -> Iterator[str]:
    yield from (f"{banned} is banned" for banned in BANNED_TEXT if banned in module.text)
    names = calls(module.tree)
    last = {name.split(".")[-1] for name in names if "model" not in name and name != "self.eval"}
    yield from (f"{banned}() is banned" for banned in BANNED_CALLS if banned in names | last)


def swallowed_errors(module: Module) -> Iterator[str]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.ExceptHandler):
            only_pass = len(node.body) == 1 and isinstance(node.body[0], ast.Pass)
            if only_pass and (node.type is None or ast.unparse(node.type) in ("Exception", "BaseException")):
                yield f"line {node.lineno} swallows an error"
        if (
            isinstance(node, ast.Call)
            and ast.unparse(node.func).endswith("suppress")
            and {ast.unparse(argument) for argument in node.args} & {"Exception", "BaseException"}
        ):
            yield f"line {node.lineno} swallows an error"


def hidden_zeros(module: Module) -> Iterator[str]:
    """x / (y + 1e-8) hides where y reaches 0."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            bottom = node.right
            if isinstance(bottom, ast.BinOp) and isinstance(bottom.op, ast.Add):
                constants = [c.value for c in (bottom.left, bottom.right) if isinstance(c, ast.Constant)]
                if any(isinstance(c, float) and 0 < c < 1e-3 for c in constants):
                    yield ast.unparse(node)


def hand_made_plurals(module: Module) -> Iterator[str]:
    """Endings by a count, which :func:`stages.io.amounts.counted` knows."""
    for node in ast.walk(module.tree):
        parts = (node.body, node.orelse) if isinstance(node, ast.IfExp) else ()
        parts = (node.left,) if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) else parts
        if any(isinstance(part, ast.Constant) and part.value in PLURAL_ENDINGS for part in parts):
            yield ast.unparse(node)


def spaced_percentages(module: Module) -> Iterator[str]:
    """``5 %`` in what is printed: ``{share:.0%}`` writes 5%, and one style is enough."""
    for node in ast.walk(module.tree):
        parts = node.values if isinstance(node, ast.JoinedStr) else []
        if any(isinstance(part, ast.Constant) and str(part.value).startswith(" %") for part in parts[1:]):
            yield ast.unparse(node)


def calls_of_plan(module: Module) -> Iterator[str]:
    """Calls of a stage's plan() beside :func:`stages.contract.plan_stage`."""
    for name in calls(module.tree):
        if name.split(".")[-1] == "plan" and module.name != "stages/contract.py":
            yield f"{name}()"


def origins(tree: ast.AST) -> dict[str, str]:
    """Where each imported name is from, dotted."""
    found: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {
                alias.asname or alias.name.split(".")[0]: (alias.asname and alias.name) or alias.name.split(".")[0]
                for alias in node.names
            }
    return found


def patched(tree: ast.AST) -> Iterator[str]:
    """The dotted path of everything imported that monkeypatch replaces. What a test made itself is its own."""
    names = origins(tree)
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in PATCHING):
            continue
        target, root = node.args[0], node.args[0]
        if isinstance(target, ast.JoinedStr):
            target = target.values[0]
        if isinstance(target, ast.Constant) and isinstance(target.value, str):
            yield target.value
        while isinstance(root, ast.Attribute | ast.Subscript):
            root = root.value
        if isinstance(root, ast.Name) and root.id in names:
            attribute = node.args[1].value if isinstance(node.args[1], ast.Constant) else "*"
            yield f"{names[root.id]}{ast.unparse(target).removeprefix(root.id)}.{attribute}"


def foreign_patches(module: Module) -> Iterator[str]:
    """What a test replaces in a package of ours that it does not mirror, and that is no boundary."""
    mirrored = ".".join(module.name.split("/")[1:-1])
    for path in patched(module.tree):
        ours = path.split(".")[0] in PACKAGES
        tested = mirrored.split(".")[0] in PACKAGES and path.startswith(f"{mirrored}.")
        if ours and not tested and path.split(".")[-1] not in MACHINE and not path.startswith(tuple(BOUNDARIES)):
            yield path


def long_test_names(module: Module) -> Iterator[str]:
    for function in functions(module.tree):
        if function.name.startswith("test_") and function.name.count("_") > MAX_TEST_NAME_WORDS:
            yield function.name


def test_imports_go_one_way():
    assert offenders(imports_against_the_current, OURS) == []


def test_no_modules_import_each_other_in_a_circle():
    assert cycle(OURS) == []
    circle = [module("a.py", "def f():\n    from b import g"), module("b.py", "import a"), module("c.py", "import a")]
    assert set(cycle(circle)) == {"a", "b"}
    types = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import b"
    assert cycle([module("a.py", types), module("b.py", "import a")]) == []


def test_only_slow_imports_stand_in_functions():
    assert late_imports([*OURS, *AROUND]) == []
    late = "def f():\n    import %s"
    light, heavy = module("light.py", "import math"), module("heavy.py", "import torch.nn")
    assert late_imports([light, heavy, module("a.py", late % "heavy"), module("b.py", late % "torch")]) == []
    assert late_imports([light, module("a.py", late % "light")]) == ["a.py: import light"]
    assert late_imports([heavy, module("a.py", f"import heavy\n{late % 'kornia'}")]) == ["a.py: import kornia"]
    assert late_imports([module("a/__init__.py", "import cv2"), module("a/b.py", late % "scipy")]) != []


def test_packages_of_pipeline_import_one_way():
    assert offenders(imports_out_of_order, OURS) == []


def test_what_is_imported_keeps_its_name():
    assert offenders(renamed_imports, [*OURS, *AROUND]) == []


def test_nerf_needs_little_and_stays_off_the_disk():
    assert offenders(what_nerf_does_without, NERF) == []


def test_every_folder_is_a_table_of_contents():
    folders = {(ROOT / module.name).parent for module in OURS} | {ROOT / package for package in PACKAGES}
    entries = {folder: {child.name for child in folder.iterdir()} - {"__pycache__"} for folder in folders}
    entries[ROOT / "stages"] -= set(STAGES)  # a package each: the stage list is their table of contents
    assert {folder: len(names) for folder, names in entries.items() if len(names) > MAX_ENTRIES} == {}


def test_only_one_package_speaks_to_pycolmap():
    assert offenders(users_of_pycolmap, OURS) == []


def test_modules_are_named_after_a_subject():
    assert offenders(names_without_a_subject, [*OURS, *AROUND]) == []


def test_no_function_is_long():
    assert offenders(long_functions, OURS) == []


def test_functions_are_short_on_the_whole():
    lengths = sorted(lines_of(function) for module in OURS for function in functions(module.tree))
    assert 1 < lengths[len(lengths) // 2] < MAX_MEDIAN_FUNCTION_LINES


def test_functions_take_few_arguments():
    assert offenders(functions_of_many_arguments, OURS) == []


def test_inheritance_is_rare():
    assert offenders(unusual_bases, OURS) == []


def test_stages_are_planned_in_one_place():
    contract = [module for module in OURS if module.name == "stages/contract.py"]
    assert "stage.plan" in calls(contract[0].tree)
    assert (
        offenders(calls_of_plan, [*OURS, *(module for module in AROUND if module.name.startswith("benchmarks"))]) == []
    )


def test_tests_patch_what_they_test():
    assert offenders(foreign_patches, AROUND) == []


def test_names_of_tests_have_few_words():
    assert offenders(long_test_names, AROUND) == []


def test_nothing_masks_a_fault():
    assert offenders(masked_faults, OURS) == []


def test_no_error_is_swallowed():
    assert offenders(swallowed_errors, OURS) == []


def test_no_division_hides_a_zero():
    assert offenders(hidden_zeros, OURS) == []


def test_messages_count_in_one_way():
    assert offenders(hand_made_plurals, [module for module in OURS if module not in NERF]) == []


def test_messages_write_percentages_in_one_way():
    assert offenders(spaced_percentages, OURS) == []


MANY = ", ".join("abcdefghi")
BROKEN: dict[Rule, list[tuple[str, str]]] = {
    imports_against_the_current: [("nerf/a.py", "def f():\n    import stages.io"), ("stages/a.py", "import pipeline")],
    imports_out_of_order: [("pipeline/engine/a.py", "def f():\n    from pipeline.cli.arguments import x")],
    renamed_imports: [
        ("tests/a.py", "from stages.io import photos as module"),
        ("pipeline/a.py", "from stages import train as trained"),
    ],
    what_nerf_does_without: [
        ("nerf/a.py", "import scipy"),
        ("nerf/a.py", "import warp"),
        ("nerf/a.py", "from __future__ import annotations"),
        ("nerf/a.py", "from pathlib import Path"),
        ("nerf/a.py", "open('a')"),
    ],
    long_test_names: [("tests/a.py", f"def test{'_a' * (MAX_TEST_NAME_WORDS + 1)}(): 1")],
    calls_of_plan: [("stages/a.py", "plan(config)"), ("benchmarks/a.py", "train.plan(config)")],
    foreign_patches: [
        ("tests/stages/mesh/test_a.py", "monkeypatch.setattr('stages.train.loop.MIN_STEPS', 1)"),
        ("tests/stages/mesh/test_a.py", "from stages.train import loop\npatch.setattr(loop, 'MIN_STEPS', 1)"),
        ("tests/stages/mesh/test_a.py", "from stages.train.loop import Run\npatch.setattr(Run, 'step', 1)"),
    ],
    users_of_pycolmap: [("stages/sfm/a.py", "import pycolmap")],
    names_without_a_subject: [("stages/sfm/utils.py", "")],
    long_functions: [("a.py", "def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES)],
    functions_of_many_arguments: [("a.py", f"def f({MANY}): pass"), ("a.py", f"class A:\n  def f(self, *, {MANY}): 1")],
    unusual_bases: [("a.py", "class A(dict): pass"), ("a.py", "class A(list[int]): pass")],
    masked_faults: [
        ("a.py", "x = torch.nan_to_num(y)"),
        ("a.py", "x = torch.cumprod(y)"),
        ("a.py", "x = y.cumprod(0)"),
        ("a.py", "torch.load('a')"),
        ("a.py", "eval('a')"),
        ("a.py", "pickle.load(file)"),
        ("a.py", "try: a()\nexcept: b()"),
    ],
    swallowed_errors: [
        ("a.py", "try: a()\nexcept Exception:\n    pass"),
        ("a.py", "try: a()\nexcept BaseException:\n    pass"),
        ("a.py", "with contextlib.suppress(Exception): a()"),
    ],
    hand_made_plurals: [
        ("a.py", "f\"{n} photo{'' if n == 1 else 's'}\""),
        ("a.py", "f\"{n} photo{'s' * (n != 1)}\""),
        ("a.py", "f\"{n} strateg{'y' if n == 1 else 'ies'}\""),
    ],
    spaced_percentages: [("a.py", "f'{share:.0f} % of it'")],
    hidden_zeros: [("a.py", "x / (y + 1e-8)"), ("a.py", "x / (1e-8 + y)")],
}


@pytest.mark.parametrize("rule", BROKEN, ids=lambda rule: rule.__name__)
def test_who_breaks_a_rule_is_found(rule: Rule):
    assert len(OURS) > 100 and len(NERF) > 30 and len(AROUND) > 100
    for name, text in BROKEN[rule]:
        assert len(offenders(rule, [module(name, text)])) == 1, text


def test_the_command_line_starts_without_heavy_imports():
    code = "import sys, pipeline.cli.commands; print([m for m in sys.argv[1].split() if m in sys.modules])"
    answer = subprocess.run(
        [sys.executable, "-c", code, " ".join(SLOW)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"


def test_every_stage_keeps_the_contract():
    assert len({stage.exit_code for stage in STAGES.values()}) == len(STAGES)
    seen: list[str] = []
    for name, stage in STAGES.items():
        package = import_module(f"stages.{name}")
        assert package.STAGE is stage
        assert set(stage.inputs) <= set(seen), f"{name} needs a stage that comes after it"
        assert stage.run.__doc__ and stage.config.__doc__ and package.__doc__
        seen.append(name)


def test_stages_end_with_what_they_declare_in_one_order():
    order = [field.name for field in fields(Stage)]
    for name in STAGES:
        (last,) = [module.tree.body[-1] for module in OURS if module.name == f"stages/{name}/__init__.py"]
        assert isinstance(last, ast.Assign) and ast.unparse(last.targets[0]) == "STAGE"
        assert isinstance(last.value, ast.Call) and ast.unparse(last.value.func) == "Stage"
        declared = [keyword.arg or "" for keyword in last.value.keywords]
        assert declared == sorted(declared, key=order.index)


def test_options_are_documented():
    options = [(f"{stage}.{name}", option) for stage in STAGES for name, option in STAGES[stage].config.flags()]
    assert "train.grid.max_res" in dict(options)
    assert [name for name, option in options if not option.description] == []
    assert [name for name, option in options if option.default is None and "default: " not in option.description] == []
