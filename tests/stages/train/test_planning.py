import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf.fields.hash_grid import HashGridSettings
from nerf.geometry.scene import BACKDROP_TOLERANCE, Camera, Scene
from stages.contract import Progress
from stages.effects.decisions import Decisions, Space
from stages.train import Config
from stages.train.data import (
    MIN_LONG_SIDE,
    backdrop_tolerance,
    field_background,
    has_background_model,
    scaled_size,
    training_background,
)
from stages.train.fields.field_list import with_defaults
from stages.train.fields.hash_grid import (
    BACKDROP_DISTORTION,
    DISTORTION,
    LARGE_STEP_LEARNING_RATE,
    MAX_STEP_SAMPLES,
    MICRO_BATCH_SAMPLES,
    _trainer_settings,
    field_settings,
    memory_bytes,
    with_sizes,
)
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from stages.train.planning import MAX_PHOTOS, MAX_PIXELS, chosen_downscale, rays_in_budget, rays_per_second, reason
from tests.stages.photo_scene import photographed


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return photographed(tmp_path_factory.mktemp("photos"))[1]  # six training photos


def of_size(scene: Scene, width: int, height: int) -> Scene:
    return replace(scene, cameras=(Camera("PINHOLE", width, height, (1.0, 1.0, 0.0, 0.0)),))


def test_the_budget_draws_each_pixel_about_once(scene: Scene) -> None:
    large = of_size(scene, 2000, 1000)
    downscale = chosen_downscale(large, 3_000_000)
    assert downscale == 2.0
    width, height = scaled_size(large.cameras[0], downscale)
    assert 6 * width * height == 3_000_000


@given(st.integers(30, 6000), st.integers(30, 6000), st.floats(1.0, 1e10))
def test_photos_are_never_enlarged_nor_made_tiny(scene: Scene, width: int, height: int, rays: float) -> None:
    sized = of_size(scene, width, height)
    downscale = chosen_downscale(sized, rays)
    assert downscale >= 1
    long_side = max(scaled_size(sized.cameras[0], downscale))
    assert long_side >= min(MIN_LONG_SIDE, max(width, height))


@given(st.floats(1.0, 1e9), st.floats(1.0, 100.0))
def test_more_rays_never_mean_smaller_photos(scene: Scene, rays: float, factor: float) -> None:
    sized = of_size(scene, 3000, 2000)
    assert chosen_downscale(sized, rays * factor) <= chosen_downscale(sized, rays)


def test_one_small_photo_does_not_decide_for_all(scene: Scene) -> None:
    train = scene.of_split("train")[0]
    views = (replace(train, camera=1), *(replace(train, name=str(i)) for i in range(9)))
    mixed = replace(of_size(scene, 3000, 2000), views=views)
    mixed = replace(mixed, cameras=(*mixed.cameras, Camera("PINHOLE", 160, 120, (1.0, 1.0, 0.0, 0.0))))
    assert chosen_downscale(mixed, 1e6) == math.floor(10 * math.sqrt(9 * 6 + 0.0192)) / 10


def test_what_masks_ignore_is_not_drawn_and_takes_no_pixels(scene: Scene) -> None:
    large = of_size(scene, 2000, 1000)
    used = {view.name: 0.25 for view in large.views}
    assert chosen_downscale(large, 3_000_000, used) == 1.0 == chosen_downscale(large, 12_000_000)


def test_redundant_photos_are_not_reduced_endlessly(scene: Scene) -> None:
    train = scene.of_split("train")[0]
    few, many = (
        replace(of_size(scene, 2000, 1000), views=tuple(replace(train, name=str(i)) for i in range(count)))
        for count in (MAX_PHOTOS, 10 * MAX_PHOTOS)
    )
    assert chosen_downscale(few, 6e6) == chosen_downscale(many, 6e6) == 4.0
    assert chosen_downscale(many, 90e6) == math.floor(10 * math.sqrt(480 * 2e6 / MAX_PIXELS)) / 10 > 1
    assert chosen_downscale(many, 960e6) == 1.0


