import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from nerf.effects.statistics.statistic import Statistic
from nerf.training.trainer import NonFinite
from pipeline.engine import manifest_file
from pipeline.engine.cache_keys import stage_key
from pipeline.engine.display import SilentDisplay
from stages import effects, train
from stages.contract import run_stage
from stages.effects import ab_runs, study
from stages.effects.ab_runs import Pilot
from stages.effects.decisions import Decisions, read_decisions, write_decisions
from stages.effects.study import SceneStatistics
from stages.io.files import write_json
from tests.effect_scenes import Effects, effect_scene
from tests.stages.photo_scene import photographed

CLEAR = {
    "exposure": False,
    "view_dependence": True,
    "background": True,
    "pose_refinement": False,
    "vignetting": False,
    "tone": True,
}


def found(called_for: bool | None, noise: float = 0.1) -> Statistic:
    return Statistic(1.0, "EV", 2.0, noise, called_for, "one of two")


@pytest.fixture
def decided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Decisions, dict, str, list[str]]]:
    """Runs the stage on given evidence; both runs of each pilot are noted, and gain ``gain`` ± 0.2 dB."""
    inputs, scene = photographed(tmp_path / "scene", views=11, bounded=False)
    inputs["sfm"] = tmp_path / "scene" / "sfm"
    inputs["sfm"].mkdir()
    write_json(inputs["sfm"] / "registration.json", {"images": [], "camera_models": []})
    count = len(scene.of_split("train"))
    now = [0.0]  # only pilots take time
    monkeypatch.setattr(study, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def run(
        config: effects.Config, gain: float = 1.0, pilot: Callable | None = None, **given: Statistic
    ) -> tuple[Decisions, dict, str, list[str]]:
        told = {name: found(value) for name, value in CLEAR.items()} | given
        measured = {name: np.full((count, 3), 0.5) for name in ("exposure", "vignetting")}
        took = {name: 0.25 if name == "exposure" else 0.5 for name in told}
        monkeypatch.setattr(study, "scene_statistics", lambda *_: SceneStatistics(told, measured, took))
        tried: list[str] = []

        def run_pilot(_trial: object, off: Decisions, on: Decisions, *_rest: object) -> Pilot:
            tried.extend(on.on.keys() - off.on.keys())
            now[0] += 3.0
            return Pilot(gain, 0.2, 0.05)

        monkeypatch.setattr(ab_runs, "run_pilot", pilot or run_pilot)
        folder = tmp_path / f"effects{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        result = run_stage(effects.STAGE, config, inputs, folder, SilentDisplay())
        table = json.loads((folder / "effects.json").read_text("utf-8"))
        return read_decisions(folder), table, result.line, tried

    return run


def test_clear_evidence_decides_without_a_pilot(decided: Callable) -> None:
    decisions, table, line, tried = decided(effects.Config())
    assert decisions == Decisions({"view_dependence": {}, "background": {}})
    assert not tried
    assert line == (
        "background on (one of two) · view dependence on (one of two) · 4 off · seen, not modelled: tone (one of two)"
    )
    assert table["tone"]["seconds"] == 0.5
    assert table["camera_model"]["seconds"] == 0.0, "stage sfm chose it"
    assert table["exposure"] == {
        "on": False,
        "modelled": True,
        "statistic": 1.0,
        "unit": "EV",
        "threshold": 2.0,
        "noise": 0.1,
        "pilot_gain_db": None,
        "pilot_noise_db": None,
        "cost": None,
        "seconds": 0.25,
        "reason": "one of two",
    }
    assert table["tone"]["on"] and not table["tone"]["modelled"]


@pytest.mark.parametrize(("gain", "on"), [(0.3, True), (0.15, False), (-1.0, False)])
def test_a_pilot_decides_by_gain_against_noise(decided: Callable, gain: float, on: bool) -> None:
    decisions, table, _, tried = decided(effects.Config(), gain, exposure=found(None))
    assert tried == ["exposure"] and ("exposure" in decisions.on) is on
    assert (table["exposure"]["pilot_gain_db"], table["exposure"]["seconds"]) == (gain, 3.25)
    assert table["exposure"]["reason"] == f"one of two; an A/B run gained {gain:+.2f} ± 0.20 dB"


@pytest.mark.parametrize("called_for", [None, False])
@pytest.mark.parametrize(("gain", "on"), [(0.5, True), (-0.15, True), (-0.5, False)])
def test_view_dependence_is_left_out_only_where_that_gains(
    decided: Callable, called_for: bool | None, gain: float, on: bool
) -> None:
    decisions, _, _, tried = decided(effects.Config(), gain, view_dependence=found(called_for))
    assert tried == ["view_dependence"] and ("view_dependence" in decisions.on) is on


@pytest.mark.parametrize("name", ["exposure", "vignetting"])
def test_what_was_measured_goes_to_training_by_photo(decided: Callable, name: str) -> None:
    decisions, *_ = decided(effects.Config(), **{name: found(True)})
    assert set(decisions.on[name]) == {f"{i}.png" for i in (1, 2, 3, 5, 6, 7, 9, 10)}
    assert all(numbers == [0.5] * 3 for numbers in decisions.on[name].values())


def test_clearly_wrong_poses_are_refined_without_a_pilot(decided: Callable) -> None:
    decisions, _, _, tried = decided(effects.Config(), -1.0, pose_refinement=found(True))
    assert not tried and "pose_refinement" in decisions.on


def test_there_are_two_pilots_at_most(decided: Callable) -> None:
    grey = {name: found(None) for name in ("exposure", "view_dependence", "pose_refinement")}
    decisions, table, _, tried = decided(effects.Config(), 1.0, **grey)
    assert tried == ["exposure", "pose_refinement"] and "view_dependence" in decisions.on
    assert table["view_dependence"]["reason"] == "one of two; unclear, and no A/B run: 2 already made"


def test_a_diverging_pilot_leaves_the_effect(decided: Callable) -> None:
    def diverging(*_: object) -> Pilot:
        raise NonFinite("loss", 3, {})

    decisions, table, *_ = decided(effects.Config(), 1.0, diverging, exposure=found(None))
    assert "exposure" not in decisions.on
    assert table["exposure"]["reason"].endswith("the A/B run diverged: the loss of step 3 is not finite")


def test_without_pilots_the_grey_zone_follows_publication(decided: Callable) -> None:
    grey = {name: found(None) for name in ("exposure", "view_dependence", "pose_refinement")}
    decisions, table, _, tried = decided(effects.Config(pilot_steps=0), 1.0, **grey)
    assert not tried and decisions == Decisions({"view_dependence": {}, "background": {}})
    assert table["exposure"]["reason"] == "one of two; unclear, and no A/B run: --effects.pilot-steps 0"


def test_what_nothing_is_known_of_is_not_tried(decided: Callable) -> None:
    unknown = {name: found(None, float("inf")) for name in ("exposure", "view_dependence", "pose_refinement")}
    decisions, table, _, tried = decided(effects.Config(), 1.0, **unknown)
    assert not tried and decisions == Decisions({"view_dependence": {}, "background": {}})
    assert table["exposure"]["noise"] is None


@pytest.mark.parametrize("value", ["on", "off"])
def test_what_was_asked_for_is_done(decided: Callable, value: effects.Switch) -> None:
    names = ("exposure", "view_dependence", "background", "pose_refinement", "vignetting")
    config = effects.Config(force=dict.fromkeys(names, value))
    decisions, table, _, tried = decided(config, exposure=found(None))
    assert not tried and set(decisions.on) == (set(names) if value == "on" else set())
    assert table["exposure"]["reason"] == "asked for; one of two"


def training_key(effects_folder: Path) -> str:
    """The key of a training that rests on these decisions."""
    outputs = manifest_file.describe_outputs(effects_folder, ("decisions.json",))
    return stage_key("train", train.STAGE.version, {}, {"effects": manifest_file.outputs_digest(outputs)})


@pytest.mark.parametrize("said", [False, None])
def test_switched_off_by_evidence_trains_as_off_by_option(decided: Callable, tmp_path: Path, said: bool | None) -> None:
    names = ("exposure", "view_dependence", "background", "pose_refinement", "vignetting")
    told = {name: found(said if name in ("exposure", "pose_refinement") else False) for name in names}
    by_evidence, *_ = decided(effects.Config(pilots=3), -1.0, **told)
    all_off = effects.Config(force=dict.fromkeys(names, "off"))
    by_request, *_ = decided(all_off, **dict.fromkeys(names, found(True)))
    decided(effects.Config(force={"exposure": "on"}), -1.0, **told)
    off, asked, on = (training_key(tmp_path / f"effects{number}") for number in (1, 2, 3))
    assert by_evidence == by_request == Decisions()
    assert off == asked != on


def test_decisions_are_read_as_they_were_written(tmp_path: Path) -> None:
    decisions = Decisions({"background": {}, "exposure": {"ä.jpg": [0.1, -0.2, 0.0]}})
    write_decisions(tmp_path, decisions)
    assert read_decisions(tmp_path) == decisions


@pytest.mark.parametrize(
    ("made", "on"),
    [
        (Effects(exposure_ev=1.0), {"background", "exposure", "view_dependence"}),
        (Effects(vignetting_ev=1.0), {"background", "view_dependence", "vignetting"}),
        (Effects(highlight=1.0, alpha=True), {"view_dependence"}),
    ],
)
def test_real_evidence_of_a_synthetic_scene(tmp_path: Path, made: Effects, on: set[str]) -> None:
    inputs = effect_scene(tmp_path / "scene", made)
    folder = tmp_path / "effects"
    folder.mkdir()
    run_stage(effects.STAGE, effects.Config(pilot_steps=0), inputs, folder, SilentDisplay())
    table = json.loads((folder / "effects.json").read_text("utf-8"))
    found = {name for name, entry in table.items() if entry["on"] and entry["modelled"]}
    assert found == on
    assert (table["vignetting"]["statistic"] > table["vignetting"]["threshold"]) == bool(made.vignetting_ev)


@pytest.mark.parametrize(
    ("clear", "gain", "on"), [(True, 0.6, True), (True, 0.0, True), (True, -0.5, False), (None, 0.0, False)]
)
def test_a_pilot_may_speak_against_clear_vignetting(
    decided: Callable, clear: bool | None, gain: float, on: bool
) -> None:
    decisions, table, _, tried = decided(effects.Config(), gain, vignetting=found(clear))
    assert tried == ["vignetting"] and ("vignetting" in decisions.on) == table["vignetting"]["on"] == on


@pytest.mark.parametrize(("seconds", "pilots_made"), [(0.0, 0), (29.0, 0), (31.0, 1), (95.0, 2)])
def test_pilots_are_made_as_far_as_they_fit(
    decided: Callable, monkeypatch: pytest.MonkeyPatch, seconds: float, pilots_made: int
) -> None:
    monkeypatch.setattr(ab_runs, "expected_seconds", lambda *_: (30.0, 31.0))
    grey = {name: found(None) for name in ("exposure", "pose_refinement")}
    _, table, _, tried = decided(effects.Config(seconds=seconds), 1.0, **grey)
    assert len(tried) == pilots_made
    assert (table["pose_refinement"]["reason"] == "one of two; unclear, and no A/B run: there is no time for one") == (
        pilots_made == 0
    )


@pytest.mark.parametrize(
    ("seconds", "made"),
    [
        (59.0, ["view_dependence"]),
        (61.0, ["pose_refinement"]),
        (99.0, ["view_dependence"]),
        (101.0, ["pose_refinement", "view_dependence"]),
    ],
)
def test_a_pose_fitting_pilot_must_fit_the_time(
    decided: Callable, monkeypatch: pytest.MonkeyPatch, seconds: float, made: list[str]
) -> None:
    monkeypatch.setattr(ab_runs, "expected_seconds", lambda *_: (40.0, 60.0))
    grey = {name: found(None) for name in ("pose_refinement", "view_dependence")}
    _, table, _, tried = decided(effects.Config(seconds=seconds), -1.0, **grey)
    assert tried == made
    why = "one of two; unclear, and no A/B run: there is no time for one that fits poses"
    assert (table["pose_refinement"]["reason"] == why) == ("pose_refinement" not in made)
