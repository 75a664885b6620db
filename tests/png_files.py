"""PNG files made by hand, whose header may announce more than there is."""

import struct
import zlib


def png(width: int, height: int, data: bytes) -> bytes:
    """A file of 8-bit colour; ``data`` are the pixels, deflated."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
