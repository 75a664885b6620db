"""Options from a file, effects by name on the command line, and workspaces that would lie among the photos or are
those of other photos."""

import json
from pathlib import Path

import pytest
import tyro
from PIL import Image

from pipeline.cli.arguments import COMMANDS, StageArguments, parse, with_flags
from pipeline.cli.commands import run_command
from pipeline.cli.options import UsageError, read_toml, with_effects
from pipeline.engine.settings import Settings
from stages.effects import Config
from stages.render import Config as RenderConfig
from stages.train import Config as TrainConfig
from stages.train.fields.hash_grid_options import HashGridOptions

EFFECTS = "background, exposure, pose_refinement, vignetting, view_dependence"


def over(remembered: Settings, command: str, words: list[str]) -> Settings:
    """What a command asks for over the options that a workspace or a file remembers."""
    kind = COMMANDS.get(command, StageArguments)
    return with_flags(remembered, parse(kind, command, words).settings, command, words)


def test_effects_are_options_of_their_stage():
    given = Settings(effects=Config(pilots=1))
    chosen = with_effects(given, ["exposure=off", "view_dependence=on", "exposure=on"])
    assert chosen.effects == Config(force={"exposure": "on", "view_dependence": "on"}, pilots=1)
    assert given.effects == Config(pilots=1), "what was given is left alone"
    assert with_effects(chosen, ["exposure=auto"]).effects == Config(force={"view_dependence": "on"}, pilots=1)


def test_names_may_be_written_like_flags():
    assert with_effects(Settings(), ["view-dependence=off"]).effects.force == {"view_dependence": "off"}


def test_no_effects_change_nothing():
    assert with_effects(Settings(), []) == Settings()


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("lens_flare=on", f"--effect lens_flare=on: no effect 'lens_flare'; there are: {EFFECTS}"),
        ("pilots=1", f"--effect pilots=1: no effect 'pilots'; there are: {EFFECTS}"),
        ("=on", f"--effect =on: no effect ''; there are: {EFFECTS}"),
        ("exposure", "--effect exposure: exposure can be on, off or auto, as in --effect exposure=on"),
        ("exposure=yes", "--effect exposure=yes: exposure can be on, off or auto, as in --effect exposure=on"),
    ],
)
def test_wrong_effects_are_named_with_those_that_there_are(choice: str, words: str):
    with pytest.raises(UsageError) as error:
        with_effects(Settings(), [choice])
    assert str(error.value) == words


@pytest.mark.parametrize(
    ("words", "budget"),
    [
        ([], ("high", None, 600)),
        (["--train.steps", "9"], ("high", 9, None)),
        (["--train.preset=draft"], ("draft", None, None)),
        (["--train.preset", "None"], (None, None, 600)),
        (["--train.preset", "draft", "--train.seconds", "9"], ("draft", None, 9)),
    ],
)
def test_the_budget_given_replaces_the_one_remembered(words: list[str], budget: tuple[str, int | None, float | None]):
    remembered = Settings(train=TrainConfig(preset="high", seconds=600, after="0/0", more_steps=5))
    train = over(remembered, "train", ["w", *words]).train
    assert (train.preset, train.steps, train.seconds) == budget
    assert (train.after is None) == (bool(words) and "None" not in words), "a new training does not go on from another"


@pytest.mark.parametrize(
    ("remembered", "words", "left"),
    [
        (
            {"preset": "paper", "vanilla": {"width": 64}, "seed": 3},
            ["--train.field", "grid"],
            {"field": "grid", "seed": 3},
        ),
        (
            {"grid": {"num_levels": 3}, "preset": "draft"},
            ["--train.field=vanilla"],
            {"field": "vanilla", "preset": "draft"},
        ),
    ],
)
def test_the_field_given_takes_back_the_options_of_the_other(remembered: dict, words: list[str], left: dict):
    assert over(Settings(train=TrainConfig(**remembered)), "train", ["w", *words]).train == TrainConfig(**left)


