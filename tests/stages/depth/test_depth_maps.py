"""Depth maps of walls against the truth."""

from pathlib import Path

import numpy as np
import pytest

from stages.depth import Config, run
from stages.depth.consistency import DepthMap
from stages.depth.files import depth_map_file, read_depth_map
from tests.conftest import RecordedProgress
from tests.stages.depth.walls import FISHEYE, Wall, WallScene, cameras_before, wall

BOX = ((0.1, -0.3, 0), (0.35, 0.3), 10.0, "strong", 2)


def back(texture: str = "strong", turn_deg: float = 0.0):
    return wall((0, 1.0, 0), (3, 2), turn_deg, texture, seed=1)


def depth_maps(scene: WallScene, folder: Path, **options) -> list[DepthMap]:
    """What the stage makes of a scene, at the photos' own size."""
    inputs, out = scene.write(folder), folder / "depth"
    out.mkdir()
    run(Config(downscale=1.0, **options), inputs, out, RecordedProgress())
    return [read_depth_map(depth_map_file(out, f"images/{index:03d}.png")) for index in range(len(scene.poses))]


def errors(scene: WallScene, maps: list[DepthMap]) -> tuple[float, np.ndarray, np.ndarray]:
    """Share of the walls' pixels with a depth, its relative errors, and these over their standard deviations."""
    covered, error, over_sigma = [], [], []
    for view, depth in enumerate(maps):
        true = scene.distances(view, *depth.distance.shape[::-1])
        wall_, known = np.isfinite(true), depth.distance > 0
        covered.append((known & wall_).sum() / wall_.sum())
        error.append((depth.distance / true - 1)[known & wall_])
        over_sigma.append(error[-1] / depth.sigma[known & wall_])
    return float(np.mean(covered)), np.concatenate(error), np.concatenate(over_sigma)


SCENES = {
    "slanted": WallScene([back(turn_deg=35)], cameras_before()),
    "something in front": WallScene([back(), wall(*BOX)], cameras_before()),
    "repeated": WallScene([back("repeated")], cameras_before()),
    "rolled, exposed differently": WallScene(
        [back(turn_deg=20)], cameras_before(roll_deg=25), gains=[1, 0.7, 1.2, 0.8, 1.1, 0.6]
    ),
    "fisheye": WallScene([back(turn_deg=10)], cameras_before(), camera=FISHEYE),
}


@pytest.mark.parametrize("name", SCENES)
def test_textured_walls_are_where_they_are(name: str, tmp_path: Path) -> None:
    scene = SCENES[name]
    covered, error, over_sigma = errors(scene, depth_maps(scene, tmp_path))
    assert 0.7 < covered <= 1
    assert 0 < np.median(np.abs(error)) < 0.003
    assert np.abs(np.median(error)) < 0.0005, "no bias"
    assert np.mean(np.abs(error) > 0.03) < 0.01
    assert 0.3 < np.median(np.abs(over_sigma)) < 1.2, "the standard deviation is one (0.67 for a normal law)"


def glass(reflects: float, y: float, half: tuple[float, float], turn_deg: float = 0.0) -> Wall:
    return wall((0, y, 0), half, turn_deg, "none")._replace(reflects=reflects)


BEHIND_THE_CAMERAS = wall((0, -5.0, 0), (6, 4), 0.0, "strong", 5)


def wrong(scene: WallScene, folder: Path, by: float = 0.03) -> tuple[float, float]:
    """Shares of the walls' pixels that have a depth, and that have a wrong one."""
    covered, error, _ = errors(scene, depth_maps(scene, folder))
    return covered, covered * float(np.mean(np.abs(error) > by))


def test_a_repeated_pattern_stands_on_its_wall(tmp_path: Path) -> None:
    """Cameras at even distances, and a near thing, so that a wall a period in front of the true one is looked for."""
    near = wall((0, -1, 0), (0.25, 0.2), 10, seed=2)
    covered, bad = wrong(WallScene([back("repeated"), near], cameras_before(rows=1, columns=5)), tmp_path)
    assert 0.5 < covered < 0.7
    assert 0 < bad < 0.002, "0.05 where patches are not looked at"


@pytest.mark.parametrize(("reflects", "least_covered", "most_wrong"), [(0.2, 0.75, 0.03), (0.5, 0.0, 0.02)])
def test_a_window_pane_leaves_little_wrong(
    reflects: float, least_covered: float, most_wrong: float, tmp_path: Path
) -> None:
    pane = glass(reflects, -0.5, (2, 1.5), 10)
    covered, bad = wrong(WallScene([back(), BEHIND_THE_CAMERAS, pane], cameras_before()), tmp_path)
    assert least_covered < covered < 0.9
    assert 0 < bad < most_wrong


def test_a_mirror_shows_nothing_in_front_of_it(tmp_path: Path) -> None:
    scene = WallScene([back(), BEHIND_THE_CAMERAS, glass(1.0, 0.99, (0.5, 0.4))], cameras_before())
    maps = depth_maps(scene, tmp_path)
    solid = WallScene([back()], scene.poses)
    inside = [scene.distances(view, 240, 180) > 5 for view in range(len(maps))]
    known = [(m.distance > 0) & at for m, at in zip(maps, inside, strict=True)]
    nearer = [(m.distance < 0.97 * solid.distances(view, 240, 180)) & known[view] for view, m in enumerate(maps)]
    assert 0.05 < np.mean(inside) < 0.2
    assert np.mean(known) < 0.1 * np.mean(inside)
    assert np.mean(nearer) < 0.01 * np.mean(inside)


def test_a_bare_wall_has_no_depth(tmp_path: Path) -> None:
    scene = WallScene([back("none"), wall(*BOX)], cameras_before())
    maps = depth_maps(scene, tmp_path)
    covered, _, _ = errors(scene, maps)
    bare = np.concatenate([scene.distances(i, 240, 180)[m.distance > 0] for i, m in enumerate(maps)]) > 3
    assert 0.05 < covered < 0.2, "the box alone takes a tenth of the photos"
    assert bare.mean() < 0.2, "and hardly reaches beyond its outline"


def test_weak_texture_says_how_uncertain_it_is(tmp_path: Path) -> None:
    scene = WallScene([back("weak")], cameras_before())
    strong, weak = (
        errors(one, depth_maps(one, tmp_path / name))
        for name, one in (("s", WallScene([back()], cameras_before())), ("w", scene))
    )
    assert 0.3 < weak[0] < strong[0]
    assert 2 < np.median(np.abs(weak[1])) / np.median(np.abs(strong[1])) < 20
    assert np.median(np.abs(weak[2])) < 1.5


def test_masked_pixels_have_no_depth(tmp_path: Path) -> None:
    mask = np.full((180, 240), 255, np.uint8)
    mask[:, :100] = 0
    maps = depth_maps(WallScene([back()], cameras_before(), mask=mask), tmp_path)
    shares = np.array([[(m.distance[:, :100] > 0).mean(), (m.distance[:, 100:] > 0).mean()] for m in maps])
    assert shares[:, 0].max() == 0
    assert 0.3 < shares[:, 1].mean() < 1
