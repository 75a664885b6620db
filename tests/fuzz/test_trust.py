"""What no file of a stranger can bring about: code that runs, a connection, a path that leads out of its folder."""

import ast
import json
import socket
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.cli.commands import run_command
from pipeline.engine.manifest_file import BadManifest, Manifest, check_outputs, outputs_digest, read, sealed
from pipeline.engine.run_file import VERSION
from pipeline.engine.workspace import Workspace
from stages.ingest.sources import find_source
from stages.io.photos import Photo, read_photos, write_photos
from tests.end_to_end.hard_scenes import RING, run, write_set
from tests.refusals import refused

ROOT = Path(__file__).parents[2]
SOURCES = [path for package in ("nerf", "stages", "pipeline") for path in sorted((ROOT / package).rglob("*.py"))]
# What runs code that it reads. Of torch and numpy the loaders of their own files, which are pickles.
RUN_CODE = {"eval", "exec", "compile", "__import__"}
UNPICKLE = {
    "pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "joblib",
    "marshal",
    "shelve",
    "torch.load",
    "np.load",
    "numpy.load",
}
UNPICKLE |= {"allow_pickle", "yaml.load", "runpy"}
# At this machine's own address alone; the cluster that --cluster names, from the command line.
SERVES = {"pipeline/view/server.py": {"socket"}, "stages/hardware/cluster.py": {"socket"}}
CONNECT = {"socket", "urllib", "http", "requests", "ftplib", "smtplib", "aiohttp", "httpx", "huggingface_hub"}


def called_and_imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Call):
            found |= {ast.unparse(node.func), *(keyword.arg or "" for keyword in node.keywords)}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            found.add(module if module == "urllib.parse" else module.split(".")[0])  # which only reads names
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_nothing_runs_code_unpickles_or_connects(path: Path) -> None:
    allowed = SERVES.get(path.relative_to(ROOT).as_posix(), set())
    assert not called_and_imported(path) & (RUN_CODE | UNPICKLE | CONNECT) - allowed


def test_that_test_sees_what_it_looks_for(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("import socket\nx = torch.load('a')\nnp.load('b', allow_pickle=True)\neval('1')\n")
    assert {"socket", "torch.load", "np.load", "allow_pickle", "eval"} <= called_and_imported(tmp_path / "a.py")


def test_no_shell_is_asked() -> None:
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("os.system", "os.popen", "subprocess.getoutput")
                assert not any(k.arg == "shell" for k in node.keywords), path


def test_a_run_opens_no_connection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was to be made")

    for name in ("connect", "connect_ex", "bind", "sendto"):
        monkeypatch.setattr(socket.socket, name, refuse, raising=True)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    with pytest.raises(AssertionError, match="a connection"):
        socket.create_connection(("127.0.0.1", 9))
    done = run(write_set(tmp_path / "set", RING[::2]), tmp_path / "w.nerf", "--train.steps", "100")
    assert done.code == 0, done.events[-1]


# --- paths


def picture(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(path)
    return path


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/hostname", "a/../../secret.png", "linked.png", "linked/secret.png", "~/secret.png"]
)
def test_a_transforms_file_names_photos_of_its_own_folder_alone(name: str, tmp_path: Path) -> None:
    picture(tmp_path / "secret.png")
    folder = picture(tmp_path / "set" / "a" / "b.png").parents[1]
    (folder / "linked.png").symlink_to(tmp_path / "secret.png")
    (folder / "linked").symlink_to(tmp_path)
    frames = [{"file_path": file, "transform_matrix": np.eye(4).tolist()} for file in ("a/b.png", name)]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    if name.startswith("~"):  # a name like any other: no such photo
        assert find_source(folder / "transforms.json").files[-1] == folder / name
        return
    with refused("ingest.outside-folder", repr(name)):
        find_source(folder / "transforms.json")


def test_a_transforms_files_photo_name_leads_nowhere(tmp_path: Path) -> None:
    picture(tmp_path / "secret.png")
    folder = picture(tmp_path / "set" / "b.png").parent
    frame = {"file_path": "b.png", "photo": "../secret.png", "transform_matrix": np.eye(4).tolist()}
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with refused("ingest.outside-folder", "'../secret.png'"):
        find_source(folder / "transforms.json")


@pytest.mark.parametrize("name", ["\ud800.png", "x" * 300, "x" * 70_000, "a/" * 3000 + "b.png"])
def test_names_that_no_file_can_have_are_refused(name: str, tmp_path: Path) -> None:
    frame = {"file_path": name, "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with refused("io.transforms-file-path", "frame 0") as raised:
        find_source(tmp_path / "transforms.json")
    assert len(str(raised.value)) < 400


@pytest.mark.parametrize("file", ["../a.png", "/etc/hostname", "images/../../a.png", "images/", "images/.a", "x/a.png"])
def test_photos_json_names_files_of_its_own_folder_alone(file: str, tmp_path: Path) -> None:
    write_photos(tmp_path, [Photo("a", file, 20, 20, 0, None, None, False, 1.0)], [], {})
    with refused("io.photo-outside"):
        read_photos(tmp_path)


def test_outputs_of_a_manifest_lie_in_its_folder(tmp_path: Path) -> None:
    folder, secret = tmp_path / "stage", picture(tmp_path / "secret.png")
    folder.mkdir()
    (folder / "link.png").symlink_to(secret)
    for name in ("../secret.png", str(secret), "link.png"):
        outputs = {name: {"size": secret.stat().st_size, "sha256": "0"}}
        manifest = Manifest("mesh", 1, "0", {}, {}, outputs, outputs_digest(outputs), {}, {}, "", 0.0, "")
        with pytest.raises(BadManifest, match="leads out of its folder"):
            check_outputs(folder, manifest)


@pytest.mark.parametrize("entry", [{}, {"size": 1.5, "sha256": "0"}, {"size": 1, "sha256": 1}])
def test_outputs_of_a_manifest_have_a_size_and_a_digest(entry: dict, tmp_path: Path) -> None:
    manifest = Manifest("mesh", 1, "0", {}, {}, {"a": entry}, "0", {}, {}, "", 0.0, "")
    (tmp_path / "manifest.json").write_text(json.dumps(sealed(asdict(manifest))))
    with pytest.raises(BadManifest, match="lacks size and sha256 of 'a'"):
        read(tmp_path)


@pytest.mark.parametrize("link", ["mesh", "mesh/0123456789abcdef", "output", "train/0123456789abcdef.partial"])
def test_a_workspace_with_links_in_it_is_left_alone(
    link: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`clean` would remove, and a stage would write, wherever they lead."""
    precious = picture(tmp_path / "home" / "precious" / "a.png")
    root = tmp_path / "w.nerf"
    (root / link).parent.mkdir(parents=True)
    (root / link).symlink_to(tmp_path / "home")
    (root / "run.json").write_text(json.dumps({"version": VERSION, "options": {}, "plans": {}, "keys": {}}))
    for command in (["clean", str(root)], ["resume", str(root)], ["status", str(root)]):
        assert run_command(command) == 3
        assert f"{root / link} is a link" in capsys.readouterr().err
    assert precious.is_file()


def test_the_workspace_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "w.nerf").symlink_to(tmp_path / "there")
    with Workspace(tmp_path / "w.nerf") as workspace:
        workspace.write_run(workspace.read_run())
    assert (tmp_path / "there" / "run.json").is_file()
