import errno
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nerf.runtime import parallel
from stages import depth
from stages.contract import Inputs, Photos, StageResult, Workload, plan_stage
from stages.depth import Config, estimation, files, stereo_matching
from stages.depth.files import depth_map_file, read_depth_map
from stages.hardware import cluster
from tests.conftest import RecordedProgress
from tests.refusals import refused
from tests.stages.depth.walls import WallScene, cameras_before, wall

DOWNSCALE = 1.5
PROGRAM = """
import sys
from pathlib import Path
from stages import depth
from tests.conftest import RecordedProgress
inputs = {name: Path(sys.argv[1], name) for name in ("ingest", "normalise")}
depth.run(depth.Config(downscale=1.5), inputs, Path(sys.argv[2]), RecordedProgress())
"""


def a_scene(poses: np.ndarray | None = None) -> WallScene:
    walls = [wall((0, 1.0, 0), (3, 2), 10, seed=1), wall((0.1, -0.3, 0), (0.35, 0.3), -10, seed=2)]
    return WallScene(walls, cameras_before() if poses is None else poses)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Six photos, the last of which is a test photo."""
    return a_scene().write(tmp_path_factory.mktemp("walls"), test_every=6)


def result_of(
    inputs: Inputs, folder: Path, progress: RecordedProgress | None = None
) -> tuple[StageResult, dict[str, bytes]]:
    folder.mkdir(exist_ok=True)
    result = depth.run(Config(downscale=DOWNSCALE), inputs, folder, progress or RecordedProgress())
    return result, content(folder)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def undisturbed(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> tuple[StageResult, dict[str, bytes]]:
    return result_of(inputs, tmp_path_factory.mktemp("undisturbed"))


def test_it_writes_maps_of_training_photos_and_points(undisturbed) -> None:
    result, written = undisturbed
    maps = [f"depth/{index:03d}.png.depth" for index in range(5)]
    assert sorted(written) == sorted(["depth.json", "points.ply", *maps])
    facts = json.loads(written["depth.json"])
    assert facts.items() >= result.facts.items()
    assert facts["size"] == [160, 120]
    assert 0.6 < facts["coverage"] < 1
    assert 0 < facts["off_sparse"] < 0.005
    assert 2000 < facts["points"] < 5 * 160 * 120 * facts["coverage"] * 0.7, "each piece of surface once"
    assert list(facts["neighbours"]) == [f"{index:03d}.png" for index in range(5)]


def test_any_number_of_threads_gives_the_same_bytes(inputs, undisturbed, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(parallel, "_taken", 3)
    assert result_of(inputs, tmp_path)[1] == undisturbed[1]


def test_a_cluster_gives_the_same_bytes(inputs, undisturbed, tmp_path, ray_cluster) -> None:
    with cluster.joined(ray_cluster, [tmp_path]):
        assert result_of(inputs, tmp_path)[1] == undisturbed[1]


class Interrupted(RecordedProgress):
    """Ctrl-C once so many pairs are matched."""

    def __init__(self, pairs: int) -> None:
        super().__init__()
        self.pairs = pairs

    def update(self, message: str, done: float | None = None) -> None:
        if message.startswith(f"matched {self.pairs} "):
            raise KeyboardInterrupt


@pytest.mark.parametrize("pairs", [1, 4, 8])
def test_an_interrupted_stage_goes_on(pairs: int, inputs, undisturbed, tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt):
        result_of(inputs, tmp_path, Interrupted(pairs))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "depth").iterdir()}
    assert result_of(inputs, tmp_path)[1] == undisturbed[1]
    assert {path: path.stat().st_mtime_ns for path in before} == before, "what was there is kept"


def test_a_killed_stage_goes_on(inputs, undisturbed, tmp_path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(inputs["ingest"].parent), str(tmp_path)]
    with subprocess.Popen(command, cwd=Path(__file__).parents[3]) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("depth/*.depth")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
    assert not (tmp_path / "depth.json").exists(), "killed in the middle of it"
    assert result_of(inputs, tmp_path)[1] == undisturbed[1]


@pytest.mark.parametrize("last", ["-00001", ".depth", "points.ply"])
def test_a_full_disk_is_said_and_the_stage_goes_on(last: str, inputs, undisturbed, tmp_path, monkeypatch) -> None:
    with monkeypatch.context() as patched:
        for module in (estimation, files):
            written = module.write_durably

            def write(path: Path, data: bytes, written=written) -> None:
                if path.name.endswith(last):
                    path.with_name(path.name + ".tmp").write_bytes(data[: len(data) // 2])
                    raise OSError(errno.ENOSPC, "No space left on device", str(path))
                written(path, data)

            patched.setattr(module, "write_durably", write)
        with pytest.raises(OSError, match="No space left"):
            result_of(inputs, tmp_path)
    assert result_of(inputs, tmp_path)[1] == undisturbed[1]


def test_a_missing_photo_is_named(inputs, tmp_path) -> None:
    damaged = {name: tmp_path / name for name in inputs}
    for name, folder in inputs.items():
        shutil.copytree(folder, damaged[name])
    (damaged["ingest"] / "images/002.png").unlink()
    with pytest.raises(OSError, match=r"002\.png"):
        result_of(damaged, tmp_path / "out")


def test_a_pose_that_is_no_number_is_refused(inputs, tmp_path) -> None:
    damaged = {**inputs, "normalise": tmp_path / "normalise"}
    shutil.copytree(inputs["normalise"], damaged["normalise"])
    scene = json.loads((damaged["normalise"] / "scene.json").read_text())
    scene["views"][1]["scene_from_camera"][0][3] = float("nan")
    (damaged["normalise"] / "scene.json").write_text(json.dumps(scene))
    with refused("depth.pose-not-finite", "001.png"):
        result_of(damaged, tmp_path / "out")


def test_two_photos_cannot_agree(tmp_path) -> None:
    inputs = a_scene(cameras_before()[:2]).write(tmp_path)
    progress = RecordedProgress()
    with refused("depth.nothing-agrees"):
        result_of(inputs, tmp_path / "out", progress)
    assert progress.codes == ["depth.photos-alone"]


@pytest.mark.parametrize("count", [1, 4])
def test_photos_from_one_place_are_refused(count: int, tmp_path) -> None:
    poses = np.repeat(cameras_before()[:1], count, axis=0)
    inputs = a_scene(poses).write(tmp_path)
    assert plan_stage(depth.STAGE, Config(seconds=10), inputs, RecordedProgress()).downscale == 1
    with refused("depth.no-pairs", count):
        result_of(inputs, tmp_path / "out")


def test_photos_taken_while_walking_ahead_are_named(tmp_path) -> None:
    poses = np.repeat(cameras_before()[:1], 4, axis=0)
    poses[:, :, 3] += 0.1 * np.arange(4)[:, None] * poses[:, :, 2]
    with refused("depth.no-pairs", "along the line"):
        result_of(a_scene(poses).write(tmp_path), tmp_path / "out")


def test_imported_cameras_without_points_do(tmp_path) -> None:
    inputs = a_scene().write(tmp_path, with_tracks=False)
    result, _ = result_of(inputs, tmp_path / "out")
    assert result.facts["off_sparse"] is None
    assert 0.6 < result.facts["coverage"] < 1


def test_too_little_memory_is_said_beforehand(inputs, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(estimation, "BYTES_PER_PIXEL", 10**9)
    with refused("hardware.not-enough-memory", "--depth.downscale"):
        result_of(inputs, tmp_path)


def test_large_pairs_are_matched_in_little_memory(inputs, undisturbed, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(stereo_matching, "MAX_VOLUME_BYTES", 0)
    coverage = result_of(inputs, tmp_path)[0].facts["coverage"]
    assert coverage == pytest.approx(undisturbed[0].facts["coverage"], abs=0.1)
    assert coverage != undisturbed[0].facts["coverage"]


def test_a_short_time_makes_smaller_maps(inputs, tmp_path) -> None:
    sides = []
    for seconds in (1e-3, 1e3):
        planned = plan_stage(depth.STAGE, Config(seconds=seconds), inputs, RecordedProgress())
        assert planned.downscale is not None
        sides.append(240 / planned.downscale)
    assert sides == [pytest.approx(160, rel=0.01), 240]
    assert plan_stage(depth.STAGE, Config(), inputs, RecordedProgress()).downscale == 1


def test_more_photos_and_neighbours_are_expected_to_take_longer() -> None:
    def expected(photos: int, **options) -> float:
        return depth.expected_seconds(Config(**options), Workload(Photos(photos, 1.0), 2, {}, lambda *_: None))

    assert 0 < expected(20) < expected(40) < expected(40, neighbours=8)
    assert expected(20, seconds=3.0) == 3


def test_known_depth_shares_its_pixels_with_the_photo(undisturbed, tmp_path) -> None:
    path = depth_map_file(tmp_path, "images/000.png")
    path.parent.mkdir()
    path.write_bytes(undisturbed[1]["depth/000.png.depth"])
    found = read_depth_map(path)
    true = a_scene().distances(0, 160, 120)
    known = found.distance > 0
    assert np.median(np.abs(found.distance[known] / true[known] - 1)) < 0.004
