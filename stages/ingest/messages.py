"""Messages of ingest: rejected files, findings among the photos, errors, the summary."""

import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from stages.contract import Note, Progress, StageError, listed, shown
from stages.ingest.auxiliary_files import ALL_PHOTOS, instant_ngp_masks, is_mask
from stages.ingest.masks import STILL_BACKGROUND_HINT
from stages.ingest.near_duplicates import Brackets
from stages.ingest.sharpness import BLURRED
from stages.ingest.sources import (
    Source,
    mask_beside,
    photos_beside,
    photos_without_frame,
    reduced_folders,
    unused_cameras,
    unused_masks,
)
from stages.io.amounts import counted
from stages.io.photos import Photo, Rejection

MAX_NOTES = 10
OF_MASK = "ingest.mask-"  # how the codes of rejections for a mask begin
IDENTICAL = "ingest.identical"  # the code of a file with the pixels of another one
MANY_IGNORED = 0.6  # of the pixels: masks that are meant the other way round ignore so many
NEARLY_BLACK = 16  # of 255: the most that 12 bits make in a file of 16
HINT = "Take 20 to 100 overlapping photos of one scene from different places and put them into one folder."


def identical(name: str) -> Note:
    """Why a file is rejected that has the pixels of photo ``name``."""
    return Note(IDENTICAL, f"identical to {shown(name)}")


def note_first(notes: Sequence[Note], where: str, progress: Progress) -> None:
    """Note the first few, how many more there are, and the file that has all of them."""
    for note in notes[:MAX_NOTES]:
        progress.note(*note)
    if len(notes) > MAX_NOTES:
        progress.note("ingest.more-notes", f"… and {len(notes) - MAX_NOTES} more, all in {where}")


def note_rejected(rejected: Sequence[Rejection], progress: Progress) -> None:
    """Note which files are no photos, and why."""
    note_first(
        [Note("ingest.rejected", f"rejected {shown(one.name)}: {one.reason}") for one in rejected],
        "photos.json",
        progress,
    )


def note_everything(rejected: Sequence[Rejection], notes: Sequence[Note], progress: Progress) -> None:
    """Every rejected file, by reason, and every note, where no file will be left to look them up in."""
    by_reason: dict[str, list[str]] = {}
    for rejection in rejected:
        by_reason.setdefault(rejection.reason, []).append(shown(rejection.name))
    for reason, names in by_reason.items():
        progress.note("ingest.rejected-photos", f"rejected {', '.join(names)}: {reason}")
    for note in notes:
        progress.note(*note)


def note_unused(source: Source, photos: Path, progress: Progress) -> None:
    """Note what lies beside the photos, which were found in ``photos``, and could be used, and how."""
    if beside := photos_beside(source, photos):
        folder = shown(str(photos))
        lie, them = counted(beside), "is" if beside == 1 else "are"
        how = f"to use all, move them into images/; to use only them, move images/ out of {folder}"
        progress.note("ingest.photos-beside-images", f"{lie} in {folder} beside images/ {them} not used: {how}")
    if source.root != photos.absolute() and (copies := reduced_folders(photos, but=source.root)):
        which = listed([f"{folder.name}/" for folder in copies], 3)
        what = f"the photos of {source.root.name}/ are used, and not their smaller copies in {which}"
        progress.note("ingest.smaller-copies", f"{what}; to use those, give the folder itself")
    if unnamed := photos_without_frame(source):
        lie, which = _photos_are(len(unnamed)), _first_names(unnamed)
        file = source.cameras.name if source.cameras else ""
        progress.note("ingest.photos-without-frame", f"{lie} left out, because {file} does not name them: {which}")
    if others := source.other_endings:
        which = listed([f"{shown(photo)} ({shown(path)})" for path, photo in others.items()], 3)
        progress.note(
            "ingest.other-endings",
            f"{counted(len(others), 'frame uses a photo', 'frames use photos')} of the same name with another file "
            f"ending: {which}",
        )
    if (cameras := unused_cameras(source)) is not None:
        place, option = shown(str(cameras)), shown(f"--cameras {shlex.quote(str(cameras))}")
        progress.note("ingest.unused-cameras", f"the cameras in {place} are not used; to use them: {option}")
    if (mask := mask_beside(source, photos)) is not None:
        progress.note(*_one_mask(str(mask)))
    if (masks := unused_masks(source)) is not None:
        lie, wanted = shown(str(masks)), shown(str(source.root / "masks"))
        progress.note(
            "ingest.unused-masks",
            f"the masks in {lie} are not used; to use them, move them to {wanted} (black is ignored)",
        )


