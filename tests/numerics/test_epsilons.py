"""Every number in nerf/ that looks like an epsilon has a name, and beside the name the reason."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
SMALLEST, LARGEST = 1e-30, 1.000001e-5
# (file, line without blanks): why it may stand without a name.
ALLOWED: dict[tuple[str, str], str] = {}
FILES = sorted((ROOT / "nerf").rglob("*.py"))
NAME = re.compile(r"^_?[A-Z][A-Z0-9_]*$")


def unexplained(source: str) -> list[str]:
    """Lines with a number between SMALLEST and LARGEST that is neither part of a constant named at the top of the
    module nor, being that, has a comment in its line, right above it, or as a docstring below."""
    lines, tree = source.splitlines(), ast.parse(source)
    explained: set[int] = set()
    for statement, following in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(statement, ast.Assign | ast.AnnAssign) and _is_constant(statement):
            own = range(statement.lineno, (statement.end_lineno or statement.lineno) + 1)
            docstring = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            above = lines[statement.lineno - 2].startswith("#") if statement.lineno > 1 else False
            if above or docstring or any("#" in lines[number - 1] for number in own):
                explained |= set(own)
    small = {
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, float) and SMALLEST <= abs(node.value) <= LARGEST
    }
    return [lines[number - 1].strip() for number in sorted(small - explained)]


def _is_constant(statement: ast.Assign | ast.AnnAssign) -> bool:
    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
    return all(isinstance(target, ast.Name) and NAME.match(target.id) for target in targets)


def test_every_small_number_has_a_name_and_a_reason() -> None:
    left = {path.relative_to(ROOT).as_posix(): unexplained(path.read_text("utf-8")) for path in FILES}
    assert [f"{name}: {line}" for name in left for line in left[name] if (name, line) not in ALLOWED] == []


def test_what_is_allowed_is_there_and_has_a_reason() -> None:
    for (name, line), reason in ALLOWED.items():
        assert reason and line in unexplained((ROOT / name).read_text("utf-8"))


def test_small_numbers_are_found() -> None:
    named = "# Why.\nTINY = 1e-8\nLESS = 1e-9  # why\nLEAST: float = 1e-12\n'''Why.'''\n"
    assert unexplained(named) == []
    assert unexplained(named + "MUTE = 1e-7\n") == ["MUTE = 1e-7"]
    assert unexplained("def f(x, y):\n    return x / (y + 1e-8)  # why\n") == ["return x / (y + 1e-8)  # why"]
    assert unexplained("x = 1e-10  # no constant\n") == ["x = 1e-10  # no constant"]
    assert unexplained("y = 0.5 + 1e-4 + 1e-45 + 3\n") == []
    assert len(FILES) > 40
