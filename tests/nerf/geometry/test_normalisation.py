import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf.geometry.camera_paths import nearest_rotations
from nerf.geometry.near_far import MIN_NEAR
from nerf.geometry.normalisation import Normalisation, normalise
from nerf.geometry.reconstruction import Reconstruction, angles_deg, extent
from nerf.geometry.region_of_interest import find_capture_type
from nerf.geometry.up_vector import Witness
from tests.camera_layouts import (
    ball,
    ground,
    opaque_everywhere,
    ring,
    room,
    room_points,
    seen_by,
    survey,
    wall,
    wall_points,
)

SCENES = {
    "object-centric": lambda: seen_by(ring(), ball()),
    "forward-facing": lambda: seen_by(wall(), wall_points()),
    "inside-out": lambda: seen_by(room(), room_points()),
}


def with_points(scene: Reconstruction, points: np.ndarray, views: int) -> Reconstruction:
    """The scene with more points, each seen by the first ``views`` photos."""
    count = len(scene.points)
    view, point = np.meshgrid(np.arange(views), count + np.arange(len(points)))
    return dataclasses.replace(
        scene,
        points=np.concatenate([scene.points, points]),
        view=np.concatenate([scene.view, view.ravel()]),
        point=np.concatenate([scene.point, point.ravel()]),
    )


def region_half(found: Normalisation) -> float:
    return 0.9 / found.scene_from_sfm.scale


@pytest.mark.parametrize("capture_type", SCENES)
def test_layouts_are_told_apart(capture_type: str) -> None:
    assert find_capture_type(SCENES[capture_type]()) == capture_type


def test_a_wide_arc_is_around_a_narrow_one_forward() -> None:
    assert find_capture_type(seen_by(ring(arc_deg=110.0), ball())) == "object-centric"
    assert find_capture_type(seen_by(ring(arc_deg=30.0), ball())) == "forward-facing"


@pytest.mark.parametrize("capture_type", SCENES)
def test_the_region_is_filled_by_what_is_seen(capture_type: str) -> None:
    scene = SCENES[capture_type]()
    found = normalise(scene, None)
    reach = np.abs(found.scene_from_sfm.points(scene.points))[np.unique(scene.point)].max(axis=1)
    assert (reach <= 0.9).mean() >= 0.94
    assert np.quantile(reach, 0.95) > 0.35


@pytest.mark.parametrize("capture_type", SCENES)
def test_up_becomes_z_and_the_frame_is_a_rotation(capture_type: str) -> None:
    found = normalise(SCENES[capture_type](), None)
    rotation = found.scene_from_sfm.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0
    assert found.up.known
    np.testing.assert_allclose(rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-6)