def excluded(files: Mapping[str, str]) -> list[Note]:
    """Notes on files that are not taken for photos, {file: the photo that it belongs to}."""
    used = instant_ngp_masks(files).values()
    notes = list[Note]()
    if used:
        which = listed([shown(name) for name in sorted(used)], 1)
        words = f"{counted(len(used), 'instant-ngp mask is', 'instant-ngp masks are')} used ({which}): white is ignored"
        notes.append(Note("ingest.instant-ngp-masks", words))
    files = {name: photo for name, photo in files.items() if name not in used}
    if not files:
        return notes
    named = [f"{shown(name)} (of {shown(photo)})" for name, photo in sorted(files.items())]
    count = _files_are(files)
    words = f"{count} excluded, with the name of a mask, depth map or other copy of a photo: {listed(named, 3)}"
    notes.append(Note("ingest.excluded", words))
    if mask := next((name for name, photo in sorted(files.items()) if photo == ALL_PHOTOS), None):
        notes.append(_one_mask(mask))
    elif mask := next((name for name in sorted(files) if is_mask(name)), None):
        place = f"masks/{os.path.splitext(files[mask])[0]}.png"
        notes.append(
            Note(
                "ingest.mask-elsewhere",
                f"to use {shown(mask)} as a mask, whose black is ignored, rename it {shown(place)}",
            )
        )
    return notes


def _one_mask(name: str) -> Note:
    words = f"{shown(name)} is not used; to use it as the mask of all photos, copy it to masks/NAME.png for each"
    return Note("ingest.one-mask", words)


def excluded_by_values(files: Sequence[str]) -> list[Note]:
    """A note on files among colour photos whose values are those of depth maps."""
    if not files:
        return []
    count, named = _files_are(files), _first_names(files)
    words = f"{count} excluded, with grey values of 16 bits or floats as in depth maps: {named}"
    return [Note("ingest.depth-maps", words)]


def excluded_masks(files: Sequence[str]) -> list[Note]:
    """A note on files among photos that are black and white alone."""
    if not files:
        return []
    count, named = _files_are(files), _first_names(files)
    words = f"{count} excluded, in pure black and white as masks are: {named}. To use a mask, name it"
    return [Note("ingest.black-and-white", f"{words} masks/NAME.png after its photo; black is ignored")]


def _files_are(files: Collection[str]) -> str:
    return counted(len(files), "file is", "files are")


def _first_names(files: Sequence[str]) -> str:
    return listed([shown(name) for name in files], 3)


def bracketed(brackets: Brackets) -> str:
    """The note on places that were photographed with several exposures each."""
    last = brackets.exposures - 1
    names = {0: "darkest", last: "brightest", last / 2: "middle one"}
    which = names.get(brackets.position, f"number {brackets.position + 1} from the darkest")
    each = f"exposure brackets: {brackets.places} poses have {brackets.exposures} exposures each"
    return f"{each}; the {which} of each is kept, which is clipped or too dark in the fewest pixels"


def nearly_black(brightest: Sequence[int]) -> list[Note]:
    """A note where no photo is brighter than its values make it that have 12 bits or fewer in files of 16;
    ``brightest`` has the largest of each photo, of 255."""
    if (most := max(brightest, default=255)) > NEARLY_BLACK:
        return []
    how = "if these are 16-bit files with 12-bit values, multiply the values by 16 (10-bit values by 64)"
    return [Note("ingest.nearly-black", f"all photos are nearly black (at most {most} of 255): {how}")]


