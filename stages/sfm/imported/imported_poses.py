"""What a reader of camera files returns, and what it says of photos without a camera and cameras without a photo."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.contract import Note, StageError
from stages.io.amounts import counted
from stages.io.photos import Photo
from stages.io.sparse_model import SparseModel
from stages.sfm.imported.posed_photos import PosedPhoto
from stages.sfm.registration import told

MAX_NAMES, MAX_NAMES_OF_ERROR = 5, 2


@dataclass(frozen=True)
class ImportedPoses:
    """``left_out``: why photos are that have a camera; ``test_files``: an official split; both by files relative to
    ingest's ``images/``. ``notes`` are for the user."""

    model: SparseModel
    left_out: dict[str, Note]
    test_files: list[str] | None
    notes: list[Note]

    def account(self, photos: Sequence[Photo]) -> list[dict[str, Any]]:
        """What became of each photo, for registration.json."""
        seen = np.bincount(self.model.view, minlength=len(self.model.images)).tolist()
        observations = {image.file: count for image, count in zip(self.model.images, seen, strict=True)}
        without = Note("sfm.unregistered-no-imported-pose", "it has no imported pose")
        reasons = self.left_out | dict.fromkeys(observations)
        return [
            {
                "file": file,
                "registered": file in observations,
                **told(reasons.get(file, without)),
                "keypoints": observations.get(file, 0),
                "observations": observations.get(file, 0),
            }
            for file in (photo.image_name for photo in photos)
        ]


def nothing_matches(source: str, names: Sequence[str], photos: Sequence[Photo]) -> StageError:
    """No image of a model, or frame of a file, has the name of a photo."""
    here = few([photo.name for photo in photos], MAX_NAMES_OF_ERROR)
    its = f"it has cameras of {few(names, MAX_NAMES_OF_ERROR)}" if names else "it has no cameras"
    return StageError(
        "sfm.no-camera-matches",
        f"no camera in {source} belongs to a photo",
        f"{its}; the photos are {here}",
        "Give the folder of the photos that these cameras belong to, with their original names.",
    )


def notes_on_photos(
    absent: Collection[str], unposed: Collection[str], posed: Collection[PosedPhoto], left_out: Collection[str]
) -> list[Note]:
    """Notes on cameras without a photo (``absent``), photos without a camera (``unposed``) or without rays, and cameras
    that were turned upright."""
    notes = []
    bent = [one.photo.name for one in posed if one.file in left_out]
    no_rays = "left out, because of a camera without rays for some pixels"
    for names, code, one, many in (
        (absent, "sfm.no-photo", "camera has no photo", "cameras have no photo"),
        (unposed, "sfm.no-camera", "photo without a camera is left out", "photos without a camera are left out"),
        (bent, "sfm.no-rays", f"photo is {no_rays}", f"photos are {no_rays}"),
    ):
        if names:
            notes.append(Note(code, f"{counted(len(names), one, many)}: {few(sorted(names))}"))
    if turned := sum(one.turns > 0 and one.file not in left_out for one in posed):
        words = f"{counted(turned, 'camera is', 'cameras are')} turned upright like the photos (EXIF orientation)"
        notes.append(Note("sfm.turned-upright", words))
    return notes


def few(names: Sequence[str], most: int = MAX_NAMES) -> str:
    """The first names of a list, for a message."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")