def test_a_facade_faces_plus_y() -> None:
    found = normalise(SCENES["forward-facing"](), None)
    np.testing.assert_allclose(found.scene_from_sfm.rotation, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("shaken", [0.0, 0.02])
def test_the_ground_lies_flat_along_the_flight(shaken: float) -> None:
    """Where photos look along up their axes have no heading but noise."""
    poses = survey()
    poses[:, :, :3] = nearest_rotations(poses[:, :, :3] + np.random.default_rng(1).normal(0, shaken, (48, 3, 3)))
    found = normalise(seen_by(poses, ground()), None, Witness(0.01, np.array([0.0, 0, 1]), "GPS"))
    assert (found.capture_type, found.up.known) == ("forward-facing", True)
    xyz = found.scene_from_sfm.points(ground(relief=0.0))
    assert np.ptp(xyz[:, 2]) < 0.06
    east = found.scene_from_sfm.rotation @ [1.0, 0, 0]
    assert np.abs(east).max() > 0.998


@pytest.mark.parametrize("capture_type", SCENES)
def test_far_outliers_hardly_change_the_scale(capture_type: str) -> None:
    clean = SCENES[capture_type]()
    random = np.random.default_rng(1)
    spoilt = with_points(clean, 1e4 * random.normal(size=(15, 3)), views=2)
    before, after = region_half(normalise(clean, None)), region_half(normalise(spoilt, None))
    assert 0.8 * before < after < 1.3 * before


@pytest.mark.parametrize("capture_type", SCENES)
def test_one_far_camera_hardly_changes_the_scale(capture_type: str) -> None:
    clean = SCENES[capture_type]()
    from_camera = clean.from_camera.copy()
    from_camera[3, :, 3] += 1e3 * np.array([0.3, -0.9, 0.3])
    keep = clean.view != 3
    spoilt = dataclasses.replace(clean, from_camera=from_camera, view=clean.view[keep], point=clean.point[keep])
    before, after = region_half(normalise(clean, None)), region_half(normalise(spoilt, None))
    assert 0.8 * before < after < 1.25 * before


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(sorted(SCENES)),
    st.integers(0, 1000),
    st.floats(-6, 6).map(lambda exponent: 10.0**exponent),
    st.floats(0, 1e6),
)
def test_similar_reconstructions_give_the_same_scene(capture_type: str, seed: int, scale: float, offset: float) -> None:
    scene = SCENES[capture_type]()
    turn = nearest_rotations(np.random.default_rng(seed).normal(size=(3, 3)))
    # the sfm frame is offset by up to a million of its own units, which float64 holds to 1e-10 of them
    shift = np.array([offset, -offset, offset / 2]) * min(1.0, scale)
    moved = scene.in_frame(turn, -turn.T @ shift / scale, scale)
    one, other = normalise(scene, None), normalise(moved, None)
    assert (one.capture_type, one.bounded, one.up.source) == (other.capture_type, other.bounded, other.up.source)
    np.testing.assert_allclose(
        other.scene_from_sfm.points(moved.points), one.scene_from_sfm.points(scene.points), atol=1e-5
    )
    np.testing.assert_allclose(other.near, one.near, rtol=1e-4)
    np.testing.assert_allclose(other.far, one.far, rtol=1e-4)


@pytest.mark.parametrize("capture_type", SCENES)
@pytest.mark.parametrize("has_alpha", [False, True])
def test_every_observed_point_but_outliers_lies_between_near_and_far(capture_type: str, has_alpha: bool) -> None:
    scene = opaque_everywhere(SCENES[capture_type]()) if has_alpha else SCENES[capture_type]()
    found = normalise(scene, None)
    distance = scene.distances() * found.scene_from_sfm.scale
    assert (found.near > 0).all()
    assert (found.near[scene.view] < distance).mean() > 0.99
    assert (found.far[scene.view] > distance).mean() > 0.995
    assert (found.near < 0.999 * found.far).all()


@pytest.mark.parametrize("views", [1, 8])
@pytest.mark.parametrize("behind", [0, 20_000])
def test_near_lies_before_what_only_other_photos_have_points_of(views: int, behind: int) -> None:
    """The foremost part of a thing, on which matching fails in some photos: their near must not cut it off, however
    many points there are farther away."""
    scene = SCENES["object-centric"]()
    if behind:
        scene = with_points(scene, np.array([0.0, 0.0, -40.0]) + ball(behind, 10.0), 3)
    close = scene.distances() < 4.0
    unmatched = (scene.view < views) & close
    matched = dataclasses.replace(scene, view=scene.view[~unmatched], point=scene.point[~unmatched])
    found = normalise(matched, None)
    distance = scene.distances() * found.scene_from_sfm.scale
    assert (found.near[scene.view] < distance)[close].mean() > 0.99


def test_far_lies_behind_what_only_other_photos_have_points_of() -> None:
    scene = with_points(SCENES["object-centric"](), np.array([0.0, 300.0, 0.0]) + ball(100, 5.0), 16)
    unmatched = ~np.isin(scene.view, [7, 9, 10]) & (scene.point >= 400)
    matched = dataclasses.replace(scene, view=scene.view[~unmatched], point=scene.point[~unmatched])
    found = normalise(matched, None)
    assert found.far[8] > 290 * found.scene_from_sfm.scale  # it looks there, from y = -4
    assert found.far[0] == 20  # it looks away


