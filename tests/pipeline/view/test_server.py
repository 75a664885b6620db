"""The server of `pipeline view`: whom it answers, what it says, and that it and the training need not each other."""

import http.client
import json
import math
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import pytest

from pipeline import view
from pipeline.cli import exit_codes
from pipeline.cli.commands import run_command
from pipeline.engine.run_file import RunFile, write
from pipeline.view.server import NICENESS, ViewServer, listening
from stages.train.live import FINISH, LIVE
from stages.viewer.page import page, watching
from tests.pipeline.view.running_training import (
    KEYS,
    RunningTraining,
    can_reach_other_address,
    quiet_environment,
)
from tests.refusals import refused
from tests.stages.viewer.made_fields import NAMES

WAIT_SECONDS = 300


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def told(self) -> dict[str, Any]:
        return json.loads(self.body)


class Served:
    """A server of ``training``'s workspace in a thread, which browsers and others ask."""

    def __init__(self, training: RunningTraining) -> None:
        self.training, self.server = training, ViewServer(training.root)
        sockets = {"sockets": [self.server.listener]}
        # daemon: a test that fails before it closes the server lets the program end all the same
        self.thread = threading.Thread(target=self.server.server.run, kwargs=sockets, daemon=True)
        self.thread.start()

    def ask(self, at: str = "state", way: str = "GET", whole: str | None = None, **headers: str) -> Answer:
        """``at``: below the token; ``whole``: the whole path instead. Names of headers have _ for -."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=60)
        connection.putrequest(way, whole or f"/{self.server.token}/{at}", skip_host=True, skip_accept_encoding=True)
        given = {"Host": f"127.0.0.1:{self.server.port}"} | {k.replace("_", "-"): v for k, v in headers.items()}
        for name, value in given.items():
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        answer = Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())
        connection.close()
        return answer

    def until(self, so: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """What the state says once it says ``so``."""
        ends = time.monotonic() + WAIT_SECONDS
        while not so(told := self.ask().told):
            assert self.training.error is None and time.monotonic() < ends, (self.training.error, told)
            time.sleep(0.1)
        return told

    def close(self) -> None:
        self.server.stop()
        self.thread.join(30)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningTraining]:
    with RunningTraining(tmp_path_factory.mktemp("work")) as training:
        yield training


@pytest.fixture
def served(running: RunningTraining) -> Iterator[Served]:
    server = Served(running)
    yield server
    server.close()


def parts_of(body: bytes) -> tuple[dict[str, Any], Callable[[str], bytes]]:
    length = struct.unpack("<I", body[:4])[0]
    header = json.loads(body[4 : 4 + length])
    return header, lambda name: body[4 + length + header["sections"][name][0] :][: header["sections"][name][1]]


def test_it_shows_the_field_of_a_running_training(served: Served) -> None:
    told = served.until(lambda told: told["field"])
    assert told["phase"] == "training" and 0 < told["progress"] < 1 and not told["finishing"]
    header, section = parts_of(served.ask(f"field/{told['field']}").body)
    field = header["field"]
    rows = sum(level["rows"] for level in field["levels"])
    assert field["bits"] == 16 and field["by_rows"] and len(section("table")) == 8 * rows
    scene, _ = parts_of(served.ask("scene").body)
    assert [v["name"] for v in scene["views"]][:6:2] == list(NAMES) and len(header["gains"]) == len(scene["views"])
    later = served.until(lambda later: later["field"] != told["field"])
    assert later["step"] > told["step"]
    assert served.ask("field/no-such-field").status == 204


def test_the_page_asks_nobody_else_and_holds_no_names(served: Served) -> None:
    answer = served.ask("")
    text = answer.body.decode()
    assert answer.headers["content-type"].startswith("text/html") and "follow();" in text
    assert "default-src 'none'" in text and "connect-src 'self'" in text
    assert not re.search(r"https?://(?!www.w3.org/2000/svg)", text) and not any(name in text for name in NAMES)


def test_every_answer_forbids_frames_caches_and_guessing(served: Served) -> None:
    expected = {
        "cache-control": "no-store",
        "content-security-policy": "frame-ancestors 'none'",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "referrer-policy": "no-referrer",
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
    }
    for answer in (served.ask(""), served.ask(), served.ask("scene"), served.ask(Host="evil.com")):
        assert expected.items() <= answer.headers.items()


@pytest.mark.parametrize(
    "host", ["evil.com", "evil.com:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.evil.com:{port}", ""]
)
def test_a_foreign_host_is_refused(served: Served, host: str) -> None:
    assert served.ask(Host=host.format(port=served.server.port)).status == 403
    assert served.ask(Host=f"localhost:{served.server.port}").status == 200


def test_two_hosts_in_one_request_are_refused(served: Served) -> None:
    own = f"127.0.0.1:{served.server.port}"
    for first, second in ((own, "evil.com"), ("evil.com", own), (own, own)):
        assert served.ask(Host=first, host=second).status in (400, 403)


def test_a_page_of_another_origin_is_refused(served: Served) -> None:
    own = f"http://127.0.0.1:{served.server.port}"
    assert served.ask(Origin=own).status == 200
    for origin in ("http://evil.com", "null", own.replace("http:", "https:"), own + "0"):
        assert served.ask(Origin=origin).status == 403
    for site in ("cross-site", "same-site"):
        assert served.ask(Sec_Fetch_Site=site).status == 403
    assert served.ask(Sec_Fetch_Site="same-origin").status == 200
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Dest": "document"}  # as from the file that opens the browser
    assert served.ask("", **link).status == 200 and served.ask("state", **link).status == 403
    assert served.ask("finish", "POST").status == 403, "whoever cannot say where he comes from"
    assert served.ask("finish", "POST", Origin="http://evil.com").status == 403


def test_nothing_but_the_pages_own_is_served(served: Served, running: RunningTraining) -> None:
    token = served.server.token
    (running.root / "secret.txt").write_text("secret")
    paths = ["/", "/state", "/favicon.ico", f"/{token}", f"/{token}/../", f"/{token[1:]}/state", "/wrong/state"]
    paths += [
        f"/{token}/{up}{file}"
        for up in ("../", "%2e%2e/", "..%2f", "field/../", "field/%2e%2e%2f")
        for file in ("secret.txt", "run.json")
    ]
    paths += [
        f"/{token}/field/..",
        f"/{token}/field/%2fetc%2fpasswd",
        f"/{token}/field/{LIVE}",
        f"/{token}//etc/passwd",
    ]
    answers = {path: served.ask(whole=path) for path in paths}
    assert {path: answer.status for path, answer in answers.items() if answer.status not in (204, 307, 404)} == {}
    assert not any(b"secret" in answer.body or b"root:" in answer.body for answer in answers.values())
    for way in ("PUT", "DELETE", "OPTIONS", "TRACE"):
        assert served.ask("state", way).status in (405, 501)
    assert (
        served.ask("finish").status == 405
        and served.ask("state", "POST", Origin=f"http://127.0.0.1:{served.server.port}").status == 405
    )
    assert not (running.partial / LIVE / FINISH).exists()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere all threads of a program have one niceness")
def test_it_loads_what_packs_fields_before_it_yields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server, seen = ViewServer(tmp_path), Queue[int]()
    monkeypatch.setattr(server.server, "run", lambda sockets: seen.put(os.getpriority(os.PRIO_PROCESS, 0)))
    server.state.prepare = lambda: seen.put(os.getpriority(os.PRIO_PROCESS, 0))
    before = os.getpriority(os.PRIO_PROCESS, 0)
    threading.Thread(target=server.run, daemon=True).start()
    assert sorted(seen.get(timeout=60) for _ in range(2)) == [before, min(19, before + NICENESS)]
    server.listener.close()


def test_a_running_training_is_shown_without_loading_torch(running: RunningTraining, served: Served) -> None:
    """It takes seconds, on cores that train many."""
    served.until(lambda told: told["field"])
    program = f"""if True:
        import sys, time
        from pathlib import Path
        from pipeline.view.server import ViewServer
        state = ViewServer(Path({str(running.root)!r})).state
        ends, field = time.monotonic() + {WAIT_SECONDS}, None
        while not field and time.monotonic() < ends:  # each time the latest
            field = state.field(state.watched()["field"])
        print(len(field) > len(state.scene()) > 0, "torch" in sys.modules)"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True False\n"


