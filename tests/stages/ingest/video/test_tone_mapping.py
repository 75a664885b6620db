"""HDR photos as sRGB: their tones up to white are kept, and brighter ones are compressed."""

from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from stages.ingest.decoding import decode
from stages.ingest.video.tone_mapping import BT2020, tone_mapped
from tests.stages.ingest.photo_files import smooth
from tests.stages.ingest.video.test_frames import BT2020_FROM_BT709, hlg, pq

SIGNALS = {"PQ": pq, "HLG": hlg}


def linear(srgb: np.ndarray) -> np.ndarray:
    values = srgb / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def hdr(light: np.ndarray, transfer: str) -> np.ndarray:
    """Light of BT.2020 primaries, 1 being white, as an 8-bit signal."""
    return np.rint(255 * np.clip(SIGNALS[transfer](203 * light), 0, 1)).astype(np.uint8)


@pytest.mark.parametrize("transfer", ["PQ", "HLG"])
def test_light_below_white_is_kept(transfer: str) -> None:
    picture = (smooth(300, 300) * 0.88).astype(np.uint8)  # less than 0.8 of white
    back = tone_mapped(hdr(linear(picture) @ BT2020_FROM_BT709.T, transfer), transfer, BT2020)
    off = np.abs(back.astype(int) - picture)
    assert 0 < off.mean() < 1.2 and np.quantile(off, 0.99) <= 7  # as 8 bits allow
    same = tone_mapped(hdr(linear(picture), transfer), transfer, 1)
    assert np.abs(same.astype(int) - picture).mean() < 3


@pytest.mark.parametrize(("transfer", "most"), [("PQ", 10_000), ("HLG", 1000)])
def test_light_above_white_is_compressed(transfer: str, most: int) -> None:
    light = np.repeat(np.geomspace(0.5, most / 203, 400)[:, None, None], 3, axis=2)
    back = tone_mapped(hdr(light, transfer), transfer, BT2020).astype(int)
    assert (np.diff(back[:, 0, 0]) >= 0).all() and np.ptp(back, axis=2).max() <= 1
    white = back[np.abs(light[:, 0, 0] - 1).argmin(), 0, 0]
    assert 235 <= white <= 248 and back[-1, 0, 0] == 255


@pytest.mark.parametrize(("number", "transfer"), [(16, "PQ"), (18, "HLG"), (13, None)])
def test_hdr_photos_are_named_and_tone_mapped(number: int, transfer: str | None, tmp_path: Path) -> None:
    picture, path = (smooth(96, 64) * 0.88).astype(np.uint8), tmp_path / "a.heic"
    stored = hdr(linear(picture) @ BT2020_FROM_BT709.T, transfer) if transfer else picture
    colours = {"color_primaries": 9, "transfer_characteristics": number, "matrix_coefficients": 9}
    stored = np.dstack([stored, np.tile(np.arange(96, dtype=np.uint8), (64, 1))])
    try:
        file = pillow_heif.from_pillow(Image.fromarray(stored))
        file.save(path, save_nclx_profile=True, quality=100, chroma=444, **colours)
    except RuntimeError as error:
        pytest.skip(f"this pillow-heif cannot write HEIC: {error}")
    decoded = decode(path)
    assert decoded.notes == ((f"HDR ({transfer}): tone-mapped to sRGB, white at 203 cd/m²",) if transfer else ())
    assert np.abs(decoded.pixels[..., :3].astype(int) - picture).mean() < 3
    assert np.abs(decoded.pixels[..., 3].astype(int) - stored[..., 3]).max() < 4
