"""What the server of drills imports once for all programs; nothing here may start a thread."""

import os

import cv2  # noqa: F401
import matplotlib  # noqa: F401
import scipy.ndimage
import scipy.spatial  # noqa: F401
import skimage.measure  # noqa: F401
import torch
import trimesh  # noqa: F401
import warp  # noqa: F401

import pipeline.cli.commands  # noqa: F401
import stages.sfm.colmap
import stages.train.profile
from nerf.runtime.machine_rates import Rates

torch.set_num_threads(torch.get_num_threads())
# Each training measures the machine for half a second on all cores at its end; no result depends on it.
stages.train.profile.measure_rates = lambda *_: Rates(1e10, 1e8, 1e10)
# Nor do drills cut the power.
os.fsync = lambda fd: None
