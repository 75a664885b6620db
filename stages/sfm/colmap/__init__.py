"""Everything that is done with COLMAP: the only package that imports pycolmap.

COLMAP is native code that can abort, so the steps of structure-from-motion (database.py, mapping.py,
final_bundle_adjustment.py) run in a worker process (stages/sfm/worker.py); cameras.py and models.py are safe to call
anywhere.

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