@pytest.mark.parametrize(
    ("remembered", "words", "left"),
    [
        ({"path": "spiral", "frames": 40, "width": 640}, ["--cameras", "my.json"], {"width": 640}),
        ({"path": "spiral", "frames": 40}, ["--render.cameras=my.json"], {"cameras": Path("my.json")}),
        ({"cameras": Path("my.json"), "fps": 25}, ["--render.path", "spiral"], {"path": "spiral", "fps": 25}),
        ({"cameras": Path("my.json")}, ["--render.frames", "40"], {"frames": 40}),
        ({"path": "spiral", "frames": 40}, ["--render.cameras", "None"], {"path": "spiral", "frames": 40}),
        ({"path": "spiral"}, ["--render.frames", "40"], {"path": "spiral", "frames": 40}),
    ],
)
def test_a_given_path_or_camera_file_replaces_the_remembered(remembered: dict, words: list[str], left: dict):
    assert over(Settings(render=RenderConfig(**remembered)), "render", ["w", *words]).render == RenderConfig(**left)


def test_known_cameras_of_the_photos_leave_a_path_to_render():
    in_file = Settings(render=RenderConfig(path="spiral"))
    assert over(in_file, "run", ["photos", "--cameras", "my.json"]) == in_file


@pytest.mark.parametrize(
    ("words", "train"),
    [
        (["--train.seed", "3"], {"seed": 3}),
        (["--train.seed=3", "--train.grid.max-res", "64"], {"seed": 3, "grid": {"num_levels": 3, "max_res": 64}}),
        (["--train.target_psnr", "25"], {"target_psnr": 25}),
        (["--target-psnr", "25"], {"target_psnr": 25}),
        (["--train.no-tensorboard"], {"tensorboard": False}),
        (["--train.downscale", "None"], {"downscale": None}),
    ],
)
def test_flags_win_over_what_is_remembered(words: list[str], train: dict):
    remembered = {"seed": 1, "downscale": 4.0, "tensorboard": True, "grid": {"num_levels": 3}}
    asked = over(Settings(train=TrainConfig.model_validate(remembered)), "train", ["w", *words])
    assert asked == Settings(train=TrainConfig.model_validate(remembered | train))


def test_flags_that_contradict_what_is_remembered_are_refused():
    remembered = Settings(train=TrainConfig(grid=HashGridOptions(num_levels=3)))
    with pytest.raises(UsageError) as error:
        over(remembered, "train", ["w", "--train.vanilla.width", "64"])
    words = "--train.vanilla.width has no effect with --train.grid.num-levels; leave out one of the two"
    assert str(error.value) == f"{words} (pipeline train --help)"


@pytest.mark.parametrize(
    "words", [["run", "photos", "--config", "a.toml"], ["run", "photos", "--more", "3steps"], ["train", "photos.nerf"]]
)
def test_a_command_line_is_parsed_once(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    parsed: list[list[str]] = []
    whole = tyro.cli
    monkeypatch.setattr(tyro, "cli", lambda *given, **more: parsed.append(more["args"]) or whole(*given, **more))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text("[train]\nsteps = 3\n")
    (tmp_path / "photos.nerf").mkdir()
    (tmp_path / "photos.nerf/run.json").write_text(json.dumps({"version": 2}))
    assert run_command(words) != 0
    assert parsed == [words[1:]]


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path: Path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbf[train]\r\nsteps = 3\r\n")
    assert read_toml(tmp_path / "a.toml") == {"train": {"steps": 3}}


@pytest.mark.parametrize(("photos", "workspace"), [("set", "set"), (".", "."), ("set", "set/images"), ("set", "link")])
def test_nothing_is_written_among_the_photos(
    photos: str, workspace: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "set/images").mkdir(parents=True)
    Image.new("RGB", (4, 4)).save(tmp_path / "set/images/0.png")
    (tmp_path / "link").symlink_to("set")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run_command(["run", photos, "-o", workspace]) == 2
    assert f"pipeline: -o {workspace}: that is a folder of photos; leave out -o" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["ingest", "evaluate", "train", "output"])
