"""Every error that a user can act on has a code of its own, which begins with its stage or package."""

import ast
import re
from collections import Counter
from collections.abc import Iterator

import pytest

from stages.contract import StageError
from tests.refusals import refused
from tests.test_architecture import OURS, Module, functions, module, offenders

CODE = re.compile(r"[a-z]+(\.[a-z]+(-[a-z]+)*)")


def makers(modules: list[Module]) -> set[str]:
    """What makes an error: StageError and the functions that are given its code."""
    defined = (function for module in modules for function in functions(module.tree))
    return {"StageError"} | {f.name for f in defined if f.args.args and f.args.args[0].arg == "code"}


MAKERS = makers(OURS)


def codes(module: Module) -> Iterator[ast.expr]:
    """The code of each error that is made in a module, as it is written, but where a function hands on its own."""
    for call in (node for node in ast.walk(module.tree) if isinstance(node, ast.Call)):
        if isinstance(call.func, ast.Name) and call.func.id in MAKERS:
            code = call.args[0]
            if not (isinstance(code, ast.Name) and code.id == "code") and ast.unparse(code) != "error.code":
                yield code


def constants(module: Module) -> dict[str, str]:
    """Names of texts at the top of a module."""
    named = (node for node in module.tree.body if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant))
    return {ast.unparse(node.targets[0]): str(ast.literal_eval(node.value)) for node in named}


def text_of(code: ast.expr, module: Module) -> str:
    return str(code.value) if isinstance(code, ast.Constant) else constants(module).get(ast.unparse(code), "")


def wrong_codes(module: Module) -> Iterator[str]:
    folder, package, *_ = module.name.split("/")
    package = package if folder == "stages" else folder
    for code in codes(module):
        text = text_of(code, module)
        if not CODE.fullmatch(text) or text.split(".")[0] != package:
            yield f"{ast.unparse(code)} is not {package}.some-words"


def test_codes_name_the_package_they_come_from() -> None:
    assert offenders(wrong_codes, OURS) == []


def test_a_code_is_used_once() -> None:
    used = Counter(text_of(code, module) for module in OURS for code in codes(module))
    assert len(used) > 110
    assert [code for code, times in used.items() if times > 1] == []


def test_wrong_codes_are_found() -> None:
    for code in ('"no-overlap"', '"train.no-overlap"', '"sfm.No overlap"', "why"):
        assert len(offenders(wrong_codes, [module("stages/sfm/a.py", f"StageError({code}, '', '', '')")])) == 1
    assert offenders(wrong_codes, [module("stages/sfm/a.py", "StageError('sfm.no-overlap', '', '', '')")]) == []


def test_another_code_or_value_is_no_refusal() -> None:
    def refuse() -> None:
        raise StageError("sfm.no-overlap", "no model", "0 of 3 pairs match", "Move.")

    with refused("sfm.no-overlap", 3, "no model"):
        refuse()
    for code, value in (("sfm.no-model", 3), ("sfm.no-overlap", 4)):
        with pytest.raises(AssertionError), refused(code, value):
            refuse()


def test_a_traceback_shows_the_code() -> None:
    assert StageError("sfm.no-overlap", "", "", "").__notes__ == ["code: sfm.no-overlap"]
