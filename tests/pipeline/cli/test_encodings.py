"""Names and terminals that know only some letters: nothing is lost by it but a letter on the screen."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image


def pipeline(folder: Path, encoding: str, *words: str) -> subprocess.CompletedProcess[str]:
    """The program, run in ``folder`` with its output in ``encoding``."""
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *words],
        cwd=folder,
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONPATH": str(Path(__file__).parents[3])},
        encoding=encoding,
        capture_output=True,
        check=False,
    )


@pytest.fixture(params=["photos", "caf\udce9"])
def photos(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A folder of three photos, in one case of a name that is not UTF-8."""
    folder = tmp_path / request.param
    folder.mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(folder / f"山{k}.png")
    (folder / "山.jpg").write_text("no photo")
    return folder


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_letters_that_the_terminal_lacks_are_no_error(photos: Path, encoding: str):
    root = f"{photos.name}.nerf"
    done = pipeline(photos.parent, encoding, "run", photos.name, "--until", "ingest")
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    arrow, mountain = ("→ ", "山") if encoding == "utf-8" else ("\\u2192 ", "\\u5c71")
    assert f"ingest     rejected {mountain}.jpg: not an image: it is text" in lines
    assert lines[-1].startswith(arrow) and lines[-1].endswith("/" + root.replace("\udce9", "\\udce9"))
    for words in (("status", root), ("explain", "ingest", root), ("clean", root)):
        done = pipeline(photos.parent, encoding, *words)
        assert (done.returncode, done.stderr) == (0, ""), words
    again = pipeline(photos.parent, encoding, "resume", root)
    assert again.returncode == 0 and "nothing to do" in again.stdout


def test_events_are_json_in_any_encoding(photos: Path):
    words = ("run", photos.name, "--until", "ingest", "--json")
    done = pipeline(photos.parent, "ascii", *words)
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert {event["event"] for event in events} >= {"start", "note", "finished"}
    assert "rejected 山.jpg: not an image: it is text" in [event.get("message") for event in events]
    assert photos.name in events[0]["text"]


def test_an_error_names_what_is_no_unicode(tmp_path: Path):
    for encoding in ("latin-1", "utf-8"):
        done = pipeline(tmp_path, encoding, "run", "caf\udce9")
        assert done.returncode == 10
        assert "\\udce9 does not exist" in done.stderr