def note_findings(photos: Sequence[Photo], progress: Progress) -> None:
    """Which photos are nearly the same picture, and which are blurred."""
    same = [f"{shown(p.name)} (as {shown(p.near_duplicate_of)})" for p in photos if p.near_duplicate_of]
    if same:
        are = _photos_are(len(same))
        progress.note("ingest.near-duplicates", f"{are} left out of matching as near-duplicates: {_few(same)}")
    blurred = [
        f"{shown(p.name)} ({p.relative_sharpness:.2f} ×)"
        for p in photos
        if p.relative_sharpness is not None and p.relative_sharpness < BLURRED and not p.near_duplicate_of
    ]
    if blurred:
        are = _photos_are(len(blurred))
        progress.note("ingest.blurred", f"{are} far less sharp than the neighbouring photos, but kept: {_few(blurred)}")


def note_masks(ignored: Sequence[float], turned: int, resized: int, photos: int, progress: Progress) -> None:
    """How many of the photos have masks, how much these ignore, and how many were made to fit."""
    if not any(ignored):
        return
    turned_words = f", {turned} are turned upright like their photos" if turned else ""
    resized_words = f", {resized} are resized to their photos" if resized else ""
    share = sum(ignored) / len(ignored)
    polarity = "; black is ignored: invert your masks if white marks what to ignore" if share > MANY_IGNORED else ""
    progress.note(
        "ingest.masks",
        f"{len(ignored)} of {counted(photos)} have masks, which ignore {share:.0%} of their pixels"
        f"{turned_words}{resized_words}{polarity}",
    )


def stray_masks(files: Sequence[str]) -> list[Note]:
    """A note on files in folders of masks that are no photo's."""
    if not files:
        return []
    named = listed([shown(name) for name in files], 3)
    are = "is" if len(files) == 1 else "are"
    words = f"{named} {are} not the mask of any photo: a mask has the name of its photo, masks/NAME.png"
    return [Note("ingest.stray-masks", words)]


def grey_masks(names: Sequence[str]) -> list[Note]:
    """A note on photos whose masks are in shades of grey."""
    if not names:
        return []
    words = f"masks of {counted(len(names))} are mostly grey"
    words = f"{words}: pixels brighter than half are used. Check the masks of {listed([shown(n) for n in names], 3)}"
    return [Note("ingest.grey-masks", words)]


def taken_as_upright(names: Sequence[str]) -> list[Note]:
    """A note on photos that EXIF turned and whose masks fit them turned or not."""
    if not names:
        return []
    which = f"the masks of {counted(len(names))} fit both upright and before EXIF rotation"
    words = f"{which}; they are taken as upright. Check the masks of {_few([shown(name) for name in names])}"
    return [Note("ingest.ambiguous-masks", words)]


def _photos_are(count: int) -> str:
    return counted(count, "photo is", "photos are")


def _few(names: Sequence[str]) -> str:
    return listed(names, MAX_NOTES) + (", all in photos.json" if len(names) > MAX_NOTES else "")


def too_few(source: Source, names: Sequence[str], rejected: Sequence[Rejection]) -> StageError:
    """The error for one photo or none, ``names``, and what the rejections show."""
    if not names:
        first = f"{shown(rejected[0].name)}: {rejected[0].reason}"
        return StageError(
            "ingest.no-usable-photo",
            f"no usable photo among {counted(len(rejected), 'file')} in {source.root}",
            first,
            _what_to_do(rejected),
        )
    only = shown(names[0])
    if rejected and all(rejection.code == IDENTICAL for rejection in rejected):
        return StageError(
            "ingest.identical-photos",
            f"all {len(rejected) + 1} photos are identical",
            f"they have the pixels of {only}",
            HINT,
        )
    if rejected:
        return StageError(
            "ingest.one-usable-photo",
            f"{only} is the only usable photo",
            f"{counted(len(rejected), 'other file was', 'other files were')} rejected",
            HINT,
        )
    return StageError(
        "ingest.one-photo",
        "there is only one photo",
        f"{only} is the only photo, and a scene needs at least three",
        HINT,
    )


