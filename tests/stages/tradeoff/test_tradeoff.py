import mmap
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch
from PIL import Image

from nerf.geometry.scene import Camera
from stages import tradeoff, train
from stages.contract import Stage, StageError, StageResult, run_stage
from stages.effects.decisions import Decisions, write_decisions
from stages.evaluate.tiles import MIN_TILES
from stages.io import stopwatch
from stages.io.files import read_json, read_scene, write_json
from stages.tradeoff import Config, benchmark, schedule, study
from stages.tradeoff.benchmark import score_workspace_field
from stages.tradeoff.schedule import FEWER_RAYS, PUBLISHED, VARIANTS, WORKSPACE_FIELD, Run, Speed
from stages.train.config import WHITE, FieldName
from stages.train.data import PhotoReader, view_rays
from stages.train.fields.hash_grid_options import HashGridOptions
from stages.train.fields.vanilla_options import VanillaOptions
from tests.conftest import RecordedProgress
from tests.refusals import refused
from tests.stages.photo_scene import photographed

TINY: dict[FieldName, dict[str, Any]] = {
    "grid": {"num_levels": 2, "log2_hashmap_size": 10, "max_res": 32, "target_samples": 1024},
    "vanilla": {"depth": 2, "width": 16, "samples_coarse": 8, "samples_fine": 8, "batch_rays": 64},
}
TINY_GRID = HashGridOptions(**TINY["grid"])
MIN_STEPS = 8  # of runs, instead of 30: they need only differ
SPEEDS: dict[str, Any] = dict.fromkeys(schedule.TIMED, (40.0, 1e7))
SPEEDS |= dict.fromkeys((PUBLISHED, FEWER_RAYS), (0.1, 10.0))
CONFIG: dict[str, Any] = {
    "seconds": 14.0,
    "seeds": 2,
    "space": "bounded",
    "downscale": 1.0,
    "sizes": (1.0,),
    "tiles": 3,
    "reading": (0.0, 0.0),
}


@pytest.fixture(scope="module", autouse=True)
def tiny_fields() -> Iterator[None]:
    """The variants as they are, in sizes that train in a blink; few of them, none left out for a busy machine."""
    with pytest.MonkeyPatch.context() as patch:
        for name, variant in VARIANTS.items():
            field = schedule.field_name(name)
            sizes = {field: {**variant.options.get(field, {}), **TINY[field]}}
            kept = {key: value for key, value in variant.options.items() if key != "preset"}
            least = MIN_STEPS if variant.min_steps == schedule.MIN_STEPS else variant.min_steps
            tiny = variant._replace(options=kept | sizes, grid_size=None, min_steps=least)
            patch.setitem(VARIANTS, name, tiny)
        patch.setattr(schedule, "WALL_TIME_RATIO", 1.0)
        patch.setattr(schedule, "OTHER_TIME", 0.6)
        patch.setattr(study, "MAX_LATE", 1e3)
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return photographed(tmp_path_factory.mktemp("photos"), channels=4)[0]


def studied(folder: Path, photos: dict[str, Path], progress: Any, **settings: Any):
    folder.mkdir(exist_ok=True)
    return tradeoff.run(Config.model_validate(CONFIG | {"speeds": SPEEDS} | settings), photos, folder, progress)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, photos: dict[str, Path]) -> tuple[Path, StageResult]:
    """A study that nobody disturbed, and its folder. Do not write into it."""
    folder = tmp_path_factory.mktemp("studied")
    return folder, studied(folder, photos, RecordedProgress())


class Killed(BaseException):
    """Stands for kill -9."""


def test_a_study_says_what_it_found(whole: tuple[Path, StageResult], photos: dict[str, Path]) -> None:
    folder, result = whole
    files = {*result.outputs, *result.records}
    assert {"quality.json", "ablation.png", "tradeoff.json", "tradeoff.md", "tradeoff.svg", "tradeoff.png"} == files
    assert all((folder / name).stat().st_size > 0 for name in files)
    content = read_json(folder / "tradeoff.json")
    assert {row["variant"] for row in content["points"]} >= {"grid", "vanilla, reduced", "no positional encoding"}
    assert any(row["seeds"] == 2 and row["psnr_std"] > 0 for row in content["points"])
    for row in content["points"]:
        assert 5 < row["psnr"] < 60 and row["train_seconds"] > 0 and row["frame_seconds"] > 0
        assert 0.001 < row["model_mb"] < 10 and 50 < row["peak_memory_mb"] < 100_000
    assert "vanilla, published at full resolution: 1 step (fewer than 300)" in content["left_out"]
    assert content["points"][content["recommended"] - 1]["pareto_front"]
    assert content["recommendation"] in (folder / "tradeoff.md").read_text()
    assert result.line.endswith(f"{content['recommendation']} Train it: {content['command']}")
    assert content["command"].startswith(f"pipeline train {photos['normalise'].parents[1].name} --train.seconds ")
    assert sum(row["fastest_to_render"] for row in content["points"] if row["pareto_front"]) == 1
    assert content["ablation"].startswith("Against the complete reduced method, seed by seed, of 2 seeds")
    text = (folder / "tradeoff.md").read_text()
    assert content["ablation"] in text and "renders fastest" in text
    assert f"Train it: `{content['command']}`" in text and f"Fields: {content['descriptions']}." in text
    assert "grid: 2 grids of features, the finest of 32³ cells; " in content["descriptions"]


