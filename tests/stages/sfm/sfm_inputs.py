"""What the tests of stage sfm give it: pictures as ingest would leave them, and a search for few features."""

from pathlib import Path

import numpy as np
from PIL import Image

from stages import sfm
from stages.io.photos import Photo, write_photos

SMALL = sfm.Config(max_features=1000)


def ingested(folder: Path, images: dict[str, np.ndarray]) -> dict[str, Path]:
    """What ingest would leave of these pictures: one camera for those of equal size."""
    (folder / "images").mkdir(parents=True)
    photos, sizes = [], {}
    for name, pixels in images.items():
        Image.fromarray(pixels).save(folder / "images" / name)
        height, width = pixels.shape[:2]
        group = sizes.setdefault((width, height), len(sizes))
        photos.append(Photo(name, f"images/{name}", width, height, group, None, None, pixels.shape[2] == 4, 1.0))
    write_photos(folder, photos, [], {})
    return {"ingest": folder}
