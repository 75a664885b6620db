"""Every error that a user can act on, and every note, has a code of its own, which begins with its stage or package."""

import re
from collections import Counter
from collections.abc import Iterator

import pytest

from stages.contract import StageError
from tests.refusals import refused
from tests.test_architecture import OURS, ROOT, Module, module, offenders
from tests.wording import SNAPSHOT, codes_of, made, package_of, snapshots

CODE = re.compile(r"[a-z]+(\.[a-z]+(-[a-z]+)*)")


def wrong_codes(module: Module) -> Iterator[str]:
    package = package_of(module).split("/")[-1]
    for code in (code for call in made(module.tree) for code in codes_of(call, module)):
        if not CODE.fullmatch(code) or code.split(".")[0] != package:
            yield f"{code} is not {package}.some-words"


def test_codes_name_the_package_they_come_from() -> None:
    assert offenders(wrong_codes, OURS) == []


def test_a_code_is_used_once() -> None:
    used = Counter(code for module in OURS for call in made(module.tree) for code in codes_of(call, module))
    assert len(used) > 220
    assert [code for code, times in used.items() if times > 1] == []


def test_messages_are_worded_as_in_the_snapshots() -> None:
    """Reworded on purpose: ``python -m tests.wording``, and read what it changed."""
    found = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in (ROOT / "tests").rglob(SNAPSHOT)}
    wanted = snapshots()
    assert sorted(found) == sorted(wanted)
    changed = [
        f"{path}: {line}"
        for path, text in wanted.items()
        for line in sorted(set(text.splitlines()) ^ set(found[path].splitlines()))
    ]
    assert changed == []
    assert found == wanted


def test_wrong_codes_are_found() -> None:
    for code in ('"no-overlap"', '"train.no-overlap"', '"sfm.No overlap"', "why"):
        assert len(offenders(wrong_codes, [module("stages/sfm/a.py", f"StageError({code}, '', '', '')")])) == 1
    assert offenders(wrong_codes, [module("stages/sfm/a.py", "StageError('sfm.no-overlap', '', '', '')")]) == []
    for note in ("progress.note('moved', text)", "notes.append(Note('train.moved', text))", "note(f'{x}', text)"):
        assert len(offenders(wrong_codes, [module("stages/sfm/a.py", note)])) == 1, note


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
