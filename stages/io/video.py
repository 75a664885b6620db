"""H.264 files that every browser plays, byte-identical for identical frames."""

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from stages.contract import StageError

# RGB becomes BT.709, the matrix browsers assume for video, and is labelled so; on the frames, because the encoder takes
# primaries and transfer from there, whatever -color_primaries and -color_trc say.
_COLOUR = (
    "scale=in_range=full:out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+full_chroma_int,"
    "setparams=color_primaries=bt709:color_trc=iec61966-2-1"
)
# One thread, because x264 cuts frames by thread count; bitexact, because containers else carry versions and dates.
_OUTPUT = f"""
    -an -vcodec libx264 -pix_fmt yuv420p -crf 18 -preset medium -threads 1 -x264-params threads=1:lookahead-threads=1
    -vf {_COLOUR}
    -movflags +faststart -fflags +bitexact -flags:v +bitexact -map_metadata -1
""".split()


@contextmanager
def video_writer(path: Path, width: int, height: int, fps: int) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends one frame, (height, width, 3) uint8 sRGB, to the video at ``path``.

    Width and height must be even (yuv420p halves the colour planes). The file is whole once the context ends;
    if the context ends by an exception the encoder is stopped and the file is worthless.
    Raises StageError with the encoder's last words if it fails, on a full disk for instance.
    """
    source = f"-f rawvideo -vcodec rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -".split()
    place = f"file:{path}"  # what stands before a colon would be a protocol
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *source, *_OUTPUT, place]
    with tempfile.TemporaryFile() as words:
        encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=words)
        assert encoder.stdin is not None
        try:
            yield lambda frame: _send(encoder, frame)
            encoder.stdin.close()
            failed = encoder.wait() != 0
        except BrokenPipeError:
            failed = True
        finally:
            encoder.kill()  # nothing happens to an encoder that has ended
            encoder.wait()
        if failed:
            words.seek(0)
            why = words.read().decode("utf-8", "replace").strip().splitlines() or ["the encoder stopped"]
            raise StageError(
                "io.cannot-write-video",
                f"cannot write {path.name}",
                why[-1],
                "Check the free disk space and run again.",
            )


def _send(encoder: subprocess.Popen[bytes], frame: np.ndarray) -> None:
    assert encoder.stdin is not None
    encoder.stdin.write(frame.tobytes())
