"""In which order native libraries are loaded, in a process of its own."""

import subprocess
import sys

import pytest

ENCODE = """
import io, sys
import numpy as np
from nerf.geometry.scene import Camera
from stages.sfm.colmap.cameras import native
native(Camera("PINHOLE", 10, 10, (5.0, 5.0, 5.0, 5.0)))
loaded = list(sys.modules)
assert loaded.index("PIL._imaging") < loaded.index("pycolmap")
from PIL import Image
pixels = np.random.default_rng(0).integers(0, 255, (400, 600, 3), dtype=np.uint8)
Image.fromarray(pixels).save(io.BytesIO(), "PNG")
print("encoded")
"""


def test_pillow_writes_png_after_colmap_was_used():
    done = subprocess.run([sys.executable, "-c", ENCODE], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout == "encoded\n", done.stderr


SPOILT = """
import pycolmap
import numpy as np
from pathlib import Path
from stages.contract import StageError
from stages.io.files import write_png
try:
    write_png(Path("never.png"), np.zeros((400, 600), np.uint8))
except StageError as error:
    print(error.code)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="libraries share symbols on Linux alone")
def test_pycolmap_before_pillow_is_refused_without_hanging():
    done = subprocess.run([sys.executable, "-c", SPOILT], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout == "io.pycolmap-before-pillow\n", done.stderr
