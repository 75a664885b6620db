from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from stages.io.photos import Photo
from stages.sfm.colmap.mappers import incremental_options
from stages.sfm.colmap.model_check import (
    check_model,
    reasons,
)
from stages.sfm.colmap.model_comparison import compare_models
from stages.sfm.colmap.repair import (
    copy_consistent_matches,
    deregister,
    register_again,
)
from stages.sfm.extraction_and_matching import consecutive_pairs
from stages.sfm.retry_strategies import MappingOptions
from tests.stages.sfm.colmap.made_models import PHOTOS, Made, mismatch, turned_alone, verified_pairs


def test_a_turned_photo_is_named_and_registered_again(made: Made, tmp_path: Path) -> None:
    wrong = turned_alone(made, 5)
    checked = check_model(wrong, made.database, 0)
    assert checked.failed() == [5]
    assert list(reasons(wrong, checked)) == [wrong.image(5).name]
    options = incremental_options(0, MappingOptions(), camera_is_known=False, thinned=False)
    again = register_again(wrong, checked, made.database, tmp_path, tmp_path / "again", options)
    assert again.num_reg_images() == PHOTOS
    assert check_model(again, made.database, 0).check.passed.all()
    compared = compare_models(made.model, again)
    assert compared["agree"] == PHOTOS and compared["degrees"] < 0.2
    assert not (tmp_path / "again").exists()


def test_a_wholly_mismatched_photo_is_excluded_with_a_reason(made: Made) -> None:
    """Ten in a hundred photos with injected matches: here photo 5 has keypoints of others' points."""
    mismatch(made.database, {pair for pair in combinations(range(1, PHOTOS + 1), 2) if 5 in pair})
    checked = check_model(made.model, made.database, 0)
    assert checked.failed() == [5]
    (reason,) = reasons(made.model, checked).values()
    assert reason.code == "sfm.unregistered-misplaced" and reason.text.count("6,000") == 2
    deregister(made.model, checked.failed())
    assert made.model.num_reg_images() == PHOTOS - 1
    assert check_model(made.model, made.database, 0).check.passed.all()


def test_matches_consistent_with_trusted_pairs_are_kept(made: Made, tmp_path: Path) -> None:
    wrong = turned_alone(made, 5)
    photos = [Photo(f"{i:02}.jpg", f"images/{i:02}.jpg", 8, 8, 0, None, None, False, 1.0) for i in range(PHOTOS)]
    state: Any = SimpleNamespace(database=made.database, photos=photos)
    steps = consecutive_pairs(state)
    assert steps == {(i, i + 1) for i in range(1, PHOTOS)}
    copy = tmp_path / "consecutive.db"
    copy_consistent_matches(wrong, made.database, copy, {step for step in steps if 5 not in step} | {(4, 6)})
    assert verified_pairs(copy) == {pair for pair in combinations(range(1, PHOTOS + 1), 2) if 5 not in pair}
    copy_consistent_matches(wrong, made.database, copy, steps)  # trusted matches stay unless they are clearly off
    assert verified_pairs(copy) & {(4, 5), (5, 6)} == set()
