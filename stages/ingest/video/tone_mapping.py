"""HDR and wide-gamut video as sRGB: the filters by which ffmpeg maps its tones and its gamut."""

import re
import subprocess
from functools import cache
from pathlib import Path

import imageio_ffmpeg

from stages.contract import Progress
from stages.io.ascii_names import shell_quoted

# Of HDR video, by ffmpeg's name of its transfer characteristic; both have the primaries of BT.2020 (ITU-R BT.2100).
# Diffuse white is at 203 cd/m² (ITU-R BT.2408): that becomes about the white of sRGB. What is lighter, up to MAX_NITS,
# is pressed into the lightest fifth.
HDR_TRANSFERS = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
# Of other video, by ffmpeg's name of its primaries.
WIDE_PRIMARIES = {"bt2020": "BT.2020", "smpte432": "Display P3", "smpte431": "DCI P3"}
WHITE_NITS, MAX_NITS, LINEAR_UP_TO = 203, 1000, 0.8


def srgb_filters(video: Path, progress: Progress) -> str | None:
    """The filters by which ffmpeg makes sRGB of HDR and wide-gamut video; None of other video, and where this ffmpeg
    lacks them. Says what is done."""
    stream = _video_stream(video)
    transfer = next((name for name in HDR_TRANSFERS if re.search(rf"[/ (]{name}\b", stream)), None)
    wide = next((name for name in WIDE_PRIMARIES if re.search(rf"/{name}/|[ (]{name}[,)]", stream)), None)
    if transfer:
        code, what = "ingest.tone-mapped", f"{video.name} is HDR video ({HDR_TRANSFERS[transfer]})"
        filters, done = tone_mapping(transfer), f"tone-mapped to sRGB, white at {WHITE_NITS} cd/m²"
    elif wide:
        code, what = "ingest.gamut-mapped", f"{video.name} has the wide gamut of {WIDE_PRIMARIES[wide]}"
        filters, done = gamut_mapping(wide), "converted to sRGB"
    else:
        return None
    if can_tone_map():
        progress.note(code, f"{what}: its frames are {done}")
        return filters
    progress.note(
        "ingest.no-tone-mapping",
        f"{what}, and its frames are not converted: this ffmpeg lacks the filters zscale and tonemap. Convert it with "
        f"an ffmpeg that has them: ffmpeg -i {shell_quoted(video.name)} "
        f'-vf "{filters},format=yuv420p" -c:v libx264 -crf 12 sdr.mp4',
    )
    return None


def tone_mapping(transfer: str) -> str:
    """The filters by which ffmpeg makes sRGB of HDR video with this transfer characteristic."""
    return (
        f"zscale=tin={transfer}:pin=bt2020:min=2020_ncl:t=linear:npl={WHITE_NITS}:agamma=false,format=gbrpf32le,"
        f"zscale=p=bt709,tonemap=mobius:param={LINEAR_UP_TO}:peak={MAX_NITS / WHITE_NITS:.3f}:desat=0,"
        "zscale=t=iec61966-2-1:r=pc,format=gbrp"
    )


def gamut_mapping(primaries: str) -> str:
    """The filters by which ffmpeg makes video of these primaries one of sRGB's. Its tones stay: video is shown by one
    curve whatever its primaries."""
    return (
        f"zscale=pin={primaries}:tin=bt709:t=linear:m=gbr:r=pc,format=gbrpf32le,"
        "zscale=p=bt709,zscale=t=bt709,format=gbrp"
    )


def _video_stream(video: Path) -> str:
    """ffmpeg's line about the pixels of a video, empty where it cannot be read. Its colours stand in brackets: range,
    then matrix/primaries/transfer, or one name where all three have the same."""
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-i", f"file:{video.resolve()}"]
    told = subprocess.run(words, capture_output=True).stderr.decode("utf-8", "replace")
    return next((line for line in told.splitlines() if re.match(r" *Stream #.*: Video: ", line)), "")


@cache
def can_tone_map() -> bool:
    """Whether this ffmpeg was built with the filters."""
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-filters"]
    filters = subprocess.run(words, capture_output=True).stdout.decode("utf-8", "replace")
    return all(re.search(rf" {name} ", filters) for name in ("zscale", "tonemap"))