def test_a_study_is_the_same_after_a_kill(
    tmp_path: Path,
    photos: dict[str, Path],
    progress: Any,
    monkeypatch: pytest.MonkeyPatch,
    whole: tuple[Path, StageResult],
) -> None:
    count, begun = len(read_json(whole[0] / "tradeoff.json")["runs"]), []
    score = benchmark.score

    def killed_at_the_fourth(field: Path, *rest: Any) -> dict[str, Any]:
        begun.append(field.name)
        if len(begun) == 4:
            raise Killed
        return score(field, *rest)

    monkeypatch.setattr(benchmark, "score", killed_at_the_fourth)
    with pytest.raises(Killed):
        studied(tmp_path / "killed", photos, progress)
    studied(tmp_path / "killed", photos, progress)
    assert len(begun) == count + 1, "each run once, and the killed one again"
    assert begun[3] == begun[4] and len(set(begun)) == count
    for name in ("quality.json", "ablation.png"):
        assert (tmp_path / "killed" / name).read_bytes() == (whole[0] / name).read_bytes()


def test_what_is_planned_is_what_is_run(tmp_path: Path, photos: dict[str, Path], progress: Any) -> None:
    planned = tradeoff.plan(Config(seconds=60.0), photos, progress)
    assert planned.speeds and set(planned.speeds) == set(schedule.TIMED)
    assert all(steps > 0 and rays > steps for steps, rays in planned.speeds.values())
    assert planned.sizes == (1.0, 1.0) and planned.downscale is None
    shares = {done for message, done in progress.updates if message.startswith("timing training ")}
    assert shares == {None}, "a share would be one of the plan, and the study begins at 0 after it"


@pytest.mark.parametrize("unbounded, space", [(False, "bounded"), (True, "contracted")])
def test_a_study_keeps_the_scenes_space(
    tmp_path: Path,
    photos: dict[str, Path],
    progress: Any,
    monkeypatch: pytest.MonkeyPatch,
    unbounded: bool,
    space: str,
) -> None:
    speeds = {name: Speed(*speed) for name, speed in SPEEDS.items()}
    monkeypatch.setattr(study, "measure_speeds", lambda *_: speeds)
    write_decisions(tmp_path, Decisions({"background": {}} if unbounded else {}))
    planned = tradeoff.plan(Config(seconds=60.0), photos | {"effects": tmp_path}, progress)
    assert {planned.space} == {run.space for run in study.schedule_of(planned).runs} == {space}
    assert planned.tiles and 2 * MIN_TILES <= planned.tiles <= 512
    assert planned.reading
    photos_take, windows_take = planned.reading
    assert 0 < photos_take < 5 and 0 < windows_take < 5
    assert Config.model_validate(planned.model_dump(mode="json")) == planned
    words = study.schedule_lines(study.schedule_of(planned), planned.seconds, tmp_path)
    shares = [int(line.rsplit(", ", 1)[1].split("%")[0]) for line in words if line.endswith("of the time")]
    assert 94 <= sum(shares) <= 106