def test_a_run_writes_into_no_folder_of_its_photos(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`pipeline run data/train -o data`: what stage train writes would be photos of the next run."""
    photos = tmp_path / "data" / name
    photos.mkdir(parents=True)
    Image.new("RGB", (40, 30)).save(photos / "a.png")
    assert run_command(["run", str(photos), "-o", str(tmp_path / "data"), "--until", "ingest"]) == 2
    assert f"the photos lie in its folder {name}, to which a run writes" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "data").rglob("*")] == [name, "a.png"]


def test_a_workspace_beside_its_photos_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "set/images").mkdir(parents=True)
    for k in range(3):
        Image.effect_noise((64, 48), 30 + k).save(tmp_path / f"set/images/{k}.png")
    words = ["run", str(tmp_path / "set/images"), "-o", str(tmp_path / "set"), "--until", "ingest"]
    assert [run_command(words), run_command(words)] == [0, 0]
    assert run_command(["run", str(tmp_path / "set"), "-o", str(tmp_path / "set")]) == 10
    assert "is a workspace" in capsys.readouterr().err


def test_unnamed_workspaces_are_not_shared_by_photo_sets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for k, scan in enumerate(("scan1", "scan2")):
        (tmp_path / scan / "photos/images").mkdir(parents=True)
        for n in range(3):
            Image.effect_noise((64, 48), 30 + 9 * k + n).save(tmp_path / f"{scan}/photos/images/{n}.png")
    (tmp_path / "link").symlink_to("scan1")
    monkeypatch.chdir(tmp_path)

    def run(photos: str, *words: str) -> int:
        return run_command(["run", photos, "--until", "ingest", *words])

    same = ["scan1/photos", "scan1/photos/images", "link/photos", str(tmp_path / "scan1/../scan1/photos/")]
    assert [run(photos) for photos in same] == [0, 0, 0, 0]
    assert run("nowhere/photos") == 10, "that is what is wrong with it"
    before = (tmp_path / "photos.nerf/run.json").read_bytes()
    capsys.readouterr()
    assert run("scan2/photos") == 2
    said = capsys.readouterr().err
    assert f"photos.nerf was made from {tmp_path}/scan1/photos, not from {tmp_path}/scan2/photos; " in said
    assert "-o another.nerf" in said and "-o photos.nerf" in said
    assert (tmp_path / "photos.nerf/run.json").read_bytes() == before
    assert [run("scan2/photos", "-o", "photos.nerf"), run("scan2/photos")] == [0, 0]
    (tmp_path / "scan2").rename(tmp_path / "moved")
    assert run("moved/photos") == 0


def test_photos_given_one_by_one_are_told_from_wrong_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (tmp_path / name).touch()
    assert run_command(["run", "a.jpg", "b.jpg", "c.jpg", "--train.steps", "5"]) == 2
    said = capsys.readouterr().err
    assert said == "pipeline: b.jpg is one file too many; give the folder that holds the photos\n"


def test_poses_no_field_can_fit_are_refused_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "photos/a.jpg")
    words = ["run", str(tmp_path / "photos"), "-o", str(tmp_path / "w"), "--evaluate.fit-poses", "on"]
    for vanilla in (["--train.field", "vanilla"], ["--train.preset", "paper"], ["--train.vanilla.width", "64"]):
        assert run_command([*words, *vanilla]) == 2
        assert "give --evaluate.fit-poses auto" in capsys.readouterr().err
    assert not (tmp_path / "w").exists()
    assert run_command([*words, "--train.vanilla.width", "64", "--until", "ingest"]) == 10, (
        "a single photo: that is said first"
    )
