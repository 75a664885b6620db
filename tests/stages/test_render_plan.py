import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.scene import Camera
from stages.render_plan import affordable, chosen_fps

LANDSCAPE = Camera("PINHOLE", 1600, 1000, (1500.0, 1500.0, 800.0, 500.0))
PORTRAIT = Camera("PINHOLE", 1000, 1600, (1500.0, 1500.0, 500.0, 800.0))


def cost(frames: int, width: int, camera: Camera) -> float:
    return frames * width**2 * camera.height / camera.width


@given(st.integers(0, 10**10), st.sampled_from([LANDSCAPE, PORTRAIT]), st.floats(200, 1600))
def test_rendering_costs_at_most_half_of_training_or_is_as_small_as_it_gets(rays, camera, longest) -> None:
    frames, width = affordable(rays, camera, longest, None, None)
    long_side = width * max(camera.width, camera.height) / camera.width
    assert 24 <= frames <= 120
    assert 198 <= long_side <= longest + 4
    assert width % 2 == 0
    smallest = frames == 24 and long_side <= 204
    assert smallest or cost(frames, width, camera) <= 1.03 * 1.5 * rays


def test_much_training_gives_full_length_at_the_size_trained() -> None:
    assert affordable(10**9, LANDSCAPE, 800.0, None, None) == (120, 800)


def test_little_training_gives_the_shortest_and_smallest() -> None:
    assert affordable(1000, LANDSCAPE, 800.0, None, None) == (24, 200)
    assert affordable(1000, PORTRAIT, 800.0, None, None) == (24, 124)


def test_what_is_given_stands() -> None:
    assert affordable(1000, LANDSCAPE, 800.0, 77, 640) == (77, 640)
    assert affordable(10**7, LANDSCAPE, 800.0, None, 640)[1] == 640
    assert affordable(10**7, LANDSCAPE, 800.0, 33, None)[0] == 33


def test_small_photos_are_not_enlarged() -> None:
    assert affordable(10**9, Camera("PINHOLE", 150, 100, (1.0, 1.0, 75.0, 50.0)), 150.0, None, None) == (120, 150)


@pytest.mark.parametrize(("frames", "fps"), [(24, 10), (60, 15), (120, 30), (900, 30)])
def test_short_paths_play_slowly(frames: int, fps: int) -> None:
    assert chosen_fps(frames) == fps
