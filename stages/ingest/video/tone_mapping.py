"""HDR and wide-gamut video as sRGB: the filters by which ffmpeg maps its tones and its gamut. HDR photos likewise."""

import re
import subprocess
from functools import cache
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from nerf.rendering.srgb_arrays import srgb_values
from stages.contract import Progress
from stages.io.ascii_names import shell_quoted

# Of HDR video, by ffmpeg's name of its transfer characteristic; both have the primaries of BT.2020 (ITU-R BT.2100).
# Diffuse white is at 203 cd/m² (ITU-R BT.2408): that becomes about the white of sRGB. What is lighter, up to MAX_NITS,
# is pressed into the lightest fifth.
HDR_TRANSFERS = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
# Of other video, by ffmpeg's name of its primaries.
WIDE_PRIMARIES = {"bt2020": "BT.2020", "smpte432": "Display P3", "smpte431": "DCI P3"}
WHITE_NITS, MAX_NITS, LINEAR_UP_TO = 203, 1000, 0.8
TONE_MAPPED = f"tone-mapped to sRGB, white at {WHITE_NITS} cd/m²"
# The same by their numbers in ITU-T H.273, which photos have.
PHOTO_TRANSFERS, BT2020 = {16: "PQ", 18: "HLG"}, 9
BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # ITU-R BT.2087
BT2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)
_ROWS = 256  # of a photo at a time: light takes twelve bytes a pixel


def srgb_filters(video: Path, progress: Progress) -> str | None:
    """The filters by which ffmpeg makes sRGB of HDR and wide-gamut video; None of other video, and where this ffmpeg
    lacks them. Says what is done."""
    stream = _video_stream(video)
    transfer = next((name for name in HDR_TRANSFERS if re.search(rf"[/ (]{name}\b", stream)), None)
    wide = next((name for name in WIDE_PRIMARIES if re.search(rf"/{name}/|[ (]{name}[,)]", stream)), None)
    if transfer:
        code, what = "ingest.tone-mapped", f"{video.name} is HDR video ({HDR_TRANSFERS[transfer]})"
        filters, done = tone_mapping(transfer), TONE_MAPPED
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


def tone_mapped(pixels: np.ndarray, transfer: str, primaries: int) -> np.ndarray:
    """(h, w, 3) uint8 of an HDR photo as sRGB, its tones mapped as :func:`tone_mapping` maps those of video. That
    photos have 10 bits and are decoded into 8 costs 0.9 of 255 on average (PQ), up to 24 in dark, saturated colours."""
    signal = np.arange(256, dtype=np.float32) / 255
    light_of = _pq_light(signal) if transfer == "PQ" else _hlg_light(signal)
    srgb = np.empty_like(pixels)
    for top in range(0, len(pixels), _ROWS):
        light = light_of[pixels[top : top + _ROWS]]
        if transfer == "HLG":  # the scene's, which a display shows with more contrast (BT.2100: OOTF)
            light *= (MAX_NITS / WHITE_NITS) * (light @ BT2020_LUMINANCE)[..., None] ** 0.2
        if primaries == BT2020:
            light = np.maximum(light @ BT709_FROM_BT2020.T, 0)
        srgb[top : top + _ROWS] = np.rint(255 * srgb_values(_rolled_off(light)))
    return srgb


def _pq_light(signal: np.ndarray) -> np.ndarray:
    """Light, 1 being white, of a PQ signal (SMPTE ST 2084)."""
    power = signal ** (32 / 2523)
    return 10_000 / WHITE_NITS * (np.maximum(power - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * power)) ** (8192 / 1305)


def _hlg_light(signal: np.ndarray) -> np.ndarray:
    """The scene's light, up to 1, of an HLG signal (ITU-R BT.2100: inverse OETF)."""
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)


def _rolled_off(light: np.ndarray) -> np.ndarray:
    """ffmpeg's tonemap=mobius: light up to LINEAR_UP_TO stays, MAX_NITS become 1; colours keep their hue."""
    start, peak = LINEAR_UP_TO, MAX_NITS / WHITE_NITS
    a = -(start**2) * (peak - 1) / (start**2 - 2 * start + peak)
    b = (start**2 - 2 * start * peak + peak) / (peak - 1)
    brightest = np.maximum(light.max(axis=-1, keepdims=True), start)
    return np.minimum(light * ((b + start) ** 2 / (b - a) * (brightest + a) / (brightest + b) / brightest), 1)


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
