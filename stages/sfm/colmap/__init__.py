"""Everything that is done with COLMAP: the only room that imports pycolmap, always inside functions.

COLMAP is native code that can abort, so the steps of structure-from-motion (matching.py, mapping.py, refinement.py)
run in a child process (stages/sfm/worker.py); cameras.py and models.py are safe to call anywhere.

Image ids are 1 + the photo's place in order of ``file``; an image, its frame and its COLMAP name belong together
(COLMAP's rigs and frames are trivial here: one camera each).
"""

import signal
import threading

# Before pycolmap, whose wheel brings a zlib of its own: loaded first, it makes Pillow's PNG encoder hang or abort
# (pycolmap 4.2.1, Pillow 13).
import PIL.Image  # noqa: F401


def load() -> None:
    """Import pycolmap, and take back the handler that it installs: it would turn SIGTERM into a crash report."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap  # noqa: F401 -- for its side effect

    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