def test_near_clusters_of_many_points_are_no_false_matches() -> None:
    scene = SCENES["object-centric"]()
    rail = scene.centres[0] + 0.05 * scene.axes[0] + 0.01 * ball(30)
    found, clean = normalise(with_points(scene, rail, 4), None), normalise(scene, None)
    assert found.near[0] < 0.05 * found.scene_from_sfm.scale < 0.05 * clean.near[0] / 0.7 * 3


def test_near_lies_before_what_photos_see_in_large_scenes() -> None:
    """A flight of 3 km at 40 m, over ground with a mast on it that photo 0 has no points of."""
    scene = seen_by(survey(lines=2, photos=100, height=40.0), ground(1500.0, 5.0, 40_000))
    mast = scene.centres[0] + 30.0 * scene.axes[0] + ball(12)
    with_mast = with_points(scene, mast, 4)
    own = (with_mast.view == 0) & (with_mast.point >= len(scene.points))
    found = normalise(dataclasses.replace(with_mast, view=with_mast.view[~own], point=with_mast.point[~own]), None)
    distance = found.scene_from_sfm.scale * scene.distances()
    assert distance.max() < MIN_NEAR
    assert (found.near[scene.view] < distance).mean() > 0.999


def test_unsure_or_unseen_points_do_not_set_near() -> None:
    scene = SCENES["object-centric"]()
    centre, axis, right = scene.centres[0], scene.axes[0], scene.rights[0]
    jitter = 0.01 * ball(50)

    def near_beside(points: np.ndarray, views: int) -> float:
        """Of photo 0, where the next photos have these points."""
        with_them = with_points(scene, points, views + 1)
        own = (with_them.view == 0) & (with_them.point >= len(scene.points))
        return normalise(
            dataclasses.replace(with_them, view=with_them.view[~own], point=with_them.point[~own]), None
        ).near[0]

    clean = normalise(scene, None).near[0]
    elsewhere = np.concatenate([centre - 0.5 * axis + jitter, centre + 0.5 * axis + 0.6 * right + jitter])
    assert near_beside(elsewhere, 3) == pytest.approx(clean, rel=0.02)
    assert near_beside(centre + 0.5 * axis + jitter, 2) == pytest.approx(clean, rel=0.02)
    assert near_beside(centre + 0.5 * axis + jitter[:9], 3) == pytest.approx(clean, rel=0.02)
    assert near_beside(centre + 0.5 * axis + jitter, 3) < 0.5 * clean


def opaque_where(scene: Reconstruction, solid: np.ndarray) -> Reconstruction:
    """The scene with photos whose alpha leaves a solid of points, and what holds it."""
    boxes = [extent(np.clip(scene.project(view, solid)[0], *scene.field(view))) for view in range(len(scene.centres))]
    return dataclasses.replace(scene, opaque=np.stack(boxes))


def test_with_alpha_the_region_holds_all_opaque_parts() -> None:
    bottle = ball(4000) * [0.3, 0.3, 1.0] + [0.0, 0.0, 0.2]
    scene = opaque_where(seen_by(ring(), 0.2 * ball()), bottle)
    found = normalise(scene, None)
    assert np.abs(found.scene_from_sfm.points(bottle)).max() <= 0.95
    assert region_half(found) == pytest.approx(1.0, rel=0.15)


def test_alpha_is_no_background_where_the_scene_continues() -> None:
    thing = ball(4000)
    scene = opaque_where(seen_by(ring(), ball()), thing)
    few = normalise(with_points(scene, 20 * ball(3), views=16), None)  # wrong, half a percent of what is seen
    assert few.bounded and 0 < few.beyond_alpha < 0.01
    assert region_half(few) < 1.3 * region_half(normalise(scene, None))
    many = with_points(scene, 20 * ball(30), views=16)
    found, opaque = normalise(many, None), normalise(dataclasses.replace(many, opaque=None), None)
    assert not found.bounded and found.beyond_alpha > 0.03
    assert region_half(found) == region_half(opaque)
    np.testing.assert_array_equal(found.far, opaque.far)


