"""Effects by name on the command line."""

import pytest

from pipeline.settings import UsageError, with_effects
from tests.pipeline.fake_stages import EffectsConfig, FakeSettings, SettingsWithEffects


def test_effects_are_options_of_their_stage():
    given = SettingsWithEffects(effects=EffectsConfig(pilots=1))
    chosen = with_effects(given, ["exposure=off", "view_dependence=on", "exposure=on"])
    assert chosen.effects == EffectsConfig(exposure="on", view_dependence="on", pilots=1)
    assert given.effects == EffectsConfig(pilots=1), "what was given is left alone"
    assert with_effects(chosen, ["exposure=auto"]).effects == EffectsConfig(view_dependence="on", pilots=1)


def test_names_may_be_written_like_flags():
    assert with_effects(SettingsWithEffects(), ["view-dependence=off"]).effects.view_dependence == "off"


def test_no_effects_change_nothing():
    assert with_effects(SettingsWithEffects(), []) == SettingsWithEffects()
    assert with_effects(FakeSettings(), []) == FakeSettings()


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("lens_flare=on", "--effect lens_flare=on: no effect 'lens_flare'; there are: exposure, view_dependence"),
        ("pilots=1", "--effect pilots=1: no effect 'pilots'; there are: exposure, view_dependence"),
        ("=on", "--effect =on: no effect ''; there are: exposure, view_dependence"),
        ("exposure", "--effect exposure: exposure can be on, off or auto, as in --effect exposure=on"),
        ("exposure=yes", "--effect exposure=yes: exposure can be on, off or auto, as in --effect exposure=on"),
    ],
)
def test_wrong_effects_are_named_with_those_that_there_are(choice: str, words: str):
    with pytest.raises(UsageError) as error:
        with_effects(SettingsWithEffects(), [choice])
    assert str(error.value) == words


def test_a_chain_without_the_stage_has_no_effects():
    with pytest.raises(UsageError, match="there are: none"):
        with_effects(FakeSettings(), ["exposure=on"])
