"""`pipeline batch` as a user meets it: one bad scene stops nothing, the same command goes on, one page tells it all."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from PIL import Image

from pipeline.batch import Batch, batch_file, run_batch, scene_run
from pipeline.batch.page import PAGE, write_page
from pipeline.batch.scenes import find_scenes
from pipeline.cli import exit_codes
from pipeline.cli.commands import run_command
from pipeline.engine.display import SilentDisplay
from tests.refusals import refused

HOSTILE = """a <b>&"é' #%"""
ONLY_INGEST = ("--until", "ingest")


def add_photos(folder: Path, seed: int = 0) -> None:
    folder.mkdir(parents=True)
    for index in range(3):
        noise = np.random.default_rng([seed, index]).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(noise).save(folder / f"{index}.png")


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """Two scenes that can be read, one of a name that no page or shell likes, and one between them that cannot."""
    folder = tmp_path / "scenes"
    add_photos(folder / HOSTILE)
    add_photos(folder / "z", seed=1)
    (folder / "bad").mkdir()
    (folder / "bad" / "photo.jpg").write_text("no photo")
    return folder


def states(folder: Path) -> dict[str, str]:
    return {name: scene.state for name, scene in batch_file.read(folder).scenes.items()}


def test_one_bad_scene_stops_nothing(scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert run_command(["batch", str(scenes), "-o", str(out), "--json", *ONLY_INGEST]) == exit_codes.BATCH
    assert states(out) == {HOSTILE: "done", "bad": "failed", "z": "done"}
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["stage"] for event in events if event["event"] == "end"] == [HOSTILE, "z"]
    (error,) = (event for event in events if event["event"] == "error")
    assert (error["stage"], error["code"]) == ("bad", "pipeline.scene-failed")
    failure = batch_file.read(out).scenes["bad"].failure
    assert failure and failure.stage == "ingest" and failure.code.startswith("ingest.")
    assert (out / f"{HOSTILE}.nerf" / "run.json").is_file() and (out / "bad.log").stat().st_size > 0

    page = (out / PAGE).read_text("utf-8")
    assert "a &lt;b&gt;&amp;&#34;é" in page and "<b>&" not in page
    assert failure.what in page and failure.hint in page

    # The user repairs the scene: nothing else is done again.
    shutil.rmtree(scenes / "bad")
    add_photos(scenes / "bad", seed=2)
    before = {path: path.stat().st_mtime_ns for path in out.glob("*.nerf/ingest/*/manifest.json")}
    assert run_command(["batch", str(scenes), "-o", str(out), *ONLY_INGEST]) == 0
    assert set(states(out).values()) == {"done"}
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(before) == 2


def test_a_cluster_runs_all_scenes_but_the_bad_one(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], ray_cluster: str
):
    out = tmp_path / "out"
    words = ["batch", str(scenes), "-o", str(out), "--json", "--budget", "1h", "--cluster", ray_cluster, *ONLY_INGEST]
    assert run_command(words) == exit_codes.BATCH
    assert states(out) == {HOSTILE: "done", "bad": "failed", "z": "done"}
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["stage"] for event in events if event["event"] == "end"] == [HOSTILE, "z"]
    known = batch_file.read(out).scenes
    assert (failure := known["bad"].failure) and failure.stage == "ingest" and failure.code.startswith("ingest.")
    assert [known[name].allocated for name in (HOSTILE, "bad")] == [2400, 2400], "two machines, three scenes"
    assert all(scene.spent > 0 for scene in known.values())
    assert all((out / f"{name}.log").stat().st_size > 0 for name in known)


def test_a_page_shows_figures_links_and_a_picture(tmp_path: Path):
    known = batch_file.BatchFile(
        scenes={
            name: batch_file.SceneState(photos="p", state="done", spent=61, figures=figures(psnr))
            for name, psnr in (("low", 20.0), (HOSTILE, 31.0), ("none", None))
        }
    )
    renders = tmp_path / f"{HOSTILE}.nerf" / "output" / "renders"
    renders.mkdir(parents=True)
    Image.new("RGB", (800, 600), (255, 0, 0)).save(renders / "a.png")
    broken = tmp_path / "low.nerf" / "output" / "renders" / "a.png"
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"no picture")
    (renders.parent / "report.html").touch()
    write_page(tmp_path, known)
    page = (tmp_path / PAGE).read_text("utf-8")
    assert page.index("31.0 dB") < page.index("20.0 dB") < page.index("none</h3>"), "ranked, best first"
    assert page.count("data:image/jpeg") == 1
    assert 'href="a%20%3Cb%3E%26%22%C3%A9%27%20%23%25.nerf/output/report.html"' in page
    assert page.count("report.html") == 1, "of the scenes whose report is there"


