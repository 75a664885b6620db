"""How errors and notes are worded, in one snapshot a stage: ``python -m tests.wording`` writes them from the source.

A snapshot is tests/stages/<stage>/messages.txt, or tests/pipeline/messages.txt: each code with what happened, why, and
what to try, or what a note says. A value that the program fills in stands there in braces as the source names it; where
one of several sentences is chosen, each has a line.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.test_architecture import OURS, ROOT, Module

SNAPSHOT = "messages.txt"


def makers(modules: list[Module]) -> dict[str, ast.FunctionDef | None]:
    """What makes an error or a note, and the functions that are given its code, with how they are defined."""
    found: dict[str, ast.FunctionDef | None] = {"StageError": None, "Note": None, "DecodeError": None}
    for node in (node for module in modules for node in ast.walk(module.tree)):
        if isinstance(node, ast.FunctionDef) and node.args.args and node.args.args[0].arg == "code":
            found[node.name] = node
    return found


MAKERS = makers(OURS)


def package_of(module: Module) -> str:
    """``stages/sfm`` for all of that stage, ``pipeline`` for all of the pipeline."""
    parts = module.name.split("/")
    return "/".join(parts[:2]) if parts[0] == "stages" else parts[0]


def made(tree: ast.AST) -> Iterator[ast.Call]:
    """Calls that make an error, a note, or a reason why a file is no photo."""
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and node.args and not isinstance(node.args[0], ast.Starred)):
            continue
        makes = isinstance(node.func, ast.Name) and node.func.id in MAKERS
        notes = (isinstance(node.func, ast.Attribute) and node.func.attr == "note") or ast.unparse(node.func) == "note"
        if (makes or notes) and ast.unparse(node.args[0]) != "error.code":
            yield node


@cache
def assigned(tree: ast.AST, own: bool = False) -> dict[str, list[ast.expr]]:
    """What stands behind a name: every expression that it is given in ``tree``, or at its top alone (``own``)."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.iter_child_nodes(tree) if own else ast.walk(tree):
        if isinstance(node, ast.For) and isinstance(node.target, ast.Tuple) and isinstance(node.iter, ast.Tuple):
            for row in node.iter.elts:
                for name, value in zip(node.target.elts, row.elts if isinstance(row, ast.Tuple) else [], strict=False):
                    found.setdefault(ast.unparse(name), []).append(value)
        if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                names = target.elts if isinstance(target, ast.Tuple) else [target]
                values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value] * len(names)
                for name, value in zip(names, values, strict=False):
                    found.setdefault(ast.unparse(name), []).append(value)
    return found


def filled_in(value: ast.expr) -> str:
    """What the program fills in, in braces; what it counts as its number and what several of it are called."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "counted":
        count, *names = value.args
        if all(isinstance(name, ast.Constant) for name in names):
            one, *many = [str(ast.literal_eval(name)) for name in names] or ["photo"]
            return f"{{{ast.unparse(count)}}} {many[0] if many else f'{one}s'}"
    return "{" + ast.unparse(value) + "}"


def sentences(expression: ast.expr, names: dict[str, list[ast.expr]], depth: int = 3) -> list[str]:
    """The texts that an expression may have, values in braces."""
    if isinstance(expression, ast.Constant):
        return [str(expression.value)]
    if isinstance(expression, ast.IfExp):
        return [*sentences(expression.body, names, depth), *sentences(expression.orelse, names, depth)]
    if isinstance(expression, ast.BoolOp):
        return [text for value in expression.values for text in sentences(value, names, depth)]
    if isinstance(expression, ast.Name) and depth and expression.id in names:
        return [text for value in names[expression.id] for text in sentences(value, names, depth - 1)]
    if isinstance(expression, ast.JoinedStr):
        parts = [
            part.value if isinstance(part, ast.Constant) else filled_in(part.value)
            for part in expression.values
            if isinstance(part, ast.Constant | ast.FormattedValue)
        ]
        return ["".join(map(str, parts))]
    return [filled_in(expression)]


@cache
def functions_around(tree: ast.AST) -> dict[ast.AST, list[ast.FunctionDef]]:
    """The functions in which each node of ``tree`` stands, outermost first."""
    around: dict[ast.AST, list[ast.FunctionDef]] = {}
    for scope in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in ast.walk(scope):
            around.setdefault(node, []).append(scope)
    return around


def codes_of(call: ast.Call, module: Module) -> list[str]:
    """The codes that a call may give: several where a name stands for one of them, none where a caller gives it."""
    scopes = functions_around(module.tree).get(call, [])
    given = {argument.arg for scope in scopes for argument in scope.args.args}
    names = assigned(module.tree, own=True) | {k: v for scope in scopes for k, v in assigned(scope).items()}
    code = call.args[0]
    if isinstance(code, ast.Subscript) or (isinstance(code, ast.Name) and code.id in given):
        return []
    return sentences(code, names)


def wording(module: Module) -> Iterator[tuple[str, list[str]]]:
    """Each code of a module with how it is worded."""
    constants = assigned(module.tree, own=True)

    def texts(call: ast.Call, parts: list[ast.expr]) -> list[str]:
        scopes = functions_around(module.tree).get(call, [])
        names = constants | {name: values for scope in scopes for name, values in assigned(scope).items()}
        return list(dict.fromkeys(text for part in parts for text in sentences(part, names)))

    for call in made(module.tree):
        for code in codes_of(call, module):
            yield code, texts(call, call.args[1:])


def snapshots() -> dict[str, str]:
    """Every snapshot: its path from the root and what it holds."""
    messages: dict[str, dict[str, list[str]]] = {}
    for module in OURS:
        for code, lines in wording(module):
            messages.setdefault(package_of(module), {})[code] = lines
    return {
        f"tests/{package}/{SNAPSHOT}": "".join(
            f"{code}\n" + "".join(f"  {line}\n" for line in lines) for code, lines in sorted(found.items())
        )
        for package, found in messages.items()
    }


if __name__ == "__main__":
    for path, text in snapshots().items():
        Path(ROOT / path).write_text(text, "utf-8")