def test_a_page_gets_its_first_field_before_torch_is_loaded(
    running: RunningTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.view.server.DRAW_SECONDS", 0.0)
    server, loaded = ViewServer(running.root), threading.Event()
    server.state.prepare = loaded.set
    serving = threading.Thread(target=server.run, daemon=True)
    serving.start()

    def asked(at: str) -> bytes:
        with urllib.request.urlopen(server.url + at, timeout=60) as answer:
            return answer.read()

    asked("state")
    before, ends = loaded.wait(1.0), time.monotonic() + WAIT_SECONDS
    while not loaded.is_set() and time.monotonic() < ends:
        asked(f"field/{json.loads(asked('state'))['field']}")
        loaded.wait(0.1)
    server.stop()
    serving.join()
    assert not before and loaded.is_set()


def test_tokens_cannot_be_guessed(tmp_path: Path) -> None:
    servers = [ViewServer(tmp_path) for _ in range(3)]
    assert len({server.token for server in servers}) == 3 and all(len(server.token) == 32 for server in servers)
    for server in servers:
        server.listener.close()


def test_no_other_address_of_this_machine_answers(served: Served) -> None:
    assert served.server.listener.getsockname()[0] == "127.0.0.1"
    address = can_reach_other_address()
    if address is None:
        pytest.skip("this machine has no address but its own loop's")
    with pytest.raises(OSError):
        socket.create_connection((address, served.server.port), timeout=5)


def test_a_taken_port_is_refused() -> None:
    taken = listening(None)
    with refused("pipeline.view-port", taken.getsockname()[1]):
        listening(taken.getsockname()[1])
    taken.close()


@pytest.mark.parametrize("port", ["0", "-1", "65536"])
def test_an_impossible_port_is_a_usage_error(port: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["view", str(tmp_path), f"--port={port}"]) == exit_codes.USAGE
    assert f"--port {port}: a port is a number from 1 to 65535" in capsys.readouterr().err


def test_a_damaged_run_file_is_said_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.json").write_text("{")
    assert run_command(["view", str(tmp_path)]) == exit_codes.WORKSPACE
    assert "cannot read" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="elsewhere the option would share the port with others")
def test_a_port_is_free_when_its_server_has_ended() -> None:
    before = listening(None)
    port = before.getsockname()[1]
    client = socket.create_connection(("127.0.0.1", port), timeout=30)
    before.accept()[0].close()  # the server first: its end of the connection lingers
    assert client.recv(1) == b""
    client.close()
    before.close()
    listening(port).close()


def test_the_current_folder_holds_no_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "uvicorn.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    with view.serve_during(tmp_path / "w.nerf") as url:
        assert url.startswith("http://127.0.0.1:")


def test_a_server_that_says_nothing_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "COMMAND", ["-c", """import time; time.sleep(3); print('{"url": "late"}')"""])
    monkeypatch.setattr(view, "START_SECONDS", 0.5)
    with refused("pipeline.view-ended", "0 s"), view.serve_during(tmp_path):
        pass


