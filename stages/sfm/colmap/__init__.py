"""Everything that is done with COLMAP: the only package that imports pycolmap.

``database``: features and matches. ``mappers``: models of them. ``model_check``: whether a model agrees with its
matches; ``repair`` and ``joining`` make a better one where it does not. ``model_comparison``: in which images two
models differ. ``unregistered_images``: what a model lacks, and why. ``adjustment``: cameras, poses and points adjusted.
``models``: models on disk. ``cameras``: pixels to rays and back.

COLMAP is native code that can abort, so it runs in worker processes (stages/sfm/worker.py and others). Safe to call
anywhere are cameras.py and, in models.py, what reads and writes a SparseModel. *Native* is COLMAP's own object or file,
as opposed to our Camera and SparseModel.

Image ids are 1 + the position of the photo in order of ``file``; an image, its frame and its COLMAP name belong
together (COLMAP's rigs and frames are trivial here: one camera each).

Importing the package imports pycolmap, after Pillow: their wheels do not share zlib, and the other way round Pillow's
PNG encoder hangs. It also takes back the signal handler that pycolmap installs, which would turn SIGTERM into a crash
report.
"""

import signal
import threading

import PIL.Image  # noqa: F401 -- before pycolmap

_sigterm = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, F401

if _sigterm is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _sigterm)
