"""Corners of a grey picture, and where they are in another one."""

import cv2
import numpy as np

ROUND_TRIP_PX = 0.5  # followed there and back, a corner has to arrive where it began


def corners(grey: np.ndarray, most: int) -> np.ndarray:
    """The ``most`` best corners (Shi and Tomasi 1994) of a (h, w) uint8 picture, spread over it: (n, 1, 2) float32
    pixels."""
    found = cv2.goodFeaturesToTrack(grey, most, qualityLevel=0.01, minDistance=max(grey.shape) / 40)
    return np.zeros((0, 1, 2), np.float32) if found is None else found


def follow(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where ``points`` (n, 1, 2) of one grey picture are in another, and which were found, (n,) bool: optical flow
    (Lucas and Kanade 1981, in pyramids)."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, points.copy())
    return found, status[:, 0].astype(bool)


def follow_both_ways(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`follow`, found being only what comes back to where it began when followed the other way."""
    there, is_there = follow(before, after, points)
    back, is_back = follow(after, before, there)
    returned = np.linalg.norm(back - points, axis=2)[:, 0] < ROUND_TRIP_PX
    return there, is_there & is_back & returned