def test_alpha_is_no_background_within_the_region_asked_for() -> None:
    scene = opaque_where(seen_by(ring(), ball()), ball(4000))
    part, whole = (normalise(scene, (0.0, 0.0, height, half)) for height, half in ((0.8, 0.35), (0.0, 1.1)))
    assert whole.bounded and whole.beyond_alpha == 0
    assert not part.bounded and part.beyond_alpha > 0.5
    unbounded = normalise(dataclasses.replace(scene, opaque=None), (0.0, 0.0, 0.8, 0.35))
    np.testing.assert_array_equal(part.far, unbounded.far)


def test_partial_or_mistaken_photos_carve_nothing_away() -> None:
    thing = ball(4000)
    scene = opaque_where(seen_by(np.concatenate([ring(40), ring(2, radius=1.6)]), thing), thing)  # two see a part
    assert scene.opaque is not None
    scene.opaque[3] = [[0.2, 0.2], [0.3, 0.3]]
    found = normalise(scene, None)
    assert np.abs(found.scene_from_sfm.points(thing)).max() <= 0.95
    assert region_half(found) == pytest.approx(1.0, rel=0.15)


def test_photos_of_which_nothing_is_left_still_have_a_region() -> None:
    scene = seen_by(ring(), ball())
    nothing = dataclasses.replace(scene, opaque=np.tile([[0.45, 0.45], [0.46, 0.46]], (16, 1, 1)))
    assert region_half(normalise(nothing, None)) > 0


@pytest.mark.parametrize("has_alpha", [False, True])
@pytest.mark.parametrize("away", [1.0, 30.0, 1e3, 1e6])
def test_any_camera_has_near_before_far(away: float, has_alpha: bool) -> None:
    poses = ring()
    poses[0, :, 3] *= away
    cameras = dataclasses.replace(
        seen_by(poses, ball()), points=np.zeros((0, 3)), view=np.zeros(0, int), point=np.zeros(0, int)
    )
    for scene in (cameras, seen_by(poses, ball())):
        found = normalise(opaque_everywhere(scene) if has_alpha else scene, None)
        distance = np.linalg.norm(found.scene_from_sfm.points(scene.centres), axis=1)
        assert (found.near > 0).all() and (found.near < found.far).all()
        assert (found.near < distance).all() and (found.far > distance).all()


def test_a_telephoto_lens_far_away_sees_the_region() -> None:
    """The region is as wide as the picture: 40 of its half sides away."""
    scene = seen_by(ring(radius=4.0), np.zeros((0, 3)))
    narrow = scene.ray_directions * [0.05, 0.05, 1.0]
    narrow /= np.linalg.norm(narrow, axis=2, keepdims=True)
    found = normalise(dataclasses.replace(scene, ray_directions=narrow), None)
    distance = np.linalg.norm(found.scene_from_sfm.points(scene.centres), axis=1)
    assert (distance > 20).all()
    assert (found.near < distance - 0.9).all() and (found.far > distance + 0.9).all()


def test_a_view_of_the_distance_has_near_before_far() -> None:
    scene = with_points(seen_by(ring(), ball()), np.array([[0.0, 1e5, 0.0]]) + ball(50), 3)
    only_far = scene.point >= 400
    keep = (scene.view != 0) | only_far
    found = normalise(dataclasses.replace(scene, view=scene.view[keep], point=scene.point[keep]), None)
    assert (found.near < 0.999 * found.far).all()


@pytest.mark.parametrize("offset", [0.0, 1e6, -1e12])
def test_cameras_in_one_place_are_refused_wherever_it_is(offset: float) -> None:
    scene = seen_by(room(), np.zeros((0, 3)))
    poses = scene.from_camera.copy()
    poses[:, :, 3] = offset + np.array([0.1, 0.2, 0.3]) * (1 + 1e-16 * np.arange(len(poses)))[:, None]
    with pytest.raises(ValueError, match=r"same position|float64 cannot tell"):
        normalise(dataclasses.replace(scene, from_camera=poses), None)


