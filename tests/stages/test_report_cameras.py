from typing import Any

import pytest

from stages.report_cameras import MAX_SHOWN, camera_report

PHOTOS = 60


def registration(**changed: Any) -> dict[str, Any]:
    check = {"pairs": 800, "agreeing": 780, "error_px": 0.25, "tolerance_px": 0.75, "doubtful": [], "weak_links": []}
    opinion = {"photos": PHOTOS, "agree": PHOTOS, "elsewhere": [], "centre": 0.0006, "degrees": 0.02, "failed": None}
    images = [{"file": f"{i}.jpg", "registered": True, "reason": None} for i in range(PHOTOS)]
    whole = {"photos": PHOTOS, "registered": PHOTOS, "check": check, "second_opinion": opinion, "images": images}
    return whole | {"repeated_structure": None} | changed


def files(count: int) -> list[str]:
    return [f"{i}.jpg" for i in range(count)]


def test_cameras_that_agree_are_said_to_with_figures() -> None:
    report = camera_report(registration())
    assert not report.doubtful and not report.groups
    assert report.verdict and all(figure in report.verdict for figure in ("780 of 800", "0.25 px", "60 of 60", "0.06%"))


@pytest.mark.parametrize(
    ("changed", "groups"),
    [
        ({"check": registration()["check"] | {"doubtful": files(4)}}, 1),
        ({"check": registration()["check"] | {"agreeing": 399}}, 0),
        ({"check": registration()["check"] | {"weak_links": [{"photos": files(20), "pairs": 1, "matches": 40}]}}, 1),
        ({"second_opinion": registration()["second_opinion"] | {"elsewhere": files(4)}}, 1),
        ({"repeated_structure": {"photos": files(2), "others": files(9)}}, 2),
        (
            {
                "images": [
                    {
                        "file": f"{i}.jpg",
                        "registered": i > 4,
                        "reason": "its place is contradicted by 9" if i < 5 else None,
                    }
                    for i in range(PHOTOS)
                ]
            },
            1,
        ),
    ],
)
def test_each_kind_of_doubt_makes_the_cameras_doubtful(changed: dict[str, Any], groups: int) -> None:
    report = camera_report(registration(**changed))
    assert report.doubtful and report.verdict and len(report.groups) == groups


def test_a_single_photo_out_of_many_is_shown_and_casts_no_doubt() -> None:
    report = camera_report(registration(check=registration()["check"] | {"doubtful": files(1)}))
    assert not report.doubtful and [group.files for group in report.groups] == [["0.jpg"]]


def test_of_a_large_group_the_first_photos_are_shown() -> None:
    check = registration()["check"] | {"doubtful": files(20)}
    (group,) = camera_report(registration(check=check)).groups
    assert (len(group.files), group.more) == (MAX_SHOWN, 20 - MAX_SHOWN)


@pytest.mark.parametrize("opinion", [None, {"failed": "global mapping found no model"}])
def test_without_a_second_opinion_the_check_stands_alone(opinion: dict[str, Any] | None) -> None:
    report = camera_report(registration(second_opinion=opinion))
    assert not report.doubtful and report.verdict and "global" not in report.verdict


@pytest.mark.parametrize("unchecked", [None, {}, {"check": None}])
def test_nothing_is_said_of_cameras_that_were_not_checked(unchecked: dict[str, Any] | None) -> None:
    assert camera_report(unchecked) == (None, False, [])