def figures(psnr: float | None) -> dict[str, Any]:
    return {"photos": 5, "registered": 5, "psnr": psnr, "ssim": 0.5, "cameras_doubtful": False}


def test_words_of_the_batch_are_not_handed_on(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Nor are those of a run lost."""
    said = tmp_path / "said"
    script = f"import sys; open({str(said)!r}, 'a').write(repr(sys.argv[1:]) + chr(10))"
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", script])
    out = tmp_path / "out"
    words = [f"--output={out}", "--sfm.seed", "3", "--budget", "3m", "--json", "--effect", "exposure=on"]
    assert run_command(["batch", str(scenes), *words]) == 0
    given = ["--sfm.seed", "3", "--effect", "exposure=on", "--budget", "60s", "-o", str(out / f"{HOSTILE}.nerf")]
    assert said.read_text().splitlines()[0] == repr([str(scenes / HOSTILE), *given, "--json"])


def test_a_scene_may_be_called_like_an_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    add_photos(tmp_path / "scenes" / "-x")
    monkeypatch.chdir(tmp_path / "scenes")
    assert run_command(["batch", ".", "-o", str(tmp_path / "out"), *ONLY_INGEST]) == 0


@pytest.mark.parametrize("words", [["-o", "out"], ["-oout"], ["--output", "out"], ["--output=out"]])
def test_the_folder_is_the_batchs_own(words: list[str], scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "import sys; assert sys.argv.count('-o') == 1"])
    assert run_command(["batch", str(scenes), *words]) == 0
    assert set(states(tmp_path / "out").values()) == {"done"}


def test_other_scenes_do_not_take_over_a_batch(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`batch mon/scenes`, then `batch tue/scenes`: both are called scenes.batch."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "pass"])
    assert run_command(["batch", str(scenes)]) == run_command(["batch", "scenes"]) == 0
    add_photos(tmp_path / "tue" / "scenes" / "a")
    assert run_command(["batch", "tue/scenes"]) == exit_codes.USAGE
    assert run_command(["batch", "tue/scenes", "-o", "scenes.batch"]) == 0


def test_a_scene_for_which_no_time_is_left_says_so(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "import time; time.sleep(3.1)"])
    out = tmp_path / "out"
    assert run_command(["batch", str(scenes), "-o", str(out), "--budget", "4s"]) == exit_codes.BATCH
    known = batch_file.read(out).scenes
    assert [scene.state for scene in known.values()] == ["done", "failed", "failed"]
    assert {one.failure.code for one in known.values() if one.failure} == {"pipeline.no-time-left"}
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "pass"])
    assert run_command(["batch", str(scenes), "-o", str(out), "--budget", "60s"]) == 0
    assert batch_file.read(out).scenes[HOSTILE].allocated == known[HOSTILE].allocated, "done: it keeps its settings"


def test_a_first_budget_pays_for_nothing_before(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "import time; time.sleep(2)"])
    out = tmp_path / "out"
    assert run_command(["batch", str(scenes), "-o", str(out)]) == 0
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", "pass"])
    assert run_command(["batch", str(scenes), "-o", str(out), "--budget", "6s"]) == 0
    assert batch_file.read(out).scenes[HOSTILE].allocated == 2


@pytest.mark.parametrize(
    "words",
    [["--json", "scenes"], ["scenes", "--train.steps", "0"], ["scenes", "--budget", "2m", "--train.steps", "9"],
     ["scenes", "--until", "lunch"], ["scenes", "--more", "2m"], ["scenes", "--budget", "soon"],
     ["scenes", "--budget", "3m", "--train.depth"], ["scenes", "--budget", "3m", "--until", "tradeoff"]],
)  # fmt: skip
def test_usage_errors_come_before_any_scene(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    add_photos(tmp_path / "scenes" / "a")
    assert run_command(["batch", *words]) == exit_codes.USAGE
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scenes"]


def ends_by(script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> batch_file.SceneFailure | None:
    monkeypatch.setattr(scene_run, "COMMAND", ["-c", script])
    return scene_run.run_scene(scene_run.SceneRun("a", (), tmp_path / "log", tmp_path)).failure


def test_a_crash_is_told_by_its_signal_or_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    killed = ends_by("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", tmp_path, monkeypatch)
    assert killed and killed.code == "pipeline.scene-crashed" and "SIGKILL" in killed.what
    spoke = ends_by("import sys; sys.exit('corrupt heap')", tmp_path, monkeypatch)
    assert spoke and spoke.code == "pipeline.scene-crashed" and "corrupt heap" in spoke.why
    assert ends_by("pass", tmp_path, monkeypatch) is None
    printed = ends_by("print('a library speaks'); print('{event')", tmp_path, monkeypatch)
    assert printed is None and "a library speaks" in (tmp_path / "log").read_text()
    silent = ends_by("import sys; sys.exit(9)", tmp_path, monkeypatch)
    assert silent and "library" not in silent.why, "the log of earlier attempts is none of it"


def test_an_option_that_no_run_takes_has_a_reason(scenes: Path, tmp_path: Path):
    options = ["--render.cameras", str(tmp_path / "gone.json"), "--render.frames", "5"]
    code = run_command(["batch", str(scenes), "-o", str(tmp_path / "out"), *options])
    assert code in (exit_codes.USAGE, exit_codes.BATCH)
    if code == exit_codes.BATCH:
        failures = [scene.failure for scene in batch_file.read(tmp_path / "out").scenes.values()]
        assert all(failure and failure.why and failure.hint for failure in failures)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(holds: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="tells live processes by /proc")
@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_scene_ends_with_its_batch(scenes: Path, tmp_path: Path, signal_number: int):
    """However the batch ends; and the same command then goes on with that scene."""
    out, seen = tmp_path / "out", tmp_path / "pid"
    slow = tmp_path / "slow" / "sitecustomize.py"  # the scene's process waits before it begins
    slow.parent.mkdir()
    slow.write_text(
        "import os, sys, time\n"
        "if 'pipeline.cli.exit_with_parent' in ' '.join(sys.orig_argv):\n"
        "    import threading\n"
        f"    open({str(seen)!r}, 'w').write(str(os.getpid()))\n"
        "    from pipeline.cli import commands\n"
        "    commands.main = lambda: time.sleep(600)\n"
    )
    path = os.pathsep.join((str(slow.parent), str(Path(__file__).parents[3])))
    command = [sys.executable, "-m", "pipeline", "batch", str(scenes), "-o", str(out), *ONLY_INGEST]
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs begin with it ignored
    process = subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True, preexec_fn=heard
    )
    wait_until(lambda: seen.exists() and seen.read_text())
    child = int(seen.read_text())
    assert alive(child)
    process.send_signal(signal_number)
    process.communicate(timeout=60)
    wait_until(lambda: not alive(child))
    assert states(out)[HOSTILE] == "running"
    assert "(begun)" in (out / PAGE).read_text("utf-8"), "of a batch that has ended nothing runs"
    assert run_command(["batch", str(scenes), "-o", str(out), *ONLY_INGEST]) == exit_codes.BATCH
    assert states(out) == {HOSTILE: "done", "bad": "failed", "z": "done"}


def test_a_run_that_outlives_its_batch_is_waited_for(scenes: Path, tmp_path: Path):
    out = tmp_path / "out"
    (out / "z.nerf").mkdir(parents=True)
    other = FileLock(out / "z.nerf" / ".lock", thread_local=False)
    other.acquire()

    def end_once_met() -> None:
        for _ in range(600):
            if (out / "z.log").is_file() and "is in use" in (out / "z.log").read_text():
                break
            time.sleep(0.1)
        other.release()

    ending = Thread(target=end_once_met)
    ending.start()
    assert run_command(["batch", str(scenes), "-o", str(out), *ONLY_INGEST]) == exit_codes.BATCH
    ending.join()
    assert states(out) == {HOSTILE: "done", "bad": "failed", "z": "done"}
    assert "is in use" in (out / "z.log").read_text()


def test_two_batches_do_not_share_a_folder(scenes: Path, tmp_path: Path):
    out = tmp_path / "out"
    out.mkdir()
    with FileLock(out / ".lock"), refused("pipeline.batch-in-use", out):
        run_batch(Batch(scenes, find_scenes(scenes), out, (), None), SilentDisplay())