def test_the_browser_is_told_the_address_in_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    opened: list[str] = []
    monkeypatch.setattr(view.webbrowser, "open", opened.append)
    view.open_browser("http://127.0.0.1:1/token/", tmp_path / "w.nerf")
    file = Path(opened[0].removeprefix("file://"))
    assert "token" not in opened[0] and "url=http://127.0.0.1:1/token/" in file.read_text()
    assert file.parent == tmp_path / "w.nerf" and (os.name != "posix" or file.stat().st_mode & 0o777 == 0o600)


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "find_spec", lambda name: None if name == "uvicorn" else object())
    with refused("pipeline.view-not-installed", "uvicorn", ".[view]"):
        view.check_installed()


def test_two_servers_show_one_training_to_its_end(tmp_path: Path) -> None:
    with RunningTraining(tmp_path) as training:
        one, two = Served(training), Served(training)
        shown = []
        for server in (one, two):
            told = server.until(lambda told: told["field"] and len(told["curve"]) > 2)
            assert told["phase"] == "training" and 0 < told["progress"] < 1 and not told["finishing"]
            assert server.ask(f"field/{told['field']}").status in (200, 204)
            shown.append(told)
        assert 2 < shown[0]["step"] <= shown[1]["step"] < shown[1]["total_steps"]
        own = f"http://127.0.0.1:{two.server.port}"
        assert two.ask("finish", "POST", Origin=own).told == {"asked": True}
        one.until(lambda told: told.get("finishing") or told["phase"] == "finished")
        training.wait()
        for server, before in zip((one, two), shown, strict=True):
            told = server.until(lambda told: told["phase"] == "finished")
            assert told["field"] == "finished" and before["step"] < told["step"] == told["total_steps"] < 100_000
            assert told["curve"][: len(before["curve"])] == before["curve"]
            assert len(told["curve"]) > len(before["curve"]) and server.ask("field/finished").status == 200
            server.close()
        assert not (training.workspace.folder("train", KEYS["train"]) / LIVE).exists()


