import weakref

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerf.geometry.rays import rays_of_view
from nerf.runtime.randomness import generator
from nerf.training.ray_dataset import PosedViews, RayDataset, _in_runs, make_ray_dataset, ray_dataset_from_images

SIZES = [(3, 5), (4, 2), (3, 5)]  # (height, width) of each view
CAMERAS = [0, 1, 0]


def scattered(channels: int = 3) -> tuple[RayDataset, list[Tensor], list[Tensor], Tensor]:
    random = generator("cpu", 11)
    photos = [torch.randint(256, (h, w, channels), generator=random, dtype=torch.uint8) for h, w in SIZES]
    directions = [torch.randn(h, w, 3, generator=random) for h, w in SIZES[:2]]
    directions = [b / b.norm(dim=-1, keepdim=True) for b in directions]
    poses = torch.cat([torch.linalg.qr(torch.randn(3, 3, 3, generator=random))[0], torch.randn(3, 3, 1)], -1)
    near = torch.tensor([1.0, 2.0, 3.0])
    return ray_dataset_from_images(photos, CAMERAS, directions, poses, near, near + 5), photos, directions, poses


def test_every_pixel_gets_its_own_ray_and_colour() -> None:
    dataset, photos, directions, poses = scattered()
    rays, colours, alpha, _ = dataset.lookup(torch.arange(3 * 5 + 4 * 2 + 3 * 5))
    expected = [rays_of_view(directions[c], poses[v], v + 1.0, v + 6.0) for v, c in enumerate(CAMERAS)]
    for name, width in {"origins": (3,), "directions": (3,), "near": (), "far": ()}.items():
        flat = torch.cat([getattr(part, name).reshape(-1, *width) for part in expected])
        torch.testing.assert_close(getattr(rays, name), flat)
    assert torch.equal(colours, torch.cat([photo.flatten(0, 1) for photo in photos]).float() / 255)
    assert alpha is None


def test_the_fourth_channel_is_alpha() -> None:
    dataset, photos, _, _ = scattered(channels=4)
    _, colours, alpha, _ = dataset.lookup(torch.tensor([0, 7]))
    assert alpha is not None
    assert torch.equal(alpha, photos[0].flatten(0, 1)[[0, 7], 3].float() / 255)
    assert torch.equal(colours, photos[0].flatten(0, 1)[[0, 7], :3].float() / 255)


def test_samples_are_uniform_over_pixels() -> None:
    dataset, *_ = scattered()
    count = 38_000  # a thousand for each of the 38 pixels
    near = dataset.lookup(dataset.sample_pixels(count, generator("cpu", 0))).rays.near
    for view, (height, width) in enumerate(SIZES):
        expected = count * height * width / 38
        assert abs((near == view + 1).sum() - expected) < 4 * expected**0.5


def test_samples_depend_on_the_generator_alone() -> None:
    dataset, *_ = scattered()
    first, second, other = (dataset.sample_pixels(20, generator("cpu", seed)) for seed in (1, 1, 2))
    assert torch.equal(first, second) and not torch.equal(first, other)


def test_a_photo_smaller_than_its_camera_is_refused() -> None:
    photo, directions = torch.zeros(2, 3, 3, dtype=torch.uint8), torch.zeros(3, 2, 3)
    with pytest.raises(ValueError, match=r"photo 0 has size \(2, 3\), its camera 0 \(3, 2\) directions"):
        ray_dataset_from_images([photo], [0], [directions], torch.zeros(1, 3, 4), torch.ones(1), torch.ones(1))


def test_no_photos_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one photo"):
        ray_dataset_from_images([], [], [], torch.zeros(0, 3, 4), torch.ones(0), torch.ones(0))


def test_a_table_that_is_not_all_photos_is_refused() -> None:
    placement = PosedViews(torch.zeros(1, 3, 4), torch.ones(1), torch.ones(1))
    with pytest.raises(ValueError, match="there are 5 pixels, the photos have 6"):
        make_ray_dataset(torch.zeros(5, 3, dtype=torch.uint8), [(2, 3)], [0], [torch.ones(1, 1, 3)], placement)


def test_the_table_of_pixels_is_not_copied() -> None:
    placement = PosedViews(torch.zeros(1, 3, 4), torch.ones(1), torch.ones(1))
    pixels = torch.zeros(6, 3, dtype=torch.uint8)
    assert make_ray_dataset(pixels, [(2, 3)], [0], [torch.ones(1, 1, 3)], placement).pixels is pixels


