"""Videos read back."""

from pathlib import Path

import imageio_ffmpeg
import numpy as np


def read_video(path: Path) -> tuple[np.ndarray, float]:
    """All frames of a video, (n, height, width, 3) uint8, and its frames per second."""
    frames = imageio_ffmpeg.read_frames(str(path))
    meta = next(frames)
    width, height = meta["size"]
    pixels = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]
    return np.stack(pixels), float(meta["fps"])
