import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.geometry.scene import Camera
from stages import render
from stages.render.path import even_height
from stages.render.planning import choose_frames_and_width, default_fps, max_useful_side

LANDSCAPE = Camera("PINHOLE", 1600, 1000, (1500.0, 1500.0, 800.0, 500.0))
PORTRAIT = Camera("PINHOLE", 1000, 1600, (1500.0, 1500.0, 500.0, 800.0))
SIDES = st.floats(200, 1600)


def long_side(width: int, camera: Camera) -> float:
    return width * max(camera.width, camera.height) / camera.width


def pixels(frames: int, width: int, camera: Camera) -> int:
    """All pixels of a video of ``camera``'s proportions."""
    return frames * width * even_height(width, camera)


@given(st.floats(1, 1e10), st.sampled_from([LANDSCAPE, PORTRAIT]), SIDES)
def test_a_video_keeps_to_its_rays(rays, camera, longest) -> None:
    frames, width = choose_frames_and_width(rays, camera, longest, None, None)
    assert 6 <= frames <= 120
    assert 28 <= long_side(width, camera) <= longest
    assert width % 2 == 0
    smallest = frames == 6 and long_side(width, camera) <= 32
    rounding = 1 + 1 / min(width, width * camera.height / camera.width)  # of the height, to an even number
    assert smallest or pixels(frames, width, camera) <= rounding * rays


@given(st.floats(1, 1e10), st.integers(2, 8000), st.integers(2, 8000), st.floats(1, 50))
def test_what_is_planned_for_any_photo_may_be_asked_for(rays: float, across: int, down: int, downscale: float) -> None:
    """A plan is read back as options, so it has to keep their bounds: of narrow photos, too."""
    camera = Camera("PINHOLE", across, down, (1.0, 1.0, 1.0, 1.0))
    frames, width = choose_frames_and_width(rays, camera, max_useful_side(camera, downscale), None, None)
    render.Config.model_validate({"frames": frames, "width": width, "fps": default_fps(frames)})
    assert width % 2 == 0


@given(st.floats(1e3, 1e9), st.floats(1, 10), st.sampled_from([LANDSCAPE, PORTRAIT]), SIDES)
def test_more_rays_never_give_less(rays, more, camera, longest) -> None:
    (few, small), (many, large) = (choose_frames_and_width(r, camera, longest, None, None) for r in (rays, more * rays))
    assert few <= many
    assert pixels(few, small, camera) <= 1.1 * pixels(many, large, camera)


@given(st.floats(1e4, 1e9), SIDES)
def test_rays_are_not_left_over_before_the_video_is_full(rays, longest) -> None:
    frames, width = choose_frames_and_width(rays, LANDSCAPE, longest, None, None)
    full = frames == 120 and width > 0.98 * longest
    assert full or pixels(frames, width, LANDSCAPE) > 0.8 * rays


@pytest.mark.parametrize(
    ("squares", "frames", "side"),
    [
        (6 * 100**2, 6, 100),  # too few for anything that moves
        (12 * 200**2, 12, 200),
        (24 * 200**2, 24, 200),
        (24 * 5**0.5 * 200 * 480, 53, 310),  # half-way between this and full length
        (120 * 480**2, 120, 480),
        (120 * 600**2, 120, 600),
        (1e9, 120, 800),
    ],
)
def test_growing_rays_go_into_size_then_length_then_both(squares: float, frames: int, side: int) -> None:
    assert choose_frames_and_width(1.0001 * squares * 1000 / 1600, LANDSCAPE, 800.0, None, None) == (frames, side)


def test_what_is_given_stands() -> None:
    assert choose_frames_and_width(1000, LANDSCAPE, 800.0, 77, 640) == (77, 640)
    assert choose_frames_and_width(10**7, LANDSCAPE, 800.0, None, 640) == (39, 640)
    assert choose_frames_and_width(10**7, LANDSCAPE, 800.0, 100, None) == (100, 400)


@pytest.mark.parametrize(
    ("size", "downscale", "side"),
    [((1600, 1000), 2.0, 800), ((1600, 1000), 8.0, 480), ((150, 100), 1.0, 150), ((4000, 3000), 1.0, 1920)],
)
def test_no_larger_than_trained_unless_that_is_tiny(size: tuple[int, int], downscale: float, side: int) -> None:
    assert max_useful_side(Camera("PINHOLE", *size, (1.0, 1.0, 1.0, 1.0)), downscale) == side


@pytest.mark.parametrize(("frames", "fps"), [(2, 1), (6, 2), (24, 6), (60, 15), (120, 30), (900, 30)])
def test_short_paths_play_slowly(frames: int, fps: int) -> None:
    assert default_fps(frames) == fps