def _what_to_do(rejected: Sequence[Rejection]) -> str:
    """What helps where all files are rejected: what helps all of them, else better photos."""
    codes = {one.code for one in rejected}
    if all(code.startswith(OF_MASK) for code in codes):
        return "Correct the masks (black is ignored, white is used), or remove them."
    if codes <= {"ingest.stand-in", "ingest.empty-file", "ingest.damaged-file"}:
        return "Copy or download the photos again."
    if codes <= {"ingest.not-an-image", "ingest.raw-file", "ingest.pixel-format", "ingest.pixel-range"}:
        return "Export them as JPEG, PNG or TIFF, with 8 or 16 bits per value."
    return HINT


def all_the_same(photos: int) -> StageError:
    """The error for photos that all show nearly the same picture."""
    why = "the camera did not move between them, so they show no depth"
    return StageError(
        "ingest.same-picture",
        f"all {photos} photos are near-duplicates",
        why,
        f"{HINT} {STILL_BACKGROUND_HINT}",
    )


def all_plain(colours: Sequence[tuple[str, str]]) -> StageError:
    """The error for photos that show nothing: (name, the one colour of all its pixels)."""
    name, colour = colours[0]
    why = f"{shown(name)} is {colour} everywhere"
    hint = "Look at the photos: the lens cap was on, the exposure was wrong, or an export failed."
    return StageError("ingest.plain-photos", f"each of the {len(colours)} photos has one single colour", why, hint)


def summary(source: Source, photos: Sequence[Photo], rejected: Sequence[Rejection]) -> str:
    """Ingest's line."""
    sizes = sorted({(photo.width, photo.height) for photo in photos})
    size = "{}×{}".format(*sizes[0]) if len(sizes) == 1 else f"in {len(sizes)} sizes"
    alpha = " with alpha" if any(photo.has_alpha for photo in photos) else ""
    what = "frames" if source.kind == "video" else "photos"
    line = f"{len(photos)} {what} {size}{alpha}, {_cameras(source, photos)}"
    if photos[-1].time_s is not None:
        line += f", {photos[-1].time_s:.1f} s of video"
    if source.photo_list is not None:
        all_photos = len(source.files) + source.unlisted
        line += f", {len(source.files)} of {all_photos} photos listed in {shown(source.photo_list.name)}"
    return f"{line}, {len(rejected)} rejected" if rejected else line


def _cameras(source: Source, photos: Sequence[Photo]) -> str:
    if source.cameras is not None:
        return "poses imported"
    groups = len({photo.camera_group for photo in photos})
    cameras = "one camera" if groups == 1 else f"{groups} cameras"
    known = [photo.focal_px for photo in photos if photo.focal_px is not None]
    if not known:
        return f"{cameras}, no EXIF focal length"
    if len(known) < len(photos):
        return f"{cameras}, EXIF focal length for {len(known)}"
    return f"{cameras}, EXIF focal length" + (f" {known[0]:.0f} px" if len(set(known)) == 1 else "")


def facts(source: Source, photos: Sequence[Photo], rejected: Sequence[Rejection]) -> dict[str, object]:
    """The summary as JSON values."""
    return {
        "source": source.kind,
        "photos": len(photos),
        "rejected": [asdict(rejection) for rejection in rejected],
        "sizes": sorted([width, height] for width, height in {(photo.width, photo.height) for photo in photos}),
        "cameras": len({photo.camera_group for photo in photos}),
        "focal_known": sum(photo.focal_px is not None for photo in photos),
    }
