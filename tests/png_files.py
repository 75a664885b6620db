"""PNG files made by hand: of 16 bits, which Pillow cannot write, or with a header that announces more than there is."""

import struct
import zlib

import numpy as np


def png(width: int, height: int, data: bytes, bits: int = 8, alpha: bool = False) -> bytes:
    """A file of colour, and of alpha if asked; ``data`` are the pixels, deflated."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, bits, 6 if alpha else 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def png_16_bit_rgb(pixels: np.ndarray) -> bytes:
    """A file of ``pixels`` (height, width, 3) uint16."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    return png(width, height, zlib.compress(rows), bits=16)