@given(st.integers(1, 40), st.integers(1, 40), st.integers(2, 40), st.integers(2, 40))
def test_without_distortion_few_patches_are_as_good_as_many(rows: int, columns: int, height: int, width: int) -> None:
    rows, columns = min(max(2, rows), height), min(max(2, columns), width)

    def directions(rows: int, columns: int) -> Tensor:
        y, x = torch.meshgrid((torch.arange(rows) + 0.5) / rows, (torch.arange(columns) + 0.5) / columns, indexing="ij")
        direction = torch.stack([1.2 * x - 0.5, 0.8 * y - 0.4, torch.ones_like(x)], -1)
        return direction / direction.norm(dim=-1, keepdim=True)

    photo = torch.zeros(height, width, 3, dtype=torch.uint8)
    views = (torch.eye(3, 4)[None], torch.ones(1), torch.ones(1))
    dataset = ray_dataset_from_images([photo], [0], [directions(rows, columns)], *views)
    found = dataset.lookup(torch.arange(height * width))[0].directions
    assert dataset.patches.shape[1] == rows * columns
    torch.testing.assert_close(found, directions(height, width).view(-1, 3), atol=2e-6, rtol=0)


def test_rays_are_unit_vectors_behind_the_camera_too() -> None:
    turn = torch.linspace(0.1, 2.9, 33)  # to 166 degrees from the axis
    directions = torch.stack([turn.sin(), torch.zeros(33), turn.cos()], -1)[None]
    photo = torch.zeros(1, 330, 3, dtype=torch.uint8)
    dataset = ray_dataset_from_images([photo], [0], [directions], torch.eye(3, 4)[None], torch.ones(1), torch.ones(1))
    directions = dataset.lookup(torch.arange(330))[0].directions
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(330))
    step = (2.9 - 0.1) / 32
    expected = 0.1 + step * ((torch.arange(330) + 0.5) / 10 - 0.5)
    off = torch.atan2(directions[:, 0], directions[:, 2]) - expected
    assert 0 < off.abs().max() < 0.1 * step


SHARES = st.sampled_from([None, 0.0, 0.3, 0.6, 0.9, 1.0])


@given(st.tuples(SHARES, SHARES, SHARES), st.integers(0, 99))
def test_runs_count_through_the_pixels_that_no_mask_ignores(shares: tuple[float | None, ...], seed: int) -> None:
    dataset, *_ = scattered()
    random = generator("cpu", seed)
    noise = [torch.rand(size, generator=random) for size in SIZES]
    ignored = [None if share is None else part < share for share, part in zip(shares, noise, strict=True)]
    flat = [(part < (share or 0)).flatten() for share, part in zip(shares, noise, strict=True)]
    used = (~torch.cat(flat)).nonzero()[:, 0]
    if not len(used):
        with pytest.raises(ValueError, match="the masks ignore every pixel"):
            dataset.with_masks(ignored)
        return
    masked = dataset.with_masks(ignored)
    assert masked.unmasked_count == len(used)
    if len(used) == 38:
        assert masked is dataset and dataset.runs is None
    else:
        assert masked.runs is not None
        assert torch.equal(_in_runs(masked.runs, torch.arange(len(used))), used)


def test_ignored_pixels_are_never_drawn_and_the_others_alike() -> None:
    dataset, photos, *_ = scattered()
    ignored = torch.zeros(SIZES[0], dtype=torch.bool)
    ignored[1:, 1:4] = True
    masked = dataset.with_masks([ignored, torch.ones(SIZES[1], dtype=torch.bool), None])
    used = torch.cat([photos[0][~ignored], photos[2].flatten(0, 1)]).float() / 255
    drawn = masked.lookup(
        masked.sample_pixels(24_000, generator("cpu", 0))
    ).colour  # a thousand for each of the 24 pixels
    counts = (drawn[:, None] == used).all(-1).sum(0)
    assert len(used) == 24 and counts.sum() == 24_000
    assert torch.equal(masked.lookup(masked.unmasked_pixels(torch.arange(24))).colour, used)
    assert (counts - 1000).abs().max() < 4 * 1000**0.5


def test_masks_are_taken_one_by_one_and_dropped() -> None:
    dataset, *_ = scattered()
    shown, alive = list[weakref.ref[Tensor]](), list[int]()

    def mask(size: tuple[int, int]) -> Tensor:
        alive.append(sum(each() is not None for each in shown))
        ignored = torch.zeros(size, dtype=torch.bool)
        ignored[1, 1:] = True
        shown.append(weakref.ref(ignored))
        return ignored

    masked, expected = dataset.with_masks(map(mask, SIZES)), dataset.with_masks([mask(size) for size in SIZES])
    assert alive[:3] == [0, 1, 1], "the one before is held until the next is there"
    assert masked.runs is not None and expected.runs is not None and torch.equal(masked.runs, expected.runs)


def test_without_masks_the_same_pixels_are_drawn_as_ever() -> None:
    dataset, *_ = scattered()
    pixel = torch.randint(38, (20,), generator=generator("cpu", 3))
    assert torch.equal(dataset.with_masks([None] * 3).sample_pixels(20, generator("cpu", 3)), pixel)
    assert torch.equal(dataset.unmasked_pixels(pixel), pixel) and dataset.to("cpu").runs is None


