"""Options from a file, and effects by name on the command line."""

from pathlib import Path

import pytest

from pipeline.settings import Settings, UsageError, read_toml, with_effects
from stages.effects import Config

EFFECTS = "exposure, view_dependence, background, pose_refinement"


def test_effects_are_options_of_their_stage():
    given = Settings(effects=Config(pilots=1))
    chosen = with_effects(given, ["exposure=off", "view_dependence=on", "exposure=on"])
    assert chosen.effects == Config(exposure="on", view_dependence="on", pilots=1)
    assert given.effects == Config(pilots=1), "what was given is left alone"
    assert with_effects(chosen, ["exposure=auto"]).effects == Config(view_dependence="on", pilots=1)


def test_names_may_be_written_like_flags():
    assert with_effects(Settings(), ["view-dependence=off"]).effects.view_dependence == "off"


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


def test_a_file_may_begin_with_the_byte_order_mark_of_windows(tmp_path: Path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbf[train]\r\nsteps = 3\r\n")
    assert read_toml(tmp_path / "a.toml") == {"train": {"steps": 3}}
