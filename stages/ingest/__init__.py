"""Stage ingest: every photo decoded once, upright, 8-bit sRGB, under an ASCII name; unusable files are named."""

from pathlib import Path

from pydantic import Field

from stages.contract import (
    Auto,
    Inputs,
    OptionalSourcePath,
    Progress,
    SourcePath,
    Stage,
    StageConfig,
    StageResult,
    Workload,
    reading_seconds,
)
from stages.ingest.sources import find_source
from stages.io.files import write_json
from stages.io.photos import write_photos

NOTES = "notes.json"
MIN_FRAMES = 3  # of a video, as sfm needs
# Of the time that its photo takes, a mask's: decoded, fitted and packed in 0.016 s a million pixels of a core (41 masks
# of 12 megapixels), where a photo takes 0.022.
MASK_SHARE = 0.4


class Config(StageConfig):
    """Which photos are read."""

    photos: SourcePath = Field(
        default=Path(),
        description="A folder of photos, a video, a transforms.json, or a folder with transforms_train.json.",
    )
    cameras: OptionalSourcePath = Field(
        default=None,
        description="Poses to import for a folder of photos: a transforms file, a COLMAP model or a poses_bounds.npy.",
    )
    photo_list: Auto[Path] = Field(
        default=None,
        description="Use only the photos that this text file names: one name per line, relative to PHOTOS (default: "
        "all photos).",
    )
    frames: int = Field(
        default=300,
        ge=MIN_FRAMES,
        description="Maximum number of frames taken from a video; a camera that moves far gets them further apart.",
    )


def expected_seconds(config: Config, workload: Workload) -> float:
    """Every photo and every mask is decoded once, by at most eight workers."""
    photos, workers = workload.photos, min(workload.cores, 8)
    masks = MASK_SHARE * reading_seconds(photos.masked * photos.megapixels, workers)
    return 0.5 + photos.reading_seconds(workers) + masks


def run(config: Config, inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """Decode the photos of ``config`` into ``folder``. Raises StageError if fewer than two can be used."""
    from stages.ingest import conversion

    source = find_source(config.photos, config.cameras, config.photo_list)
    conversion.messages.note_unused(source, config.photos, progress)
    with conversion.writing(folder):
        converted = conversion.convert(source, config.frames, folder, progress)
        conversion.messages.note_rejected(converted.rejected, progress)
        conversion.messages.note_first(converted.notes, NOTES, progress)
        photos = conversion.store(converted, folder)
        write_photos(folder, photos, converted.rejected, source.frames)
        if converted.notes:
            write_json(folder / NOTES, [note.text for note in converted.notes])
    conversion.note_findings(photos, converted, progress)
    has_masks, has_alpha = (any(parts) for parts in zip(*((p.mask, p.has_alpha) for p in photos), strict=True))
    return StageResult(
        outputs=("images", "photos.json", *["masks"] * has_masks, *["opaque"] * has_alpha),
        records=(NOTES,) if converted.notes else (),
        line=conversion.messages.summary(source, photos, converted.rejected),
        facts=conversion.messages.facts(source, photos, converted.rejected),
    )


STAGE = Stage(
    name="ingest",
    inputs=(),
    version=24,
    exit_code=10,
    published=("photos.json", NOTES, "images", "masks", "opaque"),
    config=Config,
    # What it decides here, which files are photos and which frames they are, is in the digest that stands for
    # ``photos``.
    not_hashed=("cameras",),
    run=run,
    expected_seconds=expected_seconds,
)
