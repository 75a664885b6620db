"""All pixels of a set of photos, and what it takes to turn any of them into a ray.

Photos may differ in size and camera. They are laid end to end: a *pixel* index counts through all of them, row by
row. The pixels stay uint8 and may be a file mapped into memory, so that there may be more of them than memory holds.

A camera is a mosaic of *patches*, each small enough for its ray directions to be linear in the pixel (the model of a
pinhole camera: exact without distortion). One look-up then gives the ray of a pixel, and a camera takes the same small
memory whatever the size of its photos: a set where every photo has a camera of its own stays small.

Where photos have masks, the unmasked pixels are kept as *runs* of neighbours, of which a photo has a few in a
row; without masks there are none, and nothing to look up.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nerf.geometry.rays import Rays

# Ray directions are scaled to the plane z = 1, where those of a camera without distortion are linear in the pixel.
# Beyond 60 degrees from the axis, where that plane is too far away, they keep a bounded length.
MIN_FORWARD = 0.5
# Rows of RayDataset.view_geometry.
ROTATION, CENTRE, NEAR_AND_FAR, PATCHES_PER_PIXEL = slice(0, 9), slice(9, 12), slice(12, 14), slice(14, 16)


class PixelBatch(NamedTuple):
    """Pixels with the rays through them: colour and alpha in [0, 1] (None without such a channel), and whose view."""

    rays: Rays
    colour: Float[Tensor, "rays 3"]
    alpha: Float[Tensor, "rays"] | None
    view: Int[Tensor, "rays"]


class DepthMaps(NamedTuple):
    """Depth maps of all views, laid end to end row by row, of any sizes: ``distance`` along the unit rays of their
    pixels (scene units; 0: not known). ``layout`` has a column per view: its first entry, width, height."""

    distance: Float[Tensor, "entries"]
    layout: Int[Tensor, "3 views"]

    def to(self, device: torch.device | str) -> "DepthMaps":
        """These, on ``device``."""
        return DepthMaps(*(table.to(device) for table in self))


class RayDataset(NamedTuple):
    """Photos as one table of pixels; make it with :func:`make_ray_dataset` or :func:`ray_dataset_from_images`.

    View v owns the pixels [first_pixel[v], first_pixel[v + 1]); ``pixels`` have 3 channels, or 4 with a straight (not
    premultiplied) alpha. What a look-up needs of a view stands in two tables with a column per view:

    * ``view_layout``: its first pixel, its width, its camera's first patch, patches in a row;
    * ``view_geometry``: the ROTATION scene_from_camera row by row, the CENTRE, near and far, PATCHES_PER_PIXEL along x
      and y.

    ``patches`` has a column per patch: the direction in its middle, and how it changes along x and y over one patch.

    ``runs`` has a column per run of unmasked pixels: how many unmasked pixels lie before it, and its first pixel. A
    last column has the number of all of them. None: no pixel is masked.

    ``sparse_pixels`` are pixels that show a sparse point, ``sparse_depths`` how far along their rays (scene units) it
    lies. None: of no pixel is that known. ``depth_maps``: what stereo says of every pixel; None: nothing.
    """

    pixels: UInt8[Tensor, "pixels channels"]
    first_pixel: Int[Tensor, "views_and_end"]
    view_layout: Int[Tensor, "4 views"]
    view_geometry: Float[Tensor, "16 views"]
    patches: Float[Tensor, "9 patches"]
    runs: Int[Tensor, "2 runs_and_end"] | None = None
    sparse_pixels: Int[Tensor, "known"] | None = None
    sparse_depths: Float[Tensor, "known"] | None = None
    depth_maps: DepthMaps | None = None

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self.pixels.device

    @property
    def near(self) -> Float[Tensor, "views"]:
        """Per view, where rays begin."""
        return self.view_geometry[NEAR_AND_FAR][0]

    @property
    def width(self) -> Int[Tensor, "views"]:
        """Per view, pixels in a row of its photo."""
        return self.view_layout[1]

    @property
    def viewing_distance(self) -> Float[Tensor, "views"] | None:
        """Per view, the median of how far away its known pixels show something (scene units): of all that are known
        where it has none; None where nothing is known."""
        if self.sparse_pixels is None or self.sparse_depths is None:
            return None
        view = torch.searchsorted(self.first_pixel, self.sparse_pixels, right=True).sub_(1)
        counts = torch.bincount(view, minlength=len(self.near)).tolist()
        of_all, of_views = self.sparse_depths.median(), self.sparse_depths[view.argsort(stable=True)].split(counts)
        return torch.stack([each.median() if len(each) else of_all for each in of_views])

    def to(self, device: torch.device | str) -> "RayDataset":
        """This dataset with its tables on ``device``."""
        moved = {name: table.to(device) for name, table in self._asdict().items() if table is not None}
        return self._replace(**moved)

    @property
    def unmasked_count(self) -> int:
        """How many pixels no mask excludes."""
        return len(self.pixels) if self.runs is None else int(self.runs[0, -1])

    def with_masks(self, ignored: Iterable[Bool[Tensor, "_ _"] | None]) -> "RayDataset":
        """This dataset with pixels that :meth:`sample_pixels` never gives: per view, (height, width) True where the
        photo is to be ignored, None where all of it is used. Taken one by one, for together they may not fit into
        memory. Raises ValueError if no pixel is left."""
        runs = _runs(ignored, self.first_pixel)
        if runs[0, -1] == len(self.pixels):
            return self
        if not runs[0, -1]:
            raise ValueError("the masks ignore every pixel")
        return self._replace(runs=runs.to(self.device))

    def with_sparse_depths(self, pixel: Int[Tensor, "known"], sparse_depths: Float[Tensor, "known"]) -> "RayDataset":
        """This dataset with sparse depths: how far along their rays (scene units) these pixels show a sparse point.

        Left out are pixels that may not be drawn (so give the masks first), those that are not wholly opaque, whose
        light ends in part elsewhere, and distances that are not between near and far of their views: no sample stands
        there, and what does would be pulled to the end of the ray."""
        view = torch.searchsorted(self.first_pixel, pixel, right=True) - 1
        near, far = self.view_geometry[NEAR_AND_FAR].index_select(1, view)
        kept = self.is_unmasked(pixel) & (near < sparse_depths) & (sparse_depths < far)
        if self.pixels.shape[1] == 4:
            kept &= self.pixels.index_select(0, pixel)[:, 3] == 255
        return self._with_sparse(pixel[kept], sparse_depths[kept].float())

    def with_sparse_depths_within(self, half: float) -> "RayDataset":
        """This dataset without the known distances that end outside of the cube from -``half`` to ``half``."""
        if self.sparse_pixels is None or self.sparse_depths is None:
            return self
        rays, _ = self.rays(self.sparse_pixels)
        inside = ((rays.origins + self.sparse_depths[:, None] * rays.directions).abs() <= half).all(-1)
        return self._with_sparse(self.sparse_pixels[inside], self.sparse_depths[inside])

    def _with_sparse(self, pixel: Int[Tensor, "known"], sparse_depths: Float[Tensor, "known"]) -> "RayDataset":
        sparse_pixels = len(pixel) > 0
        return self._replace(
            sparse_pixels=pixel if sparse_pixels else None, sparse_depths=sparse_depths if sparse_pixels else None
        )

    def with_depth_maps(self, distances: Sequence[Float[Tensor, "_ _"]]) -> "RayDataset":
        """This dataset with a depth map per view, of any size: distances along the rays (scene units), 0 where they are
        not known. Raises ValueError unless there is one for each view."""
        if len(distances) != len(self.near):
            raise ValueError(f"there are {len(distances)} depth maps, and {len(self.near)} photos")
        first = _starts([each.numel() for each in distances])[:-1]
        sizes = torch.tensor([(each.shape[1], each.shape[0]) for each in distances])
        maps = DepthMaps(torch.cat([each.flatten() for each in distances]), torch.cat([first[:, None], sizes], 1).T)
        return self._replace(depth_maps=maps.to(self.device))

    def depths(self, pixel: Int[Tensor, "rays"], view: Int[Tensor, "rays"]) -> Float[Tensor, "rays"]:
        """How far along their rays pixels of these views show something, by the pixel of their depth map that their
        middle falls into; 0 where that is not known, and beyond near and far."""
        assert self.depth_maps is not None, "the dataset has no depth maps"
        first_pixel, width, *_ = self.view_layout.index_select(1, view)
        height = self.first_pixel.diff().index_select(0, view) // width
        first, across, down = self.depth_maps.layout.index_select(1, view)
        within = pixel - first_pixel
        row, column = (2 * (within // width) + 1) * down // (2 * height), (2 * (within % width) + 1) * across
        distance = self.depth_maps.distance.index_select(0, first + row * across + column // (2 * width))
        near, far = self.view_geometry[NEAR_AND_FAR].index_select(1, view)
        return distance * ((near < distance) & (distance < far))

    def lookup(self, pixel: Int[Tensor, "rays"]) -> PixelBatch:
        """Given pixels, and the rays through them."""
        rays, view = self.rays(pixel)
        values = self.pixels.index_select(0, pixel).float().div_(255)
        return PixelBatch(rays, values[:, :3], values[:, 3] if values.shape[1] == 4 else None, view)

    def rays(self, pixel: Int[Tensor, "rays"]) -> tuple[Rays, Int[Tensor, "rays"]]:
        """The rays through pixels, and whose views they are; the photos, which may be on disk, are not read."""
        view = torch.searchsorted(self.first_pixel, pixel, right=True).sub_(1)
        view_geometry = self.view_geometry.index_select(1, view)
        direction = self._direction(pixel, self.view_layout.index_select(1, view), view_geometry[PATCHES_PER_PIXEL])
        directions = (view_geometry[ROTATION].view(3, 3, -1) * direction).sum(1)
        near, far = view_geometry[NEAR_AND_FAR]
        return Rays(view_geometry[CENTRE].T.contiguous(), directions.T.contiguous(), near, far), view

    def _direction(
        self, pixel: Int[Tensor, "rays"], view_layout: Int[Tensor, "4 rays"], per_pixel: Float[Tensor, "2 rays"]
    ) -> Float[Tensor, "3 rays"]:
        """Unit directions in the camera frame: of the patch, b + u db/du + v db/dv, with (u, v) from its middle."""
        first_pixel, width, first_patch, across = view_layout
        within = pixel - first_pixel
        row = within // width
        x, y = (within - row * width + 0.5) * per_pixel[0], (row + 0.5) * per_pixel[1]  # in patches
        column, line = x.long(), y.long()
        u, v = x.sub_(column).sub_(0.5), y.sub_(line).sub_(0.5)
        middle, along_x, along_y = self.patches.index_select(1, first_patch + line * across + column).view(3, 3, -1)
        direction = torch.addcmul(torch.addcmul(middle, along_x, u), along_y, v)
        return direction / direction.square().sum(0).sqrt_()

    def sample_pixels(self, count: int, generator: torch.Generator) -> Int[Tensor, "rays"]:
        """``count`` pixels drawn uniformly from those that may be, with replacement."""
        return self.unmasked_pixels(
            torch.randint(self.unmasked_count, (count,), generator=generator, device=self.device)
        )

    def unmasked_pixels(self, number: Int[Tensor, "rays"]) -> Int[Tensor, "rays"]:
        """The pixels that have these numbers, from 0 on, among those that may be drawn."""
        return number if self.runs is None else _in_runs(self.runs, number)

    def sample_sparse_depths(
        self, count: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, "rays"], Float[Tensor, "rays"]]:
        """``count`` of the pixels whose distance is known, drawn uniformly with replacement, and their distances."""
        assert self.sparse_pixels is not None and self.sparse_depths is not None, "the dataset has no sparse depths"
        drawn = torch.randint(len(self.sparse_pixels), (count,), generator=generator, device=self.device)
        return self.sparse_pixels.index_select(0, drawn), self.sparse_depths.index_select(0, drawn)

    def is_unmasked(self, pixel: Int[Tensor, "*rays"]) -> Bool[Tensor, "*rays"]:
        """Whether no mask excludes these pixels."""
        if self.runs is None:
            return torch.ones_like(pixel, dtype=torch.bool)
        before, first = self.runs
        run = torch.searchsorted(first.contiguous(), pixel.flatten(), right=True).sub_(1).clamp_(min=0)
        into = pixel.flatten() - first[run]
        return ((into >= 0) & (into < before.diff()[run])).view(pixel.shape)


class PosedViews(NamedTuple):
    """How the views stand: scene_from_camera, and distances along the unit ray."""

    poses: Float[Tensor, "views 3 4"]
    near: Float[Tensor, "views"]
    far: Float[Tensor, "views"]


def make_ray_dataset(
    pixels: UInt8[Tensor, "pixels channels"],
    sizes: Sequence[tuple[int, int]],
    camera_of: Sequence[int],
    camera_directions: Sequence[Float[Tensor, "_ _ 3"]],
    posed_views: PosedViews,
) -> RayDataset:
    """The dataset of photos that are laid end to end already.

    Args:
        pixels: all photos, row by row, with 3 or with 4 channels; taken as it is, without a copy.
        sizes: per view, (height, width) of its photo in pixels.
        camera_of: per view, the index of its camera in ``camera_directions``.
        camera_directions: per camera, (rows, columns, 3) direction vectors (camera frame) in the middles of the equal
            patches into which they divide the picture. As many as pixels give each pixel its own; fewer are enough
            where distortion is smooth.
        placement: of every view.

    Raises:
        ValueError: if there are no photos, one has fewer pixels along a side than its camera has directions, or
            ``pixels`` has another length than all photos together.
    """
    if not sizes:
        raise ValueError("a ray dataset needs at least one photo")
    grids = [(directions.shape[0], directions.shape[1]) for directions in camera_directions]
    for view, (size, camera) in enumerate(zip(sizes, camera_of, strict=True)):
        if size[0] < grids[camera][0] or size[1] < grids[camera][1]:
            raise ValueError(f"photo {view} has size {size}, its camera {camera} {grids[camera]} directions")
    first_pixel = _starts([height * width for height, width in sizes])
    if len(pixels) != first_pixel[-1]:
        raise ValueError(f"there are {len(pixels)} pixels, the photos have {first_pixel[-1]}")
    first_patch = _starts([rows * columns for rows, columns in grids])
    cameras = torch.tensor(camera_of)
    grid, size = torch.tensor(grids)[cameras], torch.tensor(sizes)
    poses, near, far = posed_views
    rotations, centres = poses[:, :, :3].reshape(-1, 9), poses[:, :, 3]
    return RayDataset(
        pixels=pixels,
        first_pixel=first_pixel,
        view_layout=torch.stack([first_pixel[:-1], size[:, 1], first_patch[cameras], grid[:, 1]]),
        view_geometry=torch.cat(
            [rotations, centres, near[:, None], far[:, None], (grid / size).flip(1)], 1
        ).T.contiguous(),
        patches=torch.cat([_patches(directions) for directions in camera_directions], 1),
    )


def ray_dataset_from_images(
    photos: Sequence[UInt8[Tensor, "_ _ channels"]],
    camera_of: Sequence[int],
    camera_directions: Sequence[Float[Tensor, "_ _ 3"]],
    poses: Float[Tensor, "views 3 4"],
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
) -> RayDataset:
    """:func:`make_ray_dataset` of photos in memory, (height, width, channels) each, which it copies."""
    pixels = [photo.flatten(0, 1) for photo in photos] or [torch.zeros(0, 3, dtype=torch.uint8)]
    sizes = [(photo.shape[0], photo.shape[1]) for photo in photos]
    return make_ray_dataset(torch.cat(pixels), sizes, camera_of, camera_directions, PosedViews(poses, near, far))


def _runs(
    ignored: Iterable[Bool[Tensor, "_ _"] | None], first_pixel: Int[Tensor, "views_and_end"]
) -> Int[Tensor, "2 runs_and_end"]:
    """Runs of pixels that are not ignored, as :class:`RayDataset` has them. No run is longer than a view."""
    firsts, lengths = [], []
    for mask, start, end in zip(ignored, first_pixel[:-1], first_pixel[1:], strict=True):
        if mask is None:
            firsts.append(start[None])
            lengths.append((end - start)[None])
            continue
        used = torch.nn.functional.pad((~mask).flatten().to(torch.int8), (1, 1))
        change = used.diff()
        begins, ends = (change == 1).nonzero()[:, 0], (change == -1).nonzero()[:, 0]
        firsts.append(start + begins)
        lengths.append(ends - begins)
    before = _starts(torch.cat(lengths).tolist())
    return torch.stack([before, torch.cat([*firsts, first_pixel[-1:]])])


def _in_runs(runs: Int[Tensor, "2 runs_and_end"], drawn: Int[Tensor, "rays"]) -> Int[Tensor, "rays"]:
    """The pixels that are the ``drawn``-th ones, counted from 0, of those in runs."""
    before, first = runs.index_select(1, torch.searchsorted(runs[0].contiguous(), drawn, right=True).sub_(1))
    return first + drawn - before


def _patches(directions: Float[Tensor, "rows columns 3"]) -> Float[Tensor, "9 patches"]:
    """Directions on the plane z = 1, with their slopes along x and y per patch (central differences)."""
    flat = directions / directions[..., 2:].clamp(min=MIN_FORWARD)
    return torch.cat([flat, _slope(flat, 1), _slope(flat, 0)], -1).flatten(0, 1).T.contiguous()


def _slope(values: Float[Tensor, "rows columns 3"], axis: int) -> Float[Tensor, "rows columns 3"]:
    count = values.shape[axis]
    if count == 1:
        return torch.zeros_like(values)
    return torch.gradient(values, dim=axis, edge_order=min(2, count - 1))[0]


def _starts(counts: list[int]) -> Int[Tensor, "counts_and_end"]:
    """Where each of several runs of ``counts`` items begins, and at last where the last one ends."""
    return torch.cat([torch.zeros(1, dtype=torch.int64), torch.tensor(counts, dtype=torch.int64).cumsum(0)])
