from pathlib import Path

import pycolmap

from stages.sfm.colmap.model_check import (
    Candidate,
    agreeing_pairs,
    better,
    check_model,
    facts,
    reasons,
    supported_runs,
    supported_steps,
)
from stages.sfm.colmap.repair import (
    copy_consistent_matches,
    drop_outside_main_segment,
)
from tests.stages.sfm.colmap.made_models import PHOTOS, Made, turn, turned_alone


def test_true_poses_pass(made: Made) -> None:
    checked = check_model(made.model, made.database, 0)
    assert checked.check.passed.all() and not checked.failed() and not reasons(made.model, checked)
    said = facts(made.model, checked)
    assert said["doubtful"] == [] and said["pairs"] == said["agreeing"] == PHOTOS * (PHOTOS - 1) / 2
    assert 0.3 < said["error_px"] < 1.5
    assert {image["agreement"] for image in said["images"].values()} == {1.0}


def test_a_model_that_is_wrong_as_a_whole_loses(made: Made) -> None:
    """Its own tolerance is that of its errors: alone it would nearly pass."""
    wrong = pycolmap.Reconstruction(made.model)
    for image_id in range(1, PHOTOS + 1):
        turn(wrong, image_id, 0.15 * (-1) ** image_id)
    candidates = [Candidate(model, check_model(model, made.database, 0)) for model in (wrong, made.model)]
    assert candidates[0][1].check.tolerance_px > 1.5 * candidates[1][1].check.tolerance_px
    assert candidates[0][1].check.passed.sum() > PHOTOS / 2
    assert better(*candidates) is better(*candidates[::-1]) is candidates[1]
    pairs, wrong_pairs = (sum(5 in pair for pair in of) for of in agreeing_pairs(candidates[1], candidates[0]))
    assert wrong_pairs < pairs == PHOTOS - 1
    noise = candidates[0][1].matches.noise_px  # of the matches, whatever the poses
    assert 0.1 < noise < 0.6 and noise == candidates[1][1].matches.noise_px


def test_of_models_that_agree_as_well_the_first_is_taken(made: Made) -> None:
    same = pycolmap.Reconstruction(made.model)
    candidates = [Candidate(model, check_model(model, made.database, 0)) for model in (made.model, same)]
    assert better(*candidates) is candidates[0] and better(*candidates[::-1]) is candidates[1]


def test_steps_are_judged_by_all_their_matches(made: Made, tmp_path: Path) -> None:
    wrong, steps = turned_alone(made, 5), {(i, i + 1) for i in range(1, PHOTOS)}
    copy = tmp_path / "consecutive.db"
    copy_consistent_matches(wrong, made.database, copy, steps)
    supported = supported_steps(wrong, made.database, steps)
    assert steps - supported == {(3, 4), (4, 5), (5, 6), (6, 7)}, "depths are in doubt a step farther"
    assert supported_runs(wrong, made.database, steps) == [[*range(7, 17)], [1, 2, 3], [4], [5], [6]]
    assert supported_runs(made.model, made.database, steps) == [[*range(1, PHOTOS + 1)]]
    checked = check_model(wrong, copy, 0)
    outside = drop_outside_main_segment(wrong, checked, [*range(1, PHOTOS + 1)], supported)
    failed = {wrong.image(image_id).name for image_id in checked.failed()}
    assert outside.keys() | failed == {wrong.image(image_id).name for image_id in range(1, 7)}
