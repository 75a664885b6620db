"""Pieces of a broken sequence, joined where they share photos. Call it in a worker process.

Where a sequence hangs by one step from photo to photo, incremental mapping ends in several models, and within a model
a step that its own matches do not support ends a piece (``supported_runs`` in model_check.py). What two pieces share is
known however much a place repeats itself: a photo was taken in one position. So they are joined by photos that both
have, never by matches between them, which repeated structure makes as well.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float

from nerf.geometry.alignment import fit_poses
from nerf.geometry.scene import Similarity
from stages.sfm.colmap.adjustment.bundle_adjustment import release_focal_lengths
from stages.sfm.colmap.repair import restricted
from stages.sfm.pose_check import tolerance_px

MIN_SHARED = 3  # photos: the first two tell the scale between two pieces, the third whether it is right
SCALE_ERROR = 0.05  # has to show in the photos that both pieces have: what they see may be too far away for that


class Piece(NamedTuple):
    """A model, and those of its images (ids) that hang together."""

    model: pycolmap.Reconstruction
    image_ids: Sequence[int]


def join_pieces(pieces: Iterable[Piece], camera_is_known: bool) -> pycolmap.Reconstruction | None:
    """The longest piece with all others that can be joined to it, adjusted together; None where none can.

    A piece is joined if it shares at least MIN_SHARED photos, every one of them has the same pose in both after a
    similarity, and another scale would show. Where photos are that both have, the longer piece says.
    """
    by_length = sorted(pieces, key=lambda piece: len(piece.image_ids), reverse=True)
    waiting = [restricted(*piece) for piece in by_length if len(piece.image_ids) > MIN_SHARED]
    if not waiting:
        return None
    first, *waiting = waiting
    joined = first
    while wider := next((wider for piece in waiting if (wider := join(joined, piece)) is not None), None):
        joined = wider
    if joined is first:
        return None
    release_focal_lengths(joined, joined.cameras if camera_is_known else ())
    return joined


def join(base: pycolmap.Reconstruction, piece: pycolmap.Reconstruction) -> pycolmap.Reconstruction | None:
    """Both in the frame of ``base``, not yet adjusted; None where they share too few photos or disagree about any of
    them, or where ``piece`` has nothing to add."""
    shared = sorted({*base.reg_image_ids()} & {*piece.reg_image_ids()})
    if len(shared) < MIN_SHARED or len(shared) == piece.num_reg_images():
        return None
    here, there = (np.array([m.image(i).cam_from_world().inverse().matrix() for i in shared]) for m in (base, piece))
    base_from_piece = fit_poses(here, there)
    if base_from_piece is None:
        return None
    moved = pycolmap.Reconstruction(piece)
    moved.transform(_native(base_from_piece))
    middle = here[:, :, 3].mean(axis=0)
    larger = pycolmap.Reconstruction(moved)
    larger.transform(_native(Similarity(1 + SCALE_ERROR, np.eye(3), -SCALE_ERROR * middle)))
    if not _agree(base, moved, shared) or _agree(base, larger, shared):
        return None
    joined = pycolmap.Reconstruction(base)
    _add(joined, moved)
    return joined


def _native(new_from_old: Similarity) -> pycolmap.Sim3d:
    return pycolmap.Sim3d(new_from_old.matrix()[:3])


def _agree(one: pycolmap.Reconstruction, other: pycolmap.Reconstruction, shared: Sequence[int]) -> bool:
    """Whether each ``shared`` photo sees the points of either model, from its pose in the other one, as near to its
    keypoints as a pair has to be that supports a pose (stages/sfm/pose_check.py). It shows a wrong rotation, position
    and scale, in pixels."""
    own = [_medians_px(model, model, shared) for model in (one, other)]
    crossed = [_medians_px(one, other, shared), _medians_px(other, one, shared)]
    return bool(np.max(crossed) <= tolerance_px(float(np.median(own))))


def _medians_px(
    points: pycolmap.Reconstruction, poses: pycolmap.Reconstruction, shared: Sequence[int]
) -> Float[np.ndarray, "photos"]:
    """Of each photo the median distance of its keypoints from the points that it has in one model, seen from its pose
    in another one; infinite where it has none."""
    found = []
    for image_id in shared:
        seen, image = points.image(image_id).get_observation_points2D(), poses.image(image_id)
        pose, camera = image.cam_from_world().matrix(), poses.camera(image.camera_id)
        xyz = np.array([points.point3D(place.point3D_id).xyz for place in seen]).reshape(-1, 3)
        there = np.asarray(camera.img_from_cam(xyz @ pose[:, :3].T + pose[:, 3]), float).reshape(-1, 2)
        off = np.linalg.norm(there - np.array([place.xy for place in seen]).reshape(-1, 2), axis=1)
        found.append(np.median(np.where(np.isfinite(off), off, np.inf)) if len(off) else np.inf)
    return np.array(found)


def _add(model: pycolmap.Reconstruction, moved: pycolmap.Reconstruction) -> None:
    """Add images of ``moved`` that the model does not have, and the points that they see: to those of the model where a
    photo that both have sees them at the same keypoint."""
    new = sorted({*moved.reg_image_ids()}.difference(model.reg_image_ids()))
    for image_id in new:
        _register(model, moved.image(image_id), moved.camera(moved.image(image_id).camera_id))
    numbers = {point for image_id in new for point in _point_ids(moved, image_id)}
    for number in sorted(numbers):
        point, free, known = moved.point3D(number), pycolmap.Track(), []
        for element in point.track.elements:
            place = model.image(element.image_id).points2D[element.point2D_idx]
            if place.has_point3D():
                known.append(place.point3D_id)
            else:
                free.add_element(element.image_id, element.point2D_idx)
        if known:
            target = max(sorted(set(known)), key=known.count)
            have = {element.image_id for element in model.point3D(target).track.elements}
            for element in free.elements:
                if element.image_id not in have:
                    model.add_observation(target, element)
        elif free.length() > 1:
            model.add_point3D(point.xyz, free, point.color)
    model.update_point_3d_errors()


def _point_ids(model: pycolmap.Reconstruction, image_id: int) -> list[int]:
    return [place.point3D_id for place in model.image(image_id).get_observation_points2D()]


def _register(model: pycolmap.Reconstruction, image: pycolmap.Image, camera: pycolmap.Camera) -> None:
    """Register an image where it stands in another model of the same frame, with that model's camera if it is new."""
    pose = image.cam_from_world()
    if model.exists_image(image.image_id):
        frame = model.frame(model.image(image.image_id).frame_id)
        frame.rig_from_world = pose
        model.register_frame(frame.frame_id)
        return
    if not model.exists_camera(camera.camera_id):
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera.todict()))
    places = pycolmap.Point2DList([pycolmap.Point2D(place.xy) for place in image.points2D])
    entry = pycolmap.Image(name=image.name, camera_id=camera.camera_id, image_id=image.image_id, points2D=places)
    model.add_image_with_trivial_frame(entry, pose)
