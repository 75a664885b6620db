"""Imported poses: transforms.json, Blender's transforms_train/test.json, COLMAP models, LLFF's file.

Poses in transforms files are world_from_camera with OpenGL axes (x right, y up, z backward), in COLMAP models
camera_from_world with OpenCV axes, unless the user says otherwise; each reader makes them world_from_camera with OpenCV
axes. Photos are told apart by their own names, as ingest noted them. Cameras of photos as their files store them are
turned upright as ingest turned the photos.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from stages.ingest.sources.camera_files import LLFF
from stages.io.photos import Photo
from stages.io.transforms_files import TRAIN
from stages.sfm.imported.colmap_model import read_colmap_model
from stages.sfm.imported.conventions import AS_DECLARED, OF_COLMAP, OF_LLFF, OF_TRANSFORMS, PoseConvention
from stages.sfm.imported.imported_poses import ImportedPoses
from stages.sfm.imported.llff import read_llff_poses
from stages.sfm.imported.transforms import read_transforms_poses


def read_poses(
    cameras: Path, photos: Sequence[Photo], frames: Mapping[str, str], convention: PoseConvention = AS_DECLARED
) -> ImportedPoses:
    """Read ``cameras`` and match them to ``photos``. ``frames`` maps a transforms file's file_path to a photo's name.

    Raises StageError, naming the frame, for anything that is no camera: numbers that are not finite, a focal length
    that is not positive, a rotation that is sheared or mirrored; and where no frame has a photo.
    """
    convention = convention.with_defaults(convention_of_format(cameras))
    if cameras.suffix.lower() == LLFF:
        return read_llff_poses(cameras, photos, frames, convention)
    if _is_transforms(cameras):
        return read_transforms_poses(cameras, photos, frames, convention)
    return read_colmap_model(cameras, photos, convention)


def convention_of_format(cameras: Path) -> PoseConvention:
    """Of the poses in these files, unless the user says otherwise."""
    if cameras.suffix.lower() == LLFF:
        return OF_LLFF
    return OF_TRANSFORMS if _is_transforms(cameras) else OF_COLMAP


def _is_transforms(cameras: Path) -> bool:
    """Whether cameras stand in a transforms file, or a Blender-style folder of them, and not in a COLMAP model."""
    return cameras.is_file() or (cameras / TRAIN).is_file()
