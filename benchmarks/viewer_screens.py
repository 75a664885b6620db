"""Makes the picture of viewer.html in README and docs, of a run of `pipeline demo`, in headless Chromium.

    python -m benchmarks.viewer_screens demo/demo.nerf/output/viewer.html docs/images/viewer.jpg

The first view with its menu; a crop box around the sparse points of the region of interest cuts the still
life out. With software WebGL it takes minutes.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from tests.stages.viewer.browser import Viewer, chromium

SIZE, QUALITY = (1000, 520), 85  # the menu leaves the scene its place
REGION = 0.9  # half the side of the region of interest
QUANTILES, MARGIN = (0.5, 99.5), 0.04  # percent of the points; scene units around them
PATIENCE_SECONDS = 3600

CROP = """(sides) => {
  byId("panel").hidden && byId("menu").click();
  [...byId("crop-sliders").querySelectorAll("input")].forEach((input, i) => {
    input.value = sides[i];
    input.dispatchEvent(new Event("input"));
  });
  byId("panel").scrollTop = 0;
}"""


def sides_around_points(page: Viewer) -> list[float]:
    """Low and high of x, y and z, one after the other."""
    points = np.array(page.run("Array.from(floats(viewer.contents.section('points_xyz')))")).reshape(-1, 3)
    points = points[(np.abs(points) < REGION).all(axis=1)]
    low, high = np.percentile(points, QUANTILES, axis=0) + np.array([[-MARGIN], [MARGIN]])
    return np.stack([low, high], axis=1).flatten().tolist()


def main() -> None:
    """The picture of one page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("picture", type=Path)
    given = parser.parse_args()
    with chromium() as browser:
        page = Viewer(browser, given.page.resolve(), *SIZE, color_scheme="dark")
        page.run(CROP, sides_around_points(page))
        ends = time.monotonic() + PATIENCE_SECONDS
        while not page.run("viewer.renderer.isDone"):
            assert time.monotonic() < ends
            time.sleep(1)
        page.page.screenshot(path=given.picture, type="jpeg", quality=QUALITY)
        page.close()


if __name__ == "__main__":
    main()