def test_pixels_with_depth_are_sampled_as_often() -> None:
    dataset, *_ = scattered()
    assert (
        dataset.sparse_pixels is None
        and dataset.with_sparse_depths(torch.zeros(0).long(), torch.zeros(0)).sparse_pixels is None
    )
    known = dataset.with_sparse_depths(torch.tensor([3, 30, 3]), torch.tensor([1.5, 4.5, 3.5]))
    pixel, distance = known.sample_sparse_depths(3000, generator("cpu", 0))
    pairs, counts = torch.stack([pixel.float(), distance], 1).unique(dim=0, return_counts=True)
    assert pairs.tolist() == [[3, 1.5], [3, 3.5], [30, 4.5]]
    assert (counts - 1000).abs().max() < 100
    again, *_ = known.sample_sparse_depths(3000, generator("cpu", 0))
    assert torch.equal(pixel, again)
    assert torch.equal(known.sample_pixels(50, generator("cpu", 1)), dataset.sample_pixels(50, generator("cpu", 1)))


def test_viewing_distance_is_the_median_of_known_depths() -> None:
    dataset, *_ = scattered()
    assert dataset.viewing_distance is None
    known = dataset.with_sparse_depths(torch.tensor([30, 3, 37, 4, 23]), torch.tensor([4.5, 3.0, 5.0, 1.5, 3.25]))
    assert known.viewing_distance is not None
    assert known.viewing_distance.tolist() == [1.5, 3.25, 4.5], "the second view has none, and that of all"


@pytest.mark.parametrize("times", [1, 2, 3])
def test_depth_maps_of_other_sizes_are_read_where_pixels_are(times: int) -> None:
    """Each pixel has a distance of its own; maps with every pixel ``times``² times give the same."""
    dataset, *_ = scattered()
    own = [view + 1.5 + torch.arange(h * w).view(h, w) / (h * w) for view, (h, w) in enumerate(SIZES)]
    maps = [each.repeat_interleave(times, 0).repeat_interleave(times, 1) for each in own]
    pixel = torch.arange(38)
    _, view = dataset.rays(pixel)
    known = dataset.with_depth_maps(maps).to("cpu")
    assert torch.equal(known.depths(pixel, view), torch.cat([each.flatten() for each in own]))
    whole = dataset.with_depth_maps([torch.tensor([[2.5]]), torch.tensor([[1.5]]), torch.tensor([[0.0]])])
    nearer_than_near = torch.tensor([2.5] * 15 + [0.0] * 8 + [0.0] * 15)
    assert torch.equal(whole.depths(pixel, view), nearer_than_near)


def test_each_photo_needs_a_depth_map() -> None:
    dataset, *_ = scattered()
    with pytest.raises(ValueError, match="2 depth maps, and 3 photos"):
        dataset.with_depth_maps([torch.ones(2, 2)] * 2)


def test_distances_of_pixels_that_masks_ignore_are_forgotten() -> None:
    dataset, *_ = scattered()
    ignored = torch.zeros(SIZES[0], dtype=torch.bool)
    ignored[0] = True
    masked = dataset.with_masks([ignored, None, None])
    known = masked.with_sparse_depths(torch.tensor([3, 30]), torch.tensor([1.5, 4.5])).sparse_pixels
    assert known is not None and known.tolist() == [30]
    assert masked.with_sparse_depths(torch.tensor([3]), torch.tensor([1.5])).sparse_pixels is None


def test_distances_beyond_near_and_far_are_forgotten() -> None:
    dataset, *_ = scattered()
    rays, _ = dataset.rays(torch.tensor([3]))
    near, far = float(rays.near), float(rays.far)
    distance = torch.tensor([0.9 * near, near, 1.1 * near, 0.9 * far, far, 1.1 * far])
    known = dataset.with_sparse_depths(torch.full((6,), 3), distance).sparse_depths
    assert known is not None and known.tolist() == distance[2:4].tolist()


def test_distances_of_pixels_that_are_not_opaque_are_forgotten() -> None:
    dataset, *_ = scattered(channels=4)
    pixels = dataset.pixels.clone()
    pixels[3, 3], pixels[4, 3] = 255, 254
    known = (
        dataset._replace(pixels=pixels).with_sparse_depths(torch.tensor([3, 4]), torch.tensor([1.5, 2.5])).sparse_pixels
    )
    assert known is not None and known.tolist() == [3]


def test_distances_that_end_outside_of_a_cube_are_forgotten() -> None:
    dataset, *_ = scattered()
    rays = dataset.lookup(torch.tensor([3, 3])).rays
    distance = torch.tensor([1.5, 5.5])
    ends = (rays.origins + distance[:, None] * rays.directions).abs().amax(-1)
    known = dataset.with_sparse_depths(torch.tensor([3, 3]), distance)
    kept = known.with_sparse_depths_within(float(ends[0]) + 1e-3).sparse_depths
    assert kept is not None and kept.tolist() == [1.5]
    assert known.with_sparse_depths_within(float(ends[0]) - 1e-3).sparse_pixels is None
    assert dataset.with_sparse_depths_within(1.0) is dataset