GRID = Config(
    steps=100,
    space="bounded",
    view_dependence=True,
    learning_rate=1e-2,
    background="random",
    grid=HashGridOptions(backend="warp", micro_batches=1, target_samples=4096),
)
VANILLA = Config(
    seconds=10.0,
    space="bounded",
    view_dependence=True,
    learning_rate=5e-3,
    vanilla=VanillaOptions(depth=1, width=8, skip=1, samples_coarse=2, samples_fine=2, spacing="linear", batch_rays=64),
)


def with_grid(config: Config, **options: Any) -> Config:
    """``config`` with these options of the hash-grid field."""
    return config.model_copy(update={"grid": config.grid.model_copy(update=options)})


@pytest.mark.parametrize("config", [GRID, VANILLA], ids=["grid", "vanilla"])
def test_the_speed_is_measured_on_this_machine(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.train.planning.TIMED_SECONDS", 0.05)
    _, scene = photographed(tmp_path, channels=4)
    assert 10 < rays_per_second(config, scene, Decisions()) < 1e7


def test_a_budget_of_steps_is_counted_not_timed(scene: Scene) -> None:
    assert rays_in_budget(VANILLA.model_copy(update={"steps": 5, "seconds": None}), scene, Decisions()) == 5 * 64
    spaces = [GRID.model_copy(update={"space": space}) for space in ("bounded", "contracted")]
    in_box, contracted = (rays_in_budget(config, scene, Decisions()) for config in spaces)
    assert 100 * 4096 / 100 < contracted < in_box < 100 * 4096


def sizes_of(config: Config, scene: Scene, rays: float, progress: Progress | None = None) -> dict[str, int]:
    """What is chosen where ``config`` leaves sizes open."""
    return sizes_in(with_sizes(config, scene, rays, progress).grid)


def sizes_in(grid: HashGridOptions) -> dict[str, int]:
    return grid.model_dump(include={"num_levels", "log2_hashmap_size", "max_res"})


@given(st.floats(1e3, 1e9), st.floats(1, 100), st.floats(1, 20), st.booleans())
def test_grids_grow_with_rays_and_pixels(
    scene: Scene, rays: float, factor: float, down: float, contracted: bool
) -> None:
    sized, config = (
        of_size(scene, 3000, 2000),
        GRID.model_copy(update={"space": "contracted" if contracted else "bounded"}),
    )

    def chosen(rays: float, downscale: float) -> dict[str, int]:
        return sizes_of(config.model_copy(update={"downscale": downscale}), sized, rays)

    small, more_rays, fewer_pixels = chosen(rays, down), chosen(rays * factor, down), chosen(rays, down * factor)
    assert all(more_rays[name] >= small[name] >= fewer_pixels[name] for name in small)
    field = field_settings(with_grid(config, **small), background_model=False)
    assert isinstance(field, HashGridSettings)
    assert 128 <= field.max_res <= (2048 if contracted else 1024)
    # Two neighbouring samples lie in the same or in neighbouring cells of the finest grid, near the cameras at least.
    cells_per_step = field.stepping.step_size * field.max_res / (4 if contracted else 1.8)
    in_contracted_space = 1 / 3 if field.max_res <= 512 else 2 / 3
    assert cells_per_step == pytest.approx(
        in_contracted_space if contracted else max(1, math.sqrt(3) * field.max_res / max(576, field.max_res)), rel=0.01
    )


@pytest.mark.parametrize(("contracted", "most"), [(True, 2048), (False, 1024)])
def test_a_gpu_has_larger_fields_and_takes_larger_steps(
    scene: Scene, contracted: bool, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = HashGridOptions(micro_batches=2)
    config = Config(grid=grid, space="contracted" if contracted else "bounded", view_dependence=True, downscale=1.0)
    large = of_size(scene, 4000, 3000)
    on_cpu = sizes_of(with_defaults(config), large, 1e9), with_defaults(config)
    monkeypatch.setattr("stages.train.fields.hash_grid.compute_device", lambda: "cuda")
    monkeypatch.setattr("stages.train.fields.hash_grid.available_on", {"cuda": 80e9}.get)
    on_gpu = sizes_of(with_defaults(config), large, 1e9), with_defaults(config)
    assert on_gpu[0] == {"num_levels": 8, "log2_hashmap_size": 20, "max_res": most}
    assert on_gpu[0]["log2_hashmap_size"] > on_cpu[0]["log2_hashmap_size"]
    assert on_gpu[0]["max_res"] >= on_cpu[0]["max_res"]
    assert sizes_of(with_defaults(config), large, 1e6) == {
        "num_levels": 5 if contracted else 4,
        "log2_hashmap_size": 17,
        "max_res": 512 // (2 - contracted),
    }
    assert (on_gpu[1].grid.target_samples, on_gpu[1].learning_rate) == (1 << 18, 2e-2)
    assert (on_cpu[1].grid.target_samples or 0) < 1 << 16
    few = with_defaults(with_grid(config, target_samples=1 << 14))
    assert few.learning_rate == (1e-2 if contracted else 2e-2)


@pytest.mark.parametrize("contracted", [True, False])
def test_every_core_has_an_equal_part(contracted: bool) -> None:
    parts = [
        with_defaults(with_grid(Config(space="contracted" if contracted else "bounded"), micro_batches=count))
        for count in (1, 2, 64)
    ]
    sizes = [part.grid.target_samples or 0 for part in parts]
    assert sizes == [MICRO_BATCH_SAMPLES["contracted" if contracted else "bounded"], 2 * sizes[0], MAX_STEP_SAMPLES]
    assert parts[2].learning_rate == LARGE_STEP_LEARNING_RATE >= (parts[1].learning_rate or 1)


def test_samples_follow_occupied_cells() -> None:
    contracted = Config(
        space="contracted", view_dependence=True, grid=HashGridOptions(num_levels=1, log2_hashmap_size=8)
    )
    sizes = (with_grid(contracted, max_res=max_res) for max_res in (256, 512, 700, 1024, 2048, 4096))
    fields = [field_settings(config, background_model=False) for config in sizes]
    steps = [field.min_step_size for field in fields]
    assert steps == [4 / 768, 4 / 1536, 4 / 1536, 4 / 1536, 4 / 3072, 4 / 3072]
    assert all(field.cone_angle == field.min_step_size / 0.25 for field in fields)


@pytest.mark.parametrize("space", ["bounded", "contracted", "ndc"])
@given(factor=st.floats(0.25, 4.0))
def test_ray_samples_multiply_the_samples_along_a_ray(space: Space, factor: float) -> None:
    config = with_grid(GRID, num_levels=4, log2_hashmap_size=16, max_res=512)
    config = config.model_copy(update={"space": space})
    usual = field_settings(config, background_model=False)
    asked = field_settings(with_grid(config, ray_samples=factor), background_model=False)
    assert asked.diagonal_steps == pytest.approx(factor * usual.diagonal_steps, abs=0.5)
    assert asked.cone_angle == pytest.approx(usual.cone_angle / factor)
    rounding = 0.5 / min(asked.diagonal_steps, usual.diagonal_steps)
    assert asked.stepping.step_size == pytest.approx(usual.stepping.step_size / factor, rel=2 * rounding)
    reach = [each.max_samples_per_ray * each.stepping.step_size for each in (usual, asked)]
    assert reach[1] > (1 - 2 * rounding) * reach[0]


@pytest.mark.parametrize("has_alpha", [False, True])
@pytest.mark.parametrize("space", ["bounded", "contracted", "ndc"])
def test_unbounded_space_without_alpha_has_a_background(scene: Scene, space: Space, has_alpha: bool) -> None:
    config = GRID.model_copy(update={"space": space})
    assert has_background_model(config, replace(scene, has_alpha=has_alpha)) is (space != "bounded" and not has_alpha)


@pytest.mark.parametrize("field", [GRID, VANILLA])
def test_an_empty_field_shows_the_backdrop(scene: Scene, field: Config) -> None:
    before = replace(scene, has_alpha=False, backdrop=(1.0, 0.5, 0.0))
    assert field_background(field, before) == training_background(field, before) == (1.0, 0.5, 0.0)
    assert field_background(field, replace(before, backdrop=None)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("field", [GRID, VANILLA])
def test_a_backdrop_that_is_modelled_tells_nothing_of_opacity(scene: Scene, field: Config) -> None:
    before = replace(scene, has_alpha=False, backdrop=(1.0, 0.5, 0.0))
    tolerances = [
        backdrop_tolerance(field.model_copy(update={"space": space}), before) for space in ("bounded", "contracted")
    ]
    assert tolerances == [BACKDROP_TOLERANCE / 255, 0]
    assert backdrop_tolerance(field, replace(before, backdrop=None)) == 0


def test_matter_is_compact_except_where_alpha_shows_it(scene: Scene) -> None:
    before = replace(scene, has_alpha=False, backdrop=(1.0, 0.5, 0.0))
    cases = {"backdrop": (before, "bounded"), "alpha": (scene, "bounded"), "modelled": (before, "contracted")}
    weights = {
        name: _trainer_settings(with_defaults(GRID.model_copy(update={"space": space})), photos, 0).distortion_weight
        for name, (photos, space) in cases.items()
    }
    assert weights == {"backdrop": BACKDROP_DISTORTION, "alpha": 0, "modelled": DISTORTION["contracted"]}


def test_the_reason_for_sizes_is_the_budget() -> None:
    assert reason(GRID, 1e6).startswith("100 steps render about 1.0 M rays and evaluate 3.0 M colours")
    assert reason(VANILLA, 950).startswith("10 s on this machine render about 950 rays")


CONTRACTED = GRID.model_copy(update={"space": "contracted", "downscale": 1.0})
LARGEST, MIDDLE, SMALLEST = (
    {"num_levels": levels, "log2_hashmap_size": log2_size, "max_res": max_res}
    for levels, log2_size, max_res in ((8, 19, 2048), (6, 18, 1024), (5, 17, 512))
)
NEEDED = memory_bytes(with_grid(CONTRACTED, **LARGEST))


@pytest.mark.parametrize(
    "free, own, chosen",
    [
        (2 * NEEDED, {}, LARGEST),
        (2 * NEEDED - 1, {}, MIDDLE),
        (0.0, {}, SMALLEST),
        (2 * NEEDED, {"log2_hashmap_size": 20}, SMALLEST),
    ],
)
def test_grids_take_half_of_the_free_memory_at_most(
    scene: Scene, free: float, own: dict[str, int], chosen: dict[str, int], monkeypatch: pytest.MonkeyPatch, progress
) -> None:
    monkeypatch.setattr("stages.train.fields.hash_grid.available_on", {"cpu": free}.get)
    config = with_grid(CONTRACTED, **own)
    assert sizes_of(config, of_size(scene, 4000, 3000), 1e9, progress) == chosen | own
    assert progress.codes == ["train.memory-limits-grids"] * (chosen is not LARGEST)
    got = f"{chosen['num_levels']} grids of up to 2^{chosen['log2_hashmap_size']} rows"
    assert progress.names("train.memory-limits-grids", got, "8 grids of up to 2^19 rows") == (chosen is not LARGEST)


@pytest.mark.parametrize(
    "device, free, has_alpha, downscale",
    [
        ("cuda", 72e6, False, 1.0),
        ("cuda", 71e6, False, 1.1),
        ("cuda", 18e6, False, 2.0),
        ("cuda", 18e6, True, 2.4),
        ("cpu", 18e6, False, 1.0),
    ],
)
def test_pixels_take_half_of_a_gpus_memory(
    scene: Scene, device: str, free: float, has_alpha: bool, downscale: float, monkeypatch: pytest.MonkeyPatch, progress
) -> None:
    monkeypatch.setattr("stages.train.planning.compute_device", lambda: device)
    monkeypatch.setattr("stages.train.planning.available_on", {"cuda": free}.get)
    large = replace(of_size(scene, 2000, 1000), has_alpha=has_alpha)  # six photos, 36 MB without alpha
    assert chosen_downscale(large, 12e6, progress=progress) == downscale
    assert progress.codes == ["train.memory-limits-photos"] * (downscale > 1)
    assert progress.names("train.memory-limits-photos", f"photos at 1/{downscale:g}", "at 1/1") == (downscale > 1)
