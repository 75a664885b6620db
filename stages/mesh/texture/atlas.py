"""The atlas of a texture: where each chart lies in it, packed by xatlas (Jonathan Young, MIT)."""

from typing import NamedTuple

import numpy as np
import xatlas

from stages.contract import StageError
from stages.mesh.surface import Surface
from stages.mesh.texture.charts import cut_into_charts

PADDING = 2  # texels between charts: more than bilinear filtering reaches
FILL = 0.5  # of the area of an atlas, about what its charts take; what does not fit is packed again, smaller
SHRINK = 0.97  # how much smaller than just fitting
MAX_DENSITY_RATIO = 8.0  # of a chart's texels per unit to the median chart's, either way


class Atlas(NamedTuple):
    """``uv`` (n, 2): texel coordinates, x right and y down; ``corner`` (faces, 3): each face's corners among them;
    ``vertex`` (n,): which vertex of the surface each of them is. ``texels_per_pixel``: how many texels along a line
    there are for each pixel of the photo that shows the most there."""

    uv: np.ndarray
    corner: np.ndarray
    vertex: np.ndarray
    width: int
    height: int
    texels_per_pixel: float


class Texture(NamedTuple):
    """An atlas and its ``picture``, (height, width, 3) uint8 sRGB."""

    atlas: Atlas
    picture: np.ndarray

    def coordinates(self) -> np.ndarray:
        """Texture coordinates (n, 2) in [0, 1], u to the right and v upwards."""
        return np.array([0.0, 1.0]) + self.atlas.uv * [1, -1] / [self.atlas.width, self.atlas.height]


def make_atlas(surface: Surface, pixels_per_unit: np.ndarray, max_size: int) -> Atlas:
    """An atlas of at most ``max_size`` texels a side. ``pixels_per_unit`` (faces,): how finely the photos show each
    face, in pixels along a line of one unit of length; charts get as many texels, fewer where that is too large.

    Raises StageError where that many texels cannot hold the charts.
    """
    charts = cut_into_charts(surface)
    key = charts.chart[:, None] * len(surface.vertices) + surface.faces
    _, first, corner = np.unique(key, return_index=True, return_inverse=True)
    corner = corner.reshape(-1, 3)
    island, vertex = np.repeat(charts.chart, 3)[first], surface.faces.reshape(-1)[first]
    uv = (
        charts.corners.reshape(-1, 2)[first]
        * _chart_density(charts.chart, pixels_per_unit, charts.corners)[island, None]
    )
    area = float(np.abs(_areas(uv[corner])).sum())
    scale = min(1.0, FILL**0.5 * max_size / max(area, np.finfo(float).tiny) ** 0.5)
    count = int(charts.chart.max()) + 1
    while scale == 1 or area * scale**2 >= count:  # a texel for each chart
        packed, width, height = _pack(uv * scale, corner, charts.chart)
        if 0 < max(width, height) <= max_size:
            return Atlas(packed, corner, vertex, width, height, scale)
        scale *= SHRINK * min(1.0, max_size / max(width, height, 1))
    raise StageError(
        "mesh.texture-too-small",
        f"a texture of {max_size} × {max_size} texels is too small for this mesh",
        f"its {len(surface.faces)} faces make {count} charts, and each takes a few texels",
        "Try a larger --mesh.texture-size, or fewer --mesh.max-faces.",
    )


def _chart_density(chart: np.ndarray, pixels_per_unit: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Texels per unit of length of each chart: what the photos show of its faces, on the mean by area."""
    area = np.abs(_areas(corners)) + np.finfo(float).tiny
    density = np.sqrt(np.bincount(chart, pixels_per_unit**2 * area) / np.bincount(chart, area))
    typical = float(np.sqrt((pixels_per_unit**2 * area).sum() / area.sum()))
    return density.clip(typical / MAX_DENSITY_RATIO, typical * MAX_DENSITY_RATIO)


def _areas(corners: np.ndarray) -> np.ndarray:
    """Signed areas of 2-D triangles (n, 3, 2)."""
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return (ax * by - ay * bx) / 2


def _pack(uv: np.ndarray, corner: np.ndarray, chart: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Texel coordinates of ``uv`` once its charts lie beside each other, and the size they take: 0 where xatlas finds
    nothing large enough to be packed."""
    packer, options = xatlas.Atlas(), xatlas.PackOptions()
    options.padding, options.bilinear, options.texels_per_unit = PADDING, True, 1.0
    options.rotate_charts_to_axis = False
    packer.add_uv_mesh(uv.astype(np.float32), corner.astype(np.uint32), chart.astype(np.uint32)[:, None])
    packer.generate(xatlas.ChartOptions(), options)
    _, faces, packed = packer[0]
    texels = np.empty((len(uv), 2))
    texels[corner.reshape(-1)] = (packed * [packer.width, packer.height])[faces.reshape(-1)]
    return texels, packer.width, packer.height
