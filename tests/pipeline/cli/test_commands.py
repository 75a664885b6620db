"""The command line as a user meets it: words, exit codes, no traceback."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from pipeline.cli.arguments import COMMANDS, StageArguments, _flags
from pipeline.cli.commands import run_command
from pipeline.engine.settings import Settings
from pipeline.engine.workspace import default_workspace


def test_help_names_every_command_and_stage(capsys: pytest.CaptureFixture[str]):
    assert run_command(["--help"]) == 0
    text = capsys.readouterr().out
    for word in ("run", "resume", "status", "explain", "clean", "doctor", "demo", "sfm", "mesh"):
        assert word in text


def test_no_words_is_a_usage_error():
    assert run_command([]) == 2


def test_an_unknown_command_lists_the_known_ones(capsys: pytest.CaptureFixture[str]):
    assert run_command(["fly"]) == 2
    assert "no command 'fly'; there are: run, batch, resume," in capsys.readouterr().err


def test_help_of_run_lists_the_stage_options(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ending:
        run_command(["run", "--help"])
    assert ending.value.code == 0
    text = capsys.readouterr().out
    assert "--train.steps" in text
    assert "--ingest.photos" not in text, "one spelling: PHOTOS is the positional argument"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--until", "lunch"], "--until lunch: not one of ingest, sfm"),
        (["--until", "sfm", "--from", "mesh"], "--from mesh and --until sfm: the run ends before that"),
        (["--from", "tradeoff"], "--from tradeoff: not one of ingest, sfm"),
        (["--config", "missing.toml"], "--config missing.toml: No such file"),
        (["--train.steps", "0", "--train.downscale", "0.5"], "--train.steps 0 must be at least 1; "
         "--train.downscale 0.5 must be at least 1 (pipeline run --help)"),
        (["--train.grid.max-res", "9"], "--train.grid.max-res 9 must be at least 16 (pipeline run --help)"),
        (["--train.grid.max-res", "64", "--train.field", "vanilla"],
         "--train.grid.max-res has no effect with --train.field vanilla; leave out one of the two"),
        (["--train.steps", "5", "--train.seconds", "5"], "--train.steps 5 and --train.seconds 5 both set"),
        (["--train.steps", "many"], "--train.steps: 'many' is not a whole number (pipeline run --help)"),
        (["--train.field", "foo"], "--train.field: 'foo' is not one of grid, vanilla (pipeline run --help)"),
        (["--sfm.seed", "one"], "--sfm.seed: 'one' is not a whole number (pipeline run --help)"),
        (["--target-psnr", "0"], "--train.target-psnr 0.0 must be greater than 0 (pipeline run --help)"),
        (["--target-psnr", "lots"], "'lots' is not a number"),
        (["--effect", "lens_flare=on"], "--effect lens_flare=on: no effect 'lens_flare'; there are: "),
        (["--effect", "lens_flare=on", "--effect", "fog=on"], "--effect lens_flare=on: no effect"),
        (["--budget", "10"], "'10' is not a duration; write it like 90s, 10m or 1h30m"),
        (["--budget", "2m", "--train.steps", "50"], "--budget 2m and --train.steps 50: "),
        (["--budget", "2m", "--until", "tradeoff"], "--budget and --until tradeoff: "),
        (["--more", "9m", "--config", "a.toml"], "--more uses the recorded options, not those of --config a.toml"),
        (["-o", ""], "nothing is given after -o"),
        (["--output="], "nothing is given after --output="),
    ],
)  # fmt: skip
def test_usage_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str):
    assert run_command(["run", str(tmp_path), *words]) == 2
    text = capsys.readouterr().err
    assert text.startswith("pipeline: ") and message in text
    assert text.count("\n") == 1 and "pydantic" not in text


@pytest.mark.parametrize(
    ("words", "unknown", "meant"),
    [
        (["train", "--workspace", "w.nerf"], "--workspace", "pipeline train w.nerf"),
        (["train", "--workspace=w.nerf", "--train.steps", "5"], "--workspace", "pipeline train w.nerf"),
        (["status", "-o", "w.nerf"], "-o", "pipeline status w.nerf"),
        (["clean", "--output"], "--output", "pipeline clean WORKSPACE"),
        (["explain", "train", "--workspace", "w.nerf"], "--workspace", "pipeline explain STAGE w.nerf"),
        (["run", "--photos", "set"], "--photos", "pipeline run set"),
        (["resume", "w.nerf", "--budget", "5m"], "--budget", "`pipeline run`"),
        (["mesh", "w.nerf", "--until", "mesh"], "--until", "`pipeline run`"),
        (["status", "w.nerf", "--force"], "--force", "`pipeline STAGE`"),
        (["run", "set", "--train.stepz", "5"], "--train.stepz", "--train.steps"),
        (["run", "set", "--train.stepz", "5", "--train.seconds", "0"], "--train.stepz", "--train.steps"),
        (["run", "set", "--steps", "5"], "--steps", "--train.steps"),
        (["run", "set", "--train.no-steps"], "--train.no-steps", "--train.steps"),
        (["status", "--wrong"], "--wrong", ""),
        (["status", "w.nerf", "w2.nerf"], "w2.nerf", ""),
        (["explain"], "", "pipeline explain STAGE WORKSPACE"),
    ],
)
def test_words_that_a_command_lacks_are_named(
    capsys: pytest.CaptureFixture[str], words: list[str], unknown: str, meant: str
):
    assert run_command(words) == 2
    said = capsys.readouterr().err
    assert f" {unknown}" in said and meant in said and said.count("\n") == 1


@pytest.mark.parametrize("command", [*COMMANDS, "train"])
def test_every_option_in_the_help_is_known(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        run_command([command, "--help"])
    rows = re.findall(r"(?m)^[│ ]+(-.*)$", capsys.readouterr().out)
    shown = {flag for row in rows for flag in re.findall(r"(?<!\S)--?[a-z][\w.-]*", row)}
    assert shown == _flags(COMMANDS.get(command, StageArguments))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[train]\nstepz = 3", ": there is no option train.stepz\n"),
        ('[train]\nsteps = "many"', ": train.steps many must be a valid integer"),
        ("[train", "is not TOML"),
        ("ingest.photos = 'a'", "options.toml: a file cannot set ingest.photos; give PHOTOS instead\n"),
        ("[sfm]\ncameras = 'sparse'", "options.toml: a file cannot set sfm.cameras; give --cameras instead\n"),
        ("[ingest]\ncameras = 'sparse'", ": a file cannot set ingest.cameras; give --cameras instead\n"),
    ],
)
def test_a_config_file_is_validated(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str):
    (tmp_path / "options.toml").write_text(text)
    assert run_command(["run", str(tmp_path), "--config", str(tmp_path / "options.toml")]) == 2
    assert message in capsys.readouterr().err


def test_match_exposure_belongs_to_render_however_spelt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[str | None] = []
    monkeypatch.setattr(
        "pipeline.cli.commands._run_stages",
        lambda root, settings, *_, **__: seen.append(settings.render.match_exposure),
    )
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "photos/a.jpg")
    for words in (["--match-exposure", "a.jpg"], ["--render.match-exposure", "a.jpg"], []):
        run_command(["run", str(tmp_path / "photos"), *words])
    assert seen == ["a.jpg", "a.jpg", None]


def test_a_target_belongs_to_train_however_spelt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[float | None] = []
    monkeypatch.setattr(
        "pipeline.cli.commands._run_stages", lambda root, settings, *_, **__: seen.append(settings.train.target_psnr)
    )
    (tmp_path / "photos").mkdir()
    (tmp_path / "w").mkdir()
    (tmp_path / "w/run.json").write_text(json.dumps({"version": 2, "options": {}, "plans": {}, "keys": {}}))
    Image.new("RGB", (40, 30)).save(tmp_path / "photos/a.jpg")
    for words in (["--target-psnr", "28"], ["--train.target-psnr", "28"], ["--target-psnr=None"], []):
        run_command(["run", str(tmp_path / "photos"), *words])
        run_command(["train", str(tmp_path / "w"), *words])
    assert seen == [28, 28, 28, 28, None, None, None, None]


def test_help_names_the_target_by_its_short_name(capsys: pytest.CaptureFixture[str]):
    for command in ("run", "train"):
        with pytest.raises(SystemExit):
            run_command([command, "--help"])
        assert "--target-psnr" in capsys.readouterr().out.replace("--train.target-psnr", "")


def test_a_photo_to_render_like_has_to_be_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    Image.new("RGB", (40, 30)).save(tmp_path / "IMG_1.jpg")
    assert run_command(["run", str(tmp_path), "-o", str(tmp_path / "w"), "--match-exposure", "IMG_1.jpeg"]) == 2
    assert "--match-exposure IMG_1.jpeg: no photo has that name; perhaps IMG_1.jpg" in capsys.readouterr().err
    assert not (tmp_path / "w").exists()


def test_match_exposure_belongs_to_render(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    seen: list[str | None] = []
    monkeypatch.setattr(
        "pipeline.cli.commands._run_stages",
        lambda root, settings, *_, **__: seen.append(settings.render.match_exposure),
    )
    (tmp_path / "run.json").write_text(json.dumps({"version": 2, "options": {}, "plans": {}, "keys": {}}))
    assert run_command(["mesh", str(tmp_path), "--match-exposure", "a.jpg"]) == 2
    assert "--match-exposure belongs to `pipeline render` and `pipeline run`, not to mesh" in capsys.readouterr().err
    run_command(["render", str(tmp_path), "--match-exposure", "a.jpg"])
    assert seen == ["a.jpg"]


def run_on(photos: Path, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    workspace = photos.parent / "w.nerf"
    code = run_command(["run", str(photos), "-o", str(workspace), *words])
    captured = capsys.readouterr()
    assert "Traceback" not in captured.out + captured.err
    return code, captured.out + captured.err


def test_workspaces_are_called_after_what_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a walk.v2.mp4").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    cases = {"a walk.v2.mp4": "a walk.v2", "set/images": "set", "set/transforms.json": "set", "./set/": "set"}
    for given, name in cases.items():
        assert default_workspace(Path(given)) == tmp_path / f"{name}.nerf"


def test_a_video_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "clip.mp4").write_text("no video")
    assert run_command(["run", str(tmp_path / "clip.mp4"), "-o", str(tmp_path / "w.nerf")]) == 10
    captured = capsys.readouterr()
    assert "cannot decode the video clip.mp4" in captured.out + captured.err


def test_a_folder_that_does_not_exist(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, text = run_on(tmp_path / "nowhere", capsys)
    assert code == 10
    assert "nowhere" in text and "does not exist" in text
    assert not (tmp_path / "w.nerf").exists(), "a usage slip leaves no workspace behind"


def test_an_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    code, text = run_on(tmp_path / "photos", capsys)
    assert code == 10
    assert "try:" in text


def test_one_photo(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "photos/a.jpg")
    code, text = run_on(tmp_path / "photos", capsys)
    assert code == 10
    assert "try:" in text


def test_text_named_jpg(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.jpg").write_text("not a photo")
    (tmp_path / "photos/b.jpg").write_text("nor this")
    code, text = run_on(tmp_path / "photos", capsys)
    assert code == 10
    assert "a.jpg" in text


def test_json_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    code = run_command(["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w.nerf"), "--json"])
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert code == 10
    assert events[-1]["event"] == "error"
    assert set(events[-1]) == {"event", "stage", "code", "what", "why", "hint"}


@pytest.mark.parametrize(
    ("words", "code", "what"),
    [
        (["run", "photos", "--train.steps", "0"], 2, "--train.steps 0 must be at least 1 (pipeline run --help)"),
        (["mesh", "nowhere.nerf"], 3, "nowhere.nerf is not a workspace"),
        (["fly"], 2, "no command 'fly'"),
    ],
)
def test_errors_outside_of_stages_are_events_too(
    capsys: pytest.CaptureFixture[str], words: list[str], code: int, what: str
):
    assert run_command([*words, "--json"]) == code
    captured = capsys.readouterr()
    (event,) = map(json.loads, captured.out.splitlines())
    assert set(event) == {"event", "stage", "code", "what", "why", "hint"}
    assert (event["event"], event["stage"]) == ("error", None)
    assert event["what"].startswith(what) and captured.err == ""


def test_until_ingest_then_status_and_explain_and_clean(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    workspace = str(tmp_path / "w.nerf")
    code, text = run_on(tmp_path / "photos", capsys, "--until", "ingest")
    assert code == 0 and " · done in about 1 s, about " in text
    (manifest,) = (tmp_path / "w.nerf/ingest").glob("*/manifest.json")
    assert 0.4 < json.loads(manifest.read_text())["expected"] < 0.7, "kept for the report"
    code, text = run_on(tmp_path / "photos", capsys, "--until", "ingest")
    assert code == 0
    assert "nothing to do" in text and "done in" not in text
    assert run_command(["status", workspace]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["ingest", "cached"]
    assert lines[1].split()[:2] == ["sfm", "never"]
    assert run_command(["explain", "ingest", workspace]) == 0
    assert "would not run" in capsys.readouterr().out
    (tmp_path / "w.nerf/ingest/.DS_Store").write_text("of a file manager")
    assert run_command(["clean", workspace]) == 0
    assert "0.0 MB in 0 folders" in capsys.readouterr().out


def test_a_budget_is_of_runs_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    assert " s of 5 min spent →" in run_on(tmp_path / "photos", capsys, "--until", "ingest", "--budget", "5m")[1]
    before = json.loads((tmp_path / "w.nerf/run.json").read_text())["budget"]
    assert run_command(["ingest", str(tmp_path / "w.nerf"), "--force"]) == 0
    assert " spent →" not in capsys.readouterr().out
    assert json.loads((tmp_path / "w.nerf/run.json").read_text())["budget"] == before


def test_resume_and_status_name_the_same_next_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    workspace = str(tmp_path / "w.nerf")

    def last_line(*words: str) -> str:
        run_command([*words, workspace])
        return capsys.readouterr().out.splitlines()[-1]

    run_on(tmp_path / "photos", capsys, "--until", "ingest")
    step = f"`pipeline sfm {workspace}` continues where the last run ended"
    assert last_line("status") == step
    assert last_line("resume") == f"nothing to do: all up to ingest is up to date; {step} → {workspace}"
    run_on(tmp_path / "photos", capsys, "--until", "sfm")  # which these photos have none of
    step = f"`pipeline resume {workspace}` brings sfm up to date"
    assert last_line("status") == step
    assert last_line("ingest") == f"nothing to do: ingest is up to date; {step} → {workspace}"
    run_on(tmp_path / "photos", capsys, "--until", "ingest", "--budget", "5m")
    assert last_line("report").endswith("output/report.html") and last_line("status").endswith("ended")
    run_on(tmp_path / "photos", capsys, "--until", "ingest")
    assert "report     cached" in status_text(workspace, capsys), "a run keeps the report that there is up to date"
    assert run_on(tmp_path / "photos", capsys, "--until", "sfm", "--budget", "5m")[0] == 11
    assert "report     stale    report.budget: None → given" in status_text(workspace, capsys)


def status_text(workspace: str, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert run_command(["status", workspace]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", ["status", "resume", "mesh"])
def test_options_of_another_version_are_said_to_be(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str):
    run = {"version": 2, "options": {"evaluate": {"seed": 1}}, "plans": {}, "keys": {}}
    (tmp_path / "run.json").write_text(json.dumps(run))
    assert run_command([command, str(tmp_path)]) == 3
    text = capsys.readouterr().err
    assert f"cannot use the options of {tmp_path}" in text
    assert "there is no option evaluate.seed; another version of this program wrote it" in text
    assert f"pipeline run PHOTOS -o {tmp_path}" in text


def test_photos_given_again_replace_the_options_of_another_version(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for folder in ("photos", "w.nerf"):
        (tmp_path / folder).mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    run = {"version": 2, "options": {"evaluate": {"seed": 1}}, "plans": {}, "keys": {}}
    (tmp_path / "w.nerf/run.json").write_text(json.dumps(run))
    assert run_on(tmp_path / "photos", capsys, "--until", "ingest")[0] == 0
    assert run_command(["status", str(tmp_path / "w.nerf")]) == 0


def test_what_lies_beside_known_cameras_changes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = tmp_path / "cameras/sparse/0"
    for folder in (tmp_path / "photos", model):
        folder.mkdir(parents=True)
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    for part in ("cameras", "images", "points3D"):
        (model / f"{part}.bin").write_text("1")
    for name in ("itself", "again"):  # as many paths as there are ways through them
        (tmp_path / "cameras" / name).symlink_to(tmp_path / "cameras")
    words = ("--cameras", str(tmp_path / "cameras"), "--until", "ingest")
    assert "poses imported" in run_on(tmp_path / "photos", capsys, *words)[1]
    (tmp_path / "cameras/notes.txt").write_text("of no matter")
    assert "nothing to do" in run_on(tmp_path / "photos", capsys, *words)[1]
    assert "one camera" in run_on(tmp_path / "photos", capsys, "--until", "ingest")[1]


def test_photos_now_unusable_fail_their_own_stage(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png")
    assert run_on(tmp_path / "photos", capsys, "--until", "ingest")[0] == 0
    for photo in list((tmp_path / "photos").iterdir()):
        photo.rename(photo.with_suffix(".txt"))
    assert run_command(["resume", str(tmp_path / "w.nerf")]) == 10
    assert f"no photos in {tmp_path / 'photos'}" in capsys.readouterr().err


def test_status_of_no_workspace(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run_command(["status", str(tmp_path)]) == 3
    assert "is not a workspace" in capsys.readouterr().err


def test_an_unwritable_place(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.new("RGB", (4, 4), (k, k, k)).save(tmp_path / f"photos/{k}.png")
    assert run_command(["run", str(tmp_path / "photos"), "-o", "/proc/nowhere.nerf"]) == 3
    assert "cannot write to /proc/nowhere.nerf" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_cleanly_and_soon(tmp_path: Path, number: int, code: int):
    (tmp_path / "photos").mkdir()
    for k in range(200):
        Image.effect_noise((640, 480), 30 + k).convert("RGB").save(tmp_path / f"photos/{k}.png", compress_level=0)
    words = ["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w.nerf"), "--json"]
    command = [sys.executable, "-m", "pipeline", *words]
    # A shell starts what runs in its background with Ctrl-C ignored, and these tests may be in one.
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard)
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line)["event"] == "progress":
            break
    started = time.monotonic()
    process.send_signal(number)
    rest, errors = process.communicate(timeout=20)
    assert process.returncode == code
    assert "Finished stages are kept" in json.loads(rest.splitlines()[-1])["hint"] and errors == ""
    assert time.monotonic() - started < 15  # a hang, not slowness, is what this would catch


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["status", "--help"], ["--version"]])
def test_words_that_nobody_reads_are_no_error(words: list[str]):
    command = [sys.executable, "-m", "pipeline", *words]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=buffered)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == "" and process.wait() == 0


def test_a_budget_and_more_are_two_budgets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def with_after(settings: Settings, *_: object) -> Settings:
        return settings.model_copy(update={"train": settings.train.model_copy(update={"after": "0" * 16})})

    monkeypatch.setattr("pipeline.cli.commands.with_more", with_after)
    (tmp_path / "w").mkdir()
    (tmp_path / "w/run.json").write_text('{"version": 2, "options": {}, "plans": {}, "keys": {}}')
    words = ["run", str(tmp_path), "-o", str(tmp_path / "w"), "--more", "10m", "--budget", "5m"]
    assert run_command(words) == 2
    assert "--budget and --more both limit the time; give one" in capsys.readouterr().err
