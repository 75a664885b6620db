"""Stage scale on photos of printed markers with exactly known cameras: the scale, its error, and what is refused."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf.geometry.scene import Similarity
from stages import scale
from stages.contract import run_stage
from stages.io.files import read_json, write_json, write_png, write_tensors
from stages.scale.lengths import length_in_words, parse_length, parse_point
from stages.scale.marker_detection import cells_of, find_markers, locate_corners, luminance
from stages.scale.marker_names import DICTIONARIES, Marker, parse_marker, printed_name
from stages.scale.square_fit import CornerObservations, fit_square
from tests.stages.scale.marker_scene import CAMERA, Printed, photograph_markers, poses, scene_of

SCENE_FROM_SFM = Similarity(0.4, Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([0.1, 0.2, -0.3]))
SEVEN = Printed("4X4_50", 7, 0.16, (-0.12, 0.0))
TAG = Printed("APRILTAG_36h11", 3, 0.2, (0.14, 0.05), turned=-0.5)
PHOTOS = 6


@cache
def photos_of(markers: tuple[Printed, ...], count: int = PHOTOS, seed: int = 0) -> tuple[np.ndarray, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    places = poses(count, rng)
    return places, [photograph_markers(markers, pose, rng) for pose in places]


def measured(
    folder: Path,
    progress: Any,
    photos: tuple[np.ndarray, Sequence[np.ndarray]],
    georeference: dict[str, Any] | None = None,
    **config: Any,
) -> dict[str, Any]:
    """scale.json of a run."""
    inputs = {name: folder / name for name in scale.STAGE.inputs}
    places, pictures = photos
    files = [f"{number}.png" for number in range(len(pictures))]
    for file, picture in zip(files, pictures, strict=True):
        write_png(inputs["ingest"] / "images" / file, picture)
    for name in ("sfm", "normalise", "out"):
        (folder / name).mkdir()
    write_json(inputs["sfm"] / "registration.json", {"georeference": georeference})
    write_json(inputs["normalise"] / "scene.json", scene_of(places, SCENE_FROM_SFM, files).to_json())
    write_tensors(inputs["normalise"] / "points.safetensors", {"xyz": np.zeros((0, 3), np.float32)})
    run_stage(scale.STAGE, scale.Config(**config), inputs, folder / "out", progress)
    return read_json(folder / "out/scale.json")


def units(metres_per_scene_unit: float) -> float:
    """Metres a unit of the sfm frame."""
    return metres_per_scene_unit * SCENE_FROM_SFM.scale


def test_two_markers_of_different_kinds_tell_the_scale(tmp_path: Path, progress: Any) -> None:
    # The markers' world is the scene frame: 0.16 of its units are 80 mm.
    told = measured(tmp_path, progress, photos_of((SEVEN, TAG)), marker=("4X4_50:7=80mm", "tag36h11:3=10cm"))
    assert told["source"] == "marker"
    assert told["metres_per_unit"] == pytest.approx(units(0.5), rel=0.002)
    assert 0 < told["relative_error"] < 0.003 and not progress.notes
    corners = SCENE_FROM_SFM.points(np.array(told["references"][0]["corners"]))
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) == pytest.approx([0.16] * 4, rel=0.003)
    assert np.abs(corners.mean(axis=0) - [-0.12, 0, 0]).max() < 0.001


def test_interval_covers_the_scale_when_poses_are_inexact() -> None:
    places, pictures = photos_of((SEVEN,), count=10)
    cells, covered, errors = cells_of("4X4_50"), 0, []
    seen = [find_markers(picture, "4X4_50")[0] for picture in pictures]
    corners = [
        locate_corners(luminance(picture), found, cells, CAMERA) for picture, found in zip(pictures, seen, strict=True)
    ]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rotations = places[:, :, :3] @ Rotation.from_rotvec(rng.normal(0, 0.0015, (len(places), 3))).as_matrix()
        centres = places[:, :, 3] + rng.normal(0, 0.0015, (len(places), 3))
        turned = rotations.transpose(0, 2, 1)
        from_world = np.concatenate([turned, -turned @ centres[..., None]], axis=2)
        square = fit_square(CornerObservations(from_world, np.array(corners), np.full(len(places), 430.0)))
        assert square is not None
        errors.append(square.side / SEVEN.side - 1)
        covered += abs(square.side - SEVEN.side) < 2 * square.standard_error
    assert covered >= 17 and 0.0005 < np.std(errors) < 0.01


def test_edges_are_half_way_in_linear_light_not_in_srgb() -> None:
    places, pictures = photos_of((SEVEN,))
    turned = places[:, :, :3].transpose(0, 2, 1)
    from_world = np.concatenate([turned, -turned @ places[:, :, 3:]], axis=2)

    def off(light_of: Callable[[np.ndarray], np.ndarray]) -> float:
        corners = [
            locate_corners(light_of(picture), find_markers(picture, "4X4_50")[0], 6, CAMERA) for picture in pictures
        ]
        square = fit_square(CornerObservations(from_world, np.array(corners), np.full(len(places), 430.0)))
        assert square is not None
        return square.side / SEVEN.side - 1

    assert abs(off(luminance)) < 0.001 and off(lambda picture: picture[..., 0] / 255) < -0.01


@pytest.mark.parametrize(
    ("printed", "problem"),
    [
        ((), "not-found"),
        ((TAG,), "other-markers"),
        ((SEVEN._replace(mirrored=True),), "mirrored"),
        ((SEVEN, SEVEN._replace(centre=(0.16, 0.0))), "repeated"),
        ((SEVEN._replace(stretch=1.1),), "not-square"),
        ((SEVEN._replace(cut=0.08),), "not-square"),
    ],
)
def test_a_marker_that_is_wrong_is_named(
    printed: tuple[Printed, ...], problem: str, tmp_path: Path, progress: Any
) -> None:
    told = measured(tmp_path, progress, photos_of(printed), marker=("4X4_50:7=80mm",))
    assert told["metres_per_unit"] is None and told["source"] is None
    assert [one["problem"] for one in told["references"]] == [problem] and progress.codes == [f"scale.{problem}"]


@pytest.mark.parametrize("printed", [SEVEN._replace(stretch=1.035), SEVEN._replace(cut=0.035)])
def test_interval_covers_a_marker_slightly_out_of_proportion(printed: Printed, tmp_path: Path, progress: Any) -> None:
    told = measured(tmp_path, progress, photos_of((printed,)), marker=("4X4_50:7=80mm",))
    off = abs(told["metres_per_unit"] / units(0.5) - 1)
    assert 0.01 < off < 2 * told["relative_error"] < 0.03


def test_markers_shown_instead_of_the_one_given_are_named(tmp_path: Path, progress: Any) -> None:
    measured(tmp_path, progress, photos_of((SEVEN, TAG)), marker=("5X5_50:7=80mm", "4X4_100:7=8cm"))
    assert progress.codes == ["scale.other-markers"] and progress.names("scale.other-markers", "APRILTAG_36h11:3:")
    progress.clear()
    measured(tmp_path / "both", progress, photos_of((SEVEN, TAG)), marker=("4X4_50:8=80mm",))
    assert progress.names("scale.other-markers", "4X4_50:7", "APRILTAG_36h11:3")


def test_a_photo_that_shows_a_marker_twice_is_left_out(tmp_path: Path, progress: Any) -> None:
    places, once = photos_of((SEVEN,))
    _, twice = photos_of((SEVEN, SEVEN._replace(centre=(0.16, 0.0))))
    told = measured(tmp_path, progress, (places, [twice[0], *once[1:]]), marker=("4X4_50:7=80mm",))
    assert told["metres_per_unit"] == pytest.approx(units(0.5), rel=0.002) and not progress.notes
    assert told["references"][0]["photos"] == len(once) - 1


def test_a_marker_that_was_moved_is_named(tmp_path: Path, progress: Any) -> None:
    places, here = photos_of((SEVEN,))
    _, there = photos_of((SEVEN._replace(centre=(0.15, 0.1)),))
    told = measured(tmp_path, progress, (places, [*here[:3], *there[3:]]), marker=("4X4_50:7=80mm",))
    assert told["references"][0]["problem"] == "several-places"


def test_one_photo_of_a_marker_is_too_few(tmp_path: Path, progress: Any) -> None:
    places, with_tag = photos_of((SEVEN, TAG))
    _, without = photos_of((TAG,))
    told = measured(
        tmp_path, progress, (places, [*with_tag[:1], *without[1:]]), marker=("4X4_50:7=80mm", "tag36h11:3=10cm")
    )
    assert [one["problem"] for one in told["references"]] == ["one-photo", None]
    assert told["metres_per_unit"] == pytest.approx(units(0.5), rel=0.002)


def test_two_markers_that_disagree_are_both_named(tmp_path: Path, progress: Any) -> None:
    told = measured(tmp_path, progress, photos_of((SEVEN, TAG)), marker=("4X4_50:7=80mm", "tag36h11:3=11cm"))
    assert told["metres_per_unit"] is None and progress.codes == ["scale.no-agreement"]
    assert {one["problem"] for one in told["references"]} == {"disagrees"}


def test_a_distance_decides_between_markers_that_disagree(tmp_path: Path, progress: Any) -> None:
    start, end = (SCENE_FROM_SFM.inverse().points(np.array(point)) for point in ([0.0, 0, 0], [0.5, 0, 0]))
    distance = (*(",".join(map(str, point)) for point in (start, end)), "25cm")
    markers = ("4X4_50:7=80mm", "tag36h11:3=11cm")
    told = measured(tmp_path, progress, photos_of((SEVEN, TAG)), marker=markers, distance=distance)
    assert [one["problem"] for one in told["references"]] == [None, "disagrees", None]
    assert told["metres_per_unit"] == pytest.approx(units(0.5), rel=0.003)
    assert progress.codes == ["scale.contradiction"]


@pytest.mark.parametrize(
    ("start", "end", "problem"),
    [
        ("0,0,0", "1,0,0", None),
        ("0,0,0", "0.0049,0,0", "points-too-near"),
        ("0,0,0", "1e-320,0,0", "points-too-near"),
        ("110,420,1900", "350,400,1880", "point-outside"),
        ("1e308,0,0", "-1e308,0,0", "point-outside"),
    ],
)
def test_points_that_nobody_can_have_picked_are_named(
    start: str, end: str, problem: str | None, tmp_path: Path, progress: Any
) -> None:
    told = measured(tmp_path, progress, photos_of((TAG,)), distance=(start, end, "25cm"))
    assert told["metres_per_unit"] == (None if problem else 0.25) and told["references"][0]["problem"] == problem
    assert progress.codes == ([f"scale.{problem}"] if problem else [])


GPS = {"metres_per_unit": 3.0, "error_m": 0.05, "photos": PHOTOS}


def test_gps_tells_the_scale_where_nothing_else_does(tmp_path: Path, progress: Any) -> None:
    told = measured(tmp_path, progress, photos_of((TAG,)), georeference=GPS)
    assert (
        told["source"] == "gps" and told["metres_per_unit"] == pytest.approx(3.0) and 0 < told["relative_error"] < 0.1
    )


def test_inexact_gps_gives_no_metres(tmp_path: Path, progress: Any) -> None:
    exact = measured(tmp_path / "exact", progress, photos_of((TAG,)), georeference=GPS)
    limit_m = GPS["error_m"] * 0.25 / (2 * exact["relative_error"])
    for share, metres in ((0.99, pytest.approx(3.0)), (1.01, None)):
        georeference = GPS | {"error_m": share * limit_m}
        told = measured(tmp_path / str(share), progress, photos_of((TAG,)), georeference=georeference)
        assert told["metres_per_unit"] == metres
    assert told["source"] is None and told["references"][0]["problem"] == "gps-inexact"
    assert progress.codes == ["scale.gps-inexact"] and progress.names("scale.gps-inexact", "3 m ± 25%", "25%")


def test_gps_that_contradicts_a_marker_is_named(tmp_path: Path, progress: Any) -> None:
    told = measured(tmp_path, progress, photos_of((TAG,)), georeference=GPS, marker=("tag36h11:3=10cm",))
    assert told["metres_per_unit"] == pytest.approx(units(0.5), rel=0.003)
    assert progress.codes == ["scale.gps-disagrees"]


def test_without_any_length_the_scale_is_unknown(tmp_path: Path, progress: Any) -> None:
    told = measured(tmp_path, progress, photos_of((TAG,)))
    assert told == {"metres_per_unit": None, "relative_error": None, "source": None, "references": []}


def test_dictionaries_are_those_of_opencv() -> None:
    patterns = {
        name: cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}")).bytesList for name in DICTIONARIES
    }
    assert {name: len(each) for name, each in patterns.items()} == DICTIONARIES
    for name, each in patterns.items():
        smallest = [printed_name(name, number).split(":")[0] for number in range(len(each))]
        assert all((each[number] == patterns[which][number]).all() for number, which in enumerate(smallest))


@pytest.mark.parametrize(
    ("text", "marker"),
    [
        ("4X4_50:7=50mm", Marker("4X4_50", 7, 0.05)),
        ("DICT_5x5_100:3=1.5 cm", Marker("5X5_100", 3, 0.015)),
        ("tag36h11:0=2in", Marker("APRILTAG_36h11", 0, 0.0508)),
        ("AprilTag_36h11:586=1e-1m", Marker("APRILTAG_36h11", 586, 0.1)),
    ],
)
def test_markers_are_read_as_people_write_them(text: str, marker: Marker) -> None:
    assert parse_marker(text) == marker._replace(side_m=pytest.approx(marker.side_m))


@pytest.mark.parametrize(
    "options",
    [
        *({"marker": (text,)} for text in ("4X4_50:7", "4X4:7=50mm", "4X4_50:50=5cm", "4X4_50:7=50", "4X4_50:7=-5cm")),
        *({"distance": one} for one in (("1,2", "1,2,3", "1m"), ("1,2,3", "1,2,3", "1m"), ("1,2,3", "1,2,nan", "1m"))),
        {"distance": ("1,2,3", "3,2,1", "0m")},
    ],
)
def test_what_cannot_be_meant_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        scale.Config(**options)


def test_the_last_length_of_a_marker_counts() -> None:
    given = ("4X4_50:7=5cm", "tag36h11:3=2in", "dict_4x4_50:7=6cm")
    assert scale.Config(marker=given).marker == ("dict_4x4_50:7=6cm", "tag36h11:3=2in")


def test_a_marker_named_by_two_dictionaries_counts_once() -> None:
    given = ("4X4_50:7=5cm", "4X4_1000:7=6cm", "5X5_50:7=5cm", "4X4_1000:50=5cm", "4X4_100:50=7cm")
    assert scale.Config(marker=given).marker == ("4X4_1000:7=6cm", "5X5_50:7=5cm", "4X4_100:50=7cm")


def test_lengths_have_units() -> None:
    assert parse_length("12.5 cm") == 0.125 and parse_length("6ft") == pytest.approx(1.8288)
    assert parse_point("1,-2.5,3e1") == (1.0, -2.5, 30.0)
    assert [length_in_words(m) for m in (0.05, 0.0012, 1.25, 3400)] == ["5 cm", "1.2 mm", "1.25 m", "3.4 km"]