@pytest.fixture
def now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that only trainings move, which take ``now[1]`` times as long as planned; the ``now[2]``-th is killed."""
    now = [100.0, 1.0, 0.0]

    def trained(run: Run, _exam: Any, _inputs: Any, folder: Path, _progress: Any) -> dict[str, Any]:
        found = benchmark.figures_file(run, folder)
        if found.exists():
            return read_json(found)
        folder.mkdir(exist_ok=True)
        now[2] -= 1
        if now[2] == 0:
            now[0] += 0.5 * CONFIG["seconds"]
            raise Killed
        now[0] += now[1] * run.seconds
        benchmark.write_strip(benchmark.strip_file(run, folder), [torch.zeros(8, 8, 3)])
        figures = {"failed": None, "restarts": 0, "psnr": 20.0, "ssim": 0.5, "train_seconds": 1.0}
        figures |= {"frame_seconds": 1.0, "peak_memory_mb": 100, "model_mb": 1.0}
        write_json(found, figures | {"wall_seconds": now[1] * run.seconds})
        return read_json(found)

    monkeypatch.setattr(study, "train_and_score", trained)
    monkeypatch.setattr(stopwatch, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(study, "MAX_LATE", 0.1)
    monkeypatch.setattr(schedule, "OTHER_TIME", 0.0)
    return now


def test_a_slow_machine_leaves_arms_out_and_names_them(
    tmp_path: Path, photos: dict[str, Path], progress: Any, now: list[float]
) -> None:
    now[1] = 3.0
    studied(tmp_path, photos, progress)
    assert 0.5 * CONFIG["seconds"] < now[0] - 100 <= 1.1 * CONFIG["seconds"]
    content = read_json(tmp_path / "tradeoff.json")
    planned = study.schedule_of(Config.model_validate(CONFIG | {"speeds": SPEEDS}))
    assert len(content["left_out"]) > len(schedule.list_runs(planned.left_out))
    late = [run for run in planned.runs if run.label not in str(progress.said("tradeoff.result"))]
    seeds = sum(run.seed > 0 for run in (*planned.left_out, *late))
    assert [words for words in content["left_out"] if "seeds" in words] == [f"{seeds} runs with further seeds"]
    assert progress.names("tradeoff.not-trained", "3.0 × the time expected")


def test_what_a_killed_attempt_took_is_time_of_the_study(
    tmp_path: Path, photos: dict[str, Path], progress: Any, now: list[float]
) -> None:
    now[2] = 4
    with pytest.raises(Killed):
        studied(tmp_path, photos, progress)
    studied(tmp_path, photos, progress)
    assert 0.9 * CONFIG["seconds"] < now[0] - 100 <= 1.1 * CONFIG["seconds"]
    first, again = (note for note in progress.said("tradeoff.schedule") if "until" in note)
    assert " runs: about " in first and " runs, 3 of them done: about " in again
    assert progress.names("tradeoff.not-trained", "no time"), "the kill took the time"


def test_a_study_out_of_time_still_has_a_result(
    tmp_path: Path, photos: dict[str, Path], progress: Any, now: list[float]
) -> None:
    for _ in range(3):
        now[2] = 1
        with pytest.raises(Killed):
            studied(tmp_path, photos, progress)
    studied(tmp_path, photos, progress)
    assert len(read_json(tmp_path / "tradeoff.json")["runs"]) == 1


def test_the_workspaces_field_is_a_point_without_output(
    tmp_path: Path, photos: dict[str, Path], progress: Any, whole: tuple[Path, StageResult]
) -> None:
    own = tmp_path / "train" / "0123456789abcdef"
    own.mkdir(parents=True)
    facts = run_stage(train.STAGE, train.Config(steps=20, downscale=1.0, grid=TINY_GRID), photos, own, progress).facts
    write_json(own / "manifest.json", {"facts": facts})
    with_own = studied(tmp_path / "own", photos | {"train": own}, studying := RecordedProgress())
    shares = [done for _, done in studying.updates if done is not None]
    assert len(shares) > 10 and shares == sorted(shares), "the score of that field goes on from the last run"
    folder, without = whole
    assert with_own.outputs == without.outputs
    for name in with_own.outputs:
        assert (tmp_path / "own" / name).read_bytes() == (folder / name).read_bytes()
    points = {row["variant"]: row for row in read_json(tmp_path / "own" / "tradeoff.json")["points"]}
    assert (points[WORKSPACE_FIELD]["train_seconds"], points[WORKSPACE_FIELD]["steps"]) == (facts["train_seconds"], 20)
    assert 5 < points[WORKSPACE_FIELD]["psnr"] < 60 and points[WORKSPACE_FIELD]["peak_memory_mb"] is None
    assert read_json(tmp_path / "own" / "tradeoff.json")["workspace_field"]["train"] == own.name
    assert WORKSPACE_FIELD not in {row["variant"] for row in read_json(folder / "tradeoff.json")["points"]}
    text = (tmp_path / "own" / "tradeoff.md").read_text()
    assert "This workspace's field (" in text and "this workspace's field ★ |" in text


def test_the_workspaces_slow_field_is_scored_on_some_pixels(
    tmp_path: Path, photos: dict[str, Path], progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, kind = tmp_path / "train" / "0123456789abcdef", VanillaOptions(**TINY["vanilla"])
    own.mkdir(parents=True)
    facts = run_stage(train.STAGE, train.Config(steps=20, downscale=1.0, vanilla=kind), photos, own, progress).facts
    write_json(own / "manifest.json", {"facts": facts})
    crops = benchmark.make_benchmark(photos["ingest"], read_scene(photos["normalise"]), 1.0, 4, 1.0)
    assert 0 < benchmark.rendering_seconds(own, crops) < 10
    for seconds, stride in ((1e3, 1), (1e-6, 4)):
        folder = tmp_path / str(stride)
        folder.mkdir()
        found = score_workspace_field(crops, photos | {"train": own}, folder, seconds, progress)
        assert found and (found.stride, found.key) == (stride, "0123456789abcdef")
        assert (found.figures["ssim"] is None) == (stride > 1) and found.facts["field"] == "vanilla"
        assert score_workspace_field(crops, photos | {"train": own}, folder, 1e3, progress) == found, (
            "as an earlier attempt found"
        )
    monkeypatch.setattr(benchmark, "scoring_stride", lambda *_: 4)
    studied(tmp_path / "study", photos | {"train": own}, progress, seeds=1, seconds=8.0)
    scored = read_json(tmp_path / "study" / "tradeoff.json")["scored"]
    assert "; this workspace's field: one in 4 of their rows and columns, to save time" in scored


def test_a_slow_field_is_scored_on_the_same_crops(tmp_path: Path, photos: dict[str, Path], progress: Any) -> None:
    scene = read_scene(photos["normalise"])
    run_stage(train.STAGE, train.Config(steps=20, downscale=1.0, grid=TINY_GRID), photos, tmp_path, progress)
    crops = benchmark.make_benchmark(photos["ingest"], scene, 1.0, 4, 1.0)
    whole, thinned = (benchmark.score(tmp_path, crops, progress, stride) for stride in (1, 4))
    assert whole["ssim"] is not None and thinned["ssim"] is None
    assert 0 < abs(whole["psnr"] - thinned["psnr"]) < 2


def test_fields_are_scored_over_the_photos_background(tmp_path: Path, photos: dict[str, Path], progress: Any) -> None:
    white, black = tmp_path / "white", tmp_path / "black"
    white.mkdir()
    run_stage(train.STAGE, train.Config(steps=20, downscale=1.0, grid=TINY_GRID), photos, white, progress)
    shutil.copytree(white, black)
    field = read_json(white / "field.json")
    write_json(black / "field.json", field | {"background": [0.0, 0.0, 0.0]})
    crops = benchmark.make_benchmark(photos["ingest"], read_scene(photos["normalise"]), 1.0, 4, 1.0)
    assert list(crops.background) == field["background"] == [1.0, 1.0, 1.0]
    scores = [benchmark.score(folder, crops, progress)["psnr"] for folder in (white, black)]
    assert scores[0] == scores[1]


def test_a_run_that_does_not_learn_is_told(
    tmp_path: Path, photos: dict[str, Path], progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run_stage

    def diverges(stage: Stage, config: train.Config, *rest: Any) -> Any:
        if not config.vanilla.positional_encoding:
            raise StageError("train.diverged", "training diverged", "it was told to", "Do not tell it to.")
        return whole(stage, config, *rest)

    monkeypatch.setattr(benchmark, "run_stage", diverges)
    result = studied(tmp_path, photos, progress, seeds=1)
    content = read_json(tmp_path / "tradeoff.json")
    named = content["left_out"][-1]
    assert named.startswith("no positional encoding, full resolution, ") and " steps, seed 0 (training" in named
    assert named in (tmp_path / "tradeoff.md").read_text()
    assert f" 1 of {len(content['runs'])} runs without a result · " in result.line
    assert "no positional encoding" not in {row["variant"] for row in content["points"]}
    assert [a["failed"] for a in content["runs"] if a["failed"]] == ["training diverged: it was told to"]
    assert progress.names("tradeoff.result", "training diverged: it was told to")


def test_lack_of_memory_ends_and_resumes_the_study(
    tmp_path: Path, photos: dict[str, Path], progress: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, asked = run_stage, list[int]()

    def short_of_memory(stage: Stage, config: train.Config, *rest: Any) -> Any:
        asked.append(config.steps or 0)
        if len(asked) == 2:
            raise StageError(
                "hardware.not-enough-memory",
                "not enough memory for the field",
                "5 grids take 1 TB and 8 GB are free",
                "Smaller ones.",
            )
        return whole(stage, config, *rest)

    monkeypatch.setattr(benchmark, "run_stage", short_of_memory)
    small = {"seconds": 8.0, "seeds": 1}
    with refused("tradeoff.stopped", "grid, full resolution", "seed 0", "not enough memory"):
        studied(tmp_path, photos, progress, **small)
    studied(tmp_path, photos, progress, **small)
    assert asked[2] == asked[1], "the first one is not trained again, the second one is"
    assert not any(run["failed"] for run in read_json(tmp_path / "tradeoff.json")["runs"])


def test_a_runs_own_fault_is_what_training_says() -> None:
    said = "".join((Path(train.__file__).parent / f"{name}.py").read_text() for name in ("loop", "data"))
    assert all(f'"{what}"' in said for what in benchmark.RUN_FAILURES)


def test_without_held_out_photos_there_is_no_study(tmp_path: Path, photos: dict[str, Path], progress: Any) -> None:
    inputs = {name: tmp_path / name for name in photos}
    for name, folder in photos.items():
        shutil.copytree(folder, inputs[name])
    scene = (inputs["normalise"] / "scene.json").read_text()
    (inputs["normalise"] / "scene.json").write_text(scene.replace('"test"', '"train"'))
    with refused("tradeoff.no-test-photos"):
        tradeoff.plan(Config(), inputs, progress)


def test_too_little_time_is_said_with_what_suffices(tmp_path: Path, photos: dict[str, Path], progress: Any) -> None:
    """Also where the workspace has a field of its own, which alone is no study."""
    shutil.copytree(photos["effects"], trained := tmp_path / "train" / "key")
    with refused("tradeoff.too-little-time", "2 s", "--budget 10s"):
        studied(tmp_path / "study", photos | {"train": trained}, progress, seconds=2.0)
    planned = Config.model_validate(CONFIG | {"speeds": SPEEDS, "seconds": 10.0})
    assert len({run.steps for run in study.schedule_of(planned).runs}) >= 2


def test_too_little_time_is_said_before_a_plan_is_kept(photos: dict[str, Path], progress: Any) -> None:
    with refused("tradeoff.too-little-time", "0.1 s"):
        tradeoff.plan(Config(seconds=0.1), photos, progress)


def test_tiles_are_parts_of_all_test_photos(photos: dict[str, Path]) -> None:
    scene = read_scene(photos["normalise"])
    made = benchmark.make_benchmark(photos["ingest"], scene, None, 5, 2.0)
    assert made.size == (24, 16) and [photo.truth.shape for photo in made.photos] == [(8, 12, 3)] * 2
    assert [crop.photo for crop in made.crops] == [view.name for view in scene.of_split("test")]
    for crop, view in zip(made.crops, scene.of_split("test"), strict=True):
        truth, rays = PhotoReader(photos["ingest"], scene, 1.0).pixels(view, WHITE), view_rays(scene, view, 1.0)
        for number, left in enumerate((0, 8)):  # two tiles of 16 × 16 cover 24 × 16
            rows, columns = slice(16 * number, 16 * number + 16), slice(left, left + 16)
            assert torch.equal(crop.truth[rows], truth[:, columns])
            assert torch.equal(crop.rays.directions[rows], rays.directions[:, columns])


def test_large_photos_among_small_ones_are_drawn_small_and_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "SMALL_SIDE", 12)
    inputs, scene = photographed(tmp_path)
    large = Camera("PINHOLE", 240, 120, (200.0, 200.0, 120.0, 60.0))
    Image.new("RGB", (240, 120), "red").save(inputs["ingest"] / scene.views[4].file)
    views = (*scene.views[:4], replace(scene.views[4], camera=1), *scene.views[5:])
    scene = replace(scene, cameras=(*scene.cameras, large), views=views)
    crops = benchmark.make_benchmark(inputs["ingest"], scene, 1.0, 2, 2.0)
    assert [photo.truth.shape for photo in crops.photos] == [(8, 12, 3), (6, 12, 3)]
    benchmark.write_strip(tmp_path / "strip.png", [photo.truth for photo in crops.photos])
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.size == (9 + 12, 6), "nothing is cut off"
        assert strip.getpixel((20, 5)) == (255, 0, 0) and strip.getpixel((0, 5)) == (255, 255, 255)


@pytest.mark.skipif(torch.cuda.is_available(), reason="where there is a GPU, its memory is told")
def test_memory_is_looked_at_while_the_block_runs() -> None:
    with benchmark.peak_memory() as peak:
        before = psutil.Process().memory_info().rss  # here, for what other tests have left may go at any time
        with mmap.mmap(-1, 100_000_000) as block:  # new pages, whatever allocators have in reserve
            block.write(b"1" * len(block))
            until = time.monotonic() + 10
            while peak() - before < 50e6 and time.monotonic() < until:  # where other programs want the cores, too
                time.sleep(0.05)
    assert 50e6 < peak() - before < 400e6
