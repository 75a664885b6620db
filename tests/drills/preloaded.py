"""What the server of drills imports once for all programs; nothing here may start a thread."""

import cv2  # noqa: F401
import matplotlib  # noqa: F401
import scipy.ndimage
import scipy.spatial  # noqa: F401
import skimage.measure  # noqa: F401
import torch
import trimesh  # noqa: F401
import warp  # noqa: F401

import pipeline.cli.commands  # noqa: F401
import stages.sfm.colmap  # noqa: F401

torch.set_num_threads(torch.get_num_threads())
