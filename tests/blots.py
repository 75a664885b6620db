"""A picture to look at from anywhere: blots of all sizes."""

import cv2
import numpy as np


def blots(seed: int, width: int = 600, height: int = 400) -> np.ndarray:
    """A flat picture, (height, width, 3) uint8, with corners at every scale."""
    random = np.random.default_rng(seed)
    picture = np.full((height, width, 3), 128.0)
    for size in (3, 6, 12, 25, 50):
        values = random.normal(size=(height // size, width // size, 3))
        picture += 12 * size**0.5 * cv2.resize(values, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255).astype(np.uint8)


def cut_out(picture: np.ndarray, x: float, y: float, width: int, height: int) -> np.ndarray:
    """What a window of this size shows whose top left corner is at (x, y), between pixels too."""
    move = np.array([[1, 0, x], [0, 1, y]], float)
    return cv2.warpAffine(picture, move, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