def test_without_a_training_it_says_so(tmp_path: Path) -> None:
    training = RunningTraining(tmp_path)
    server = Served(training)
    told = {"phase": "stopped", "key": KEYS["train"], "field": None, "metres_per_unit": None}
    assert server.ask().told == told
    assert server.ask("scene").status == 204
    assert server.ask("finish", "POST", Origin=f"http://127.0.0.1:{server.server.port}").told == {"asked": False}
    with training.workspace:
        assert server.ask().told["phase"] == "waiting"
    server.close()


def test_a_finished_page_is_served_where_nothing_runs(tmp_path: Path) -> None:
    with RunningTraining(tmp_path, steps=60) as training:
        server = Served(training)
        training.wait()
        training.make_page("all of it")
        assert server.ask().told["phase"] == "finished" and b"follow();" in server.ask("").body, "a run may train anew"
    assert server.ask("").body == b"all of it"
    assert server.ask("field/finished").status == 200 and math.isfinite(server.server.served_last)
    write(training.root, RunFile(keys=KEYS | {"normalise": "f" * 64}))
    told = server.ask().told
    assert (told["phase"], told["field"]) == ("stopped", None), "a field of another scene"
    assert server.server.served_last == math.inf and b"follow();" in server.ask("").body
    server.close()


def test_only_a_page_of_this_version_is_made_to_ask() -> None:
    whole = page("still", "")
    served = watching(whole)
    assert served.count("connect-src 'self'") == 1 and served.count('<script id="watch">') == 1
    assert "connect-src" not in whole and watching("<head></head>") == "<head></head>"


def test_ctrl_c_ends_the_command_and_leaves_the_training_alone(tmp_path: Path) -> None:
    with RunningTraining(tmp_path) as training:
        words = [sys.executable, "-m", "pipeline", "view", str(training.root), "--json"]
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs begin with it ignored
        command = subprocess.Popen(words, env=quiet_environment(), preexec_fn=heard, **pipes)
        assert command.stdout is not None
        port = int(re.findall(r":(\d+)/", json.loads(command.stdout.readline())["url"])[0])
        ends = time.monotonic() + WAIT_SECONDS
        while True:  # it answers
            try:
                socket.create_connection(("127.0.0.1", port), timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < ends
        time.sleep(1)
        command.send_signal(signal.SIGINT)
        _, said = command.communicate(timeout=WAIT_SECONDS)
        assert command.returncode == 130 and "Traceback" not in said
        assert training.thread.is_alive(), training.error


@pytest.mark.skipif(sys.platform != "linux", reason="only there it can be seen what a program has loaded")
def test_sigterm_ends_the_command_without_a_crash_report(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "pipeline", "view", str(RunningTraining(tmp_path).root), "--json"]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = subprocess.Popen(words, env=quiet_environment(), **pipes)
    assert command.stdout is not None
    url, ends = json.loads(command.stdout.readline())["url"], time.monotonic() + WAIT_SECONDS
    while "pycolmap" not in Path(f"/proc/{command.pid}/maps").read_text():
        assert time.monotonic() < ends
        time.sleep(0.1)
    urllib.request.urlopen(f"{url}state", timeout=WAIT_SECONDS).close()  # its import has ended
    command.terminate()
    _, said = command.communicate(timeout=WAIT_SECONDS)
    assert command.returncode == 143 and "Traceback" not in said and "@ " not in said


def test_a_server_during_a_run_ends_with_it(tmp_path: Path) -> None:
    lines = (
        "import time",
        "from pathlib import Path",
        "from pipeline.view import serve_during",
        f"with serve_during(Path({str(tmp_path)!r})) as url:",
        "    print(url, flush=True)",
        "    time.sleep(600)",
    )
    program = "\n".join(lines)
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    port = int(re.findall(r":(\d+)/", run.stdout.readline())[0])
    socket.create_connection(("127.0.0.1", port), timeout=30).close()
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    ends = time.monotonic() + WAIT_SECONDS
    with pytest.raises(OSError):
        while time.monotonic() < ends:
            socket.create_connection(("127.0.0.1", port), timeout=5).close()
            time.sleep(0.2)
