import json
from pathlib import Path

import pytest
import torch

from stages.io.files import write_durably
from stages.train.checkpoints import Checkpoint, latest_checkpoint, save_checkpoint
from tests.refusals import no_note, unheard


def checkpoint(step: int) -> Checkpoint:
    return Checkpoint(step, {"weight": torch.arange(6.0).reshape(2, 3) / 7 + step}, {"seconds": step / 3})


def saved(folder: Path, *steps: int) -> Path:
    for step in steps:
        save_checkpoint(folder, checkpoint(step))
    return folder


def test_what_was_saved_comes_back_bit_for_bit(tmp_path: Path) -> None:
    found = latest_checkpoint(saved(tmp_path / "new", 7), no_note)
    assert found is not None
    assert (found.step, found.facts) == (7, {"seconds": 7 / 3})
    assert torch.equal(found.tensors["weight"], checkpoint(7).tensors["weight"])


def test_the_last_two_are_kept(tmp_path: Path) -> None:
    saved(tmp_path, 0, 5, 90, 100)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"{step:09d}.{kind}" for step in (90, 100) for kind in ("json", "safetensors")}


def test_without_a_checkpoint_there_is_none(tmp_path: Path) -> None:
    assert latest_checkpoint(tmp_path, no_note) is None
    assert latest_checkpoint(tmp_path / "missing", no_note) is None


def test_of_a_finished_run_nothing_is_removed(tmp_path: Path) -> None:
    saved(tmp_path, 3, 4)
    (tmp_path / "000000004.safetensors").write_bytes(b"")
    before = {path.name for path in tmp_path.iterdir()}
    found = latest_checkpoint(tmp_path, unheard, remove=False)
    assert found is not None and found.step == 3
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("harm", ["cut tensors", "flipped bit", "cut json", "no tensors", "empty json"])
def test_a_damaged_checkpoint_is_named_and_skipped(tmp_path: Path, harm: str) -> None:
    saved(tmp_path, 3, 4)
    tensors, meta = tmp_path / "000000004.safetensors", tmp_path / "000000004.json"
    if harm == "cut tensors":
        tensors.write_bytes(tensors.read_bytes()[:-5])
    elif harm == "flipped bit":
        content = bytearray(tensors.read_bytes())
        content[-1] ^= 1
        tensors.write_bytes(content)
    elif harm == "cut json":
        meta.write_bytes(meta.read_bytes()[:-5])
    elif harm == "no tensors":
        tensors.unlink()
    else:
        meta.write_text("{}")
    said: list[tuple[str, str]] = []
    found = latest_checkpoint(tmp_path, lambda *note: said.append(note))
    assert found is not None and found.step == 3
    ((code, text),) = said
    assert code == "train.checkpoint-skipped" and "step 4" in text
    assert latest_checkpoint(tmp_path, no_note) is not None


def test_a_kill_before_the_json_leaves_no_checkpoint(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    (tmp_path / "000000002.safetensors").write_bytes(b"half")
    (tmp_path / "000000002.json.tmp").write_bytes(b"{")
    found = latest_checkpoint(tmp_path, no_note)
    assert found is not None and found.step == 1
    saved(tmp_path, 3)
    assert not list(tmp_path.glob("*2.*"))


def test_not_finite_facts_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_checkpoint(tmp_path, Checkpoint(1, {}, {"loss": float("nan")}))
    assert latest_checkpoint(tmp_path, no_note) is None


def test_writing_replaces_the_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "schedule.json"
    write_durably(path, json.dumps(list(range(100))).encode())
    write_durably(path, b"[]")
    assert path.read_bytes() == b"[]"
    assert [p.name for p in tmp_path.iterdir()] == ["schedule.json"]


def test_no_flipped_bit_of_either_file_passes(tmp_path: Path) -> None:
    """Header, tensors, facts, digest: every byte of a small checkpoint."""
    saved(tmp_path, 3)
    whole = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(whole) == 2
    for path, content in whole.items():
        for place in range(len(content)):
            for each, kept in whole.items():
                each.write_bytes(kept)
            path.write_bytes(content[:place] + bytes([content[place] ^ 1 << place % 8]) + content[place + 1 :])
            found = latest_checkpoint(tmp_path, unheard)
            assert found is None or found.facts == checkpoint(3).facts, f"byte {place} of {path.name}"
            assert found is None or torch.equal(found.tensors["weight"], checkpoint(3).tensors["weight"])


def test_a_checkpoint_under_another_step_does_not_pass(tmp_path: Path) -> None:
    saved(tmp_path, 3)
    for path in list(tmp_path.iterdir()):
        path.rename(tmp_path / path.name.replace("3", "4"))
    assert latest_checkpoint(tmp_path, unheard) is None


@pytest.mark.parametrize("fault", [RuntimeError("another field"), TypeError("an unknown fact")])
def test_a_checkpoint_of_something_else_is_named_and_skipped(tmp_path: Path, fault: Exception) -> None:
    saved(tmp_path, 3, 4)
    said: list[tuple[str, str]] = []

    def fits(found: Checkpoint) -> None:
        if found.step == 4:
            raise fault

    found = latest_checkpoint(tmp_path, lambda *note: said.append(note), fits)
    assert found is not None and found.step == 3
    ((code, text),) = said
    assert code == "train.checkpoint-skipped" and "step 4" in text and str(fault) in text