def test_only_alpha_proves_that_nothing_lies_beyond() -> None:
    around = SCENES["object-centric"]()
    assert normalise(opaque_everywhere(around), None).bounded
    assert not normalise(around, None).bounded, "sky and plain walls have no points"


def test_unbounded_scenes_reach_far_behind_the_farthest_point() -> None:
    found = normalise(with_points(SCENES["object-centric"](), 30 * ball(60), views=4), None)
    assert (found.far >= 20).all()
    assert (found.far <= 1000).all()


def test_a_full_turn_and_an_arc_are_measured() -> None:
    assert normalise(seen_by(ring(count=36), ball()), None).arc_deg == pytest.approx(350, abs=1)
    assert normalise(seen_by(ring(arc_deg=100.0), ball()), None).arc_deg == pytest.approx(100, abs=3)


def test_without_points_the_cameras_frusta_give_the_region() -> None:
    scene = seen_by(ring(radius=4.0, height=0.0), np.zeros((0, 3)))
    found = normalise(opaque_everywhere(scene), None)
    assert region_half(found) == pytest.approx(4.0 * 0.5, rel=1e-3)  # distance x tan(half field of view)
    np.testing.assert_allclose(found.scene_from_sfm.points(np.zeros(3)), 0, atol=1e-6)
    assert found.bounded
    assert 0 < found.near.min() < 4.0 * found.scene_from_sfm.scale < found.far.max() < 10
    assert not normalise(scene, None).bounded


@pytest.mark.parametrize("poses", [wall(), room()], ids=["forward-facing", "inside-out"])
def test_without_points_other_layouts_get_a_region_too(poses: np.ndarray) -> None:
    found = normalise(seen_by(poses, np.zeros((0, 3))), None)
    spread = np.linalg.norm(poses[:, :, 3] - np.median(poses[:, :, 3], axis=0), axis=1).max()
    assert spread < region_half(found) < 30 * spread
    assert (found.near > 0).all()


def test_a_given_region_is_taken_as_it_is() -> None:
    scene = SCENES["object-centric"]()
    found = normalise(scene, (0.2, -0.1, 0.3, 2.5))
    np.testing.assert_allclose(found.scene_from_sfm.points(np.array([0.2, -0.1, 0.3])), 0, atol=1e-12)
    assert region_half(found) == pytest.approx(2.5)


def test_photos_from_one_place_without_points_have_no_scale() -> None:
    poses = ring(radius=1.0)
    poses[:, :, 3] = 0
    with pytest.raises(ValueError, match="all cameras have the same position"):
        normalise(seen_by(poses, np.zeros((0, 3))), None)


def test_lego_fills_the_region_and_stays_inside(shared_data) -> None:
    axes = np.diag([1.0, -1.0, -1.0])
    frames = []
    for part in ("train", "test"):
        content = json.loads((shared_data / f"lego_400/transforms_{part}.json").read_text())
        frames += [np.array(frame["transform_matrix"])[:3] for frame in content["frames"]]
    poses = np.stack([np.concatenate([f[:, :3] @ axes, f[:, 3:]], axis=1) for f in frames])
    scene = seen_by(poses, np.zeros((0, 3)))
    tangent = np.tan(content["camera_angle_x"] / 2)
    ray_directions = scene.ray_directions * [tangent / 0.5, tangent / 0.5, 1]
    scene = dataclasses.replace(
        scene, ray_directions=ray_directions / np.linalg.norm(ray_directions, axis=-1, keepdims=True)
    )
    found = normalise(opaque_everywhere(scene), None)
    assert found.capture_type == "object-centric"
    assert found.bounded
    assert angles_deg(found.up.direction, np.array([0.0, 0.0, 1.0])) < 1e-3
    corners = np.array([[-0.65, -1.15, -0.5], [0.65, 1.15, 1.05]])  # of the lego itself, in Blender's units
    reach = np.abs(found.scene_from_sfm.points(corners))
    assert 0.5 < reach.max() < 0.9
