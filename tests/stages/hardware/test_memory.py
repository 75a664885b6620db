"""What may still be taken is the least of what machine, container and limits leave; work that needs more is refused."""

import resource
from pathlib import Path

import psutil
import pytest

from stages.contract import StageError
from stages.hardware import memory
from stages.hardware.memory import at_once, available_bytes, available_on, check_memory, rooms_in_groups
from stages.io.photos import Photo
from stages.sfm.colmap.database.extraction import (
    BYTES_PER_PIXEL,
    EVEN_BYTES_PER_PIXEL,
    ExtractionOptions,
    feature_bytes,
)


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch):
    """Sets how much there is."""
    return lambda count: monkeypatch.setattr(memory, "available_bytes", lambda: count)


def write_group(folder: Path, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_text(f"{content}\n")


def test_a_container_of_version_2(tmp_path: Path):
    write_group(tmp_path / "cgroup/a", memory__max=1000, memory__current=700, memory__stat="anon 1\ninactive_file 50")
    write_group(tmp_path / "cgroup/a/b", memory__max="max", memory__current=1, memory__stat="")
    (tmp_path / "self").write_text("0::/a/b\n")
    assert list(rooms_in_groups(tmp_path / "self", tmp_path / "cgroup")) == [350], "a group above the own one counts"


def test_a_version_1_container_sees_its_hosts_path(tmp_path: Path):
    files = {"memory__limit_in_bytes": 1000, "memory__usage_in_bytes": 900, "memory__stat": "total_inactive_file 300"}
    write_group(tmp_path / "cgroup/memory", **files)
    (tmp_path / "self").write_text("9:cpu,cpuacct:/x\n4:memory:/docker/0123\n0::/\n")
    assert list(rooms_in_groups(tmp_path / "self", tmp_path / "cgroup")) == [400]


def test_no_groups_no_limits(tmp_path: Path):
    assert list(rooms_in_groups(tmp_path / "none", tmp_path)) == []


def test_the_least_counts(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "rooms_in_groups", lambda *_: [5000])
    assert available_bytes() == 5000
    used = psutil.Process().memory_info().vms
    monkeypatch.setattr(
        resource, "getrlimit", lambda kind: (used + 1000, -1) if kind == resource.RLIMIT_AS else (-1, -1)
    )
    assert available_bytes() <= 1000
    monkeypatch.setattr(memory, "rooms_in_groups", lambda *_: [-20])
    assert available_bytes() == 0


@pytest.mark.parametrize("there, passes", [(99, False), (100, True)])
def test_just_enough_is_enough(free, there: int, passes: bool):
    free(there * 2**20)
    if passes:
        check_memory(100 * 2**20, "it", "it takes", "Less.")
        return
    with pytest.raises(StageError) as caught:
        check_memory(100 * 2**20, "it", "it takes", "Less.")
    assert caught.value.code == "hardware.not-enough-memory"
    assert "it takes 100 MB" in caught.value.why and "99 MB" in caught.value.why


@pytest.mark.parametrize("there, pieces", [(0, 1), (9, 1), (20, 2), (39, 3), (1000, 8)])
def test_pieces_at_once(free, there: int, pieces: int):
    free(there)
    assert at_once(8, 10.0) == pieces


@pytest.mark.parametrize("size, side, searched", [((2000, 1000), 1000, 1000 * 500), ((1000, 500), 1600, 2000 * 1000)])
def test_features_are_searched_on_reduced_or_doubled_photos(size: tuple[int, int], side: int, searched: int):
    assert (
        feature_bytes([Photo("a", "images/a.png", *size, 0, None, None, False, 1.0)], ExtractionOptions(side, 100))
        == BYTES_PER_PIXEL * searched
    )


def test_even_contrast_takes_memory_by_the_photos_own_size():
    photo = Photo("a", "images/a.png", 4000, 3000, 0, None, None, False, 1.0)
    faint = ExtractionOptions(1000, 100, even_contrast=True)
    assert feature_bytes([photo], faint) == EVEN_BYTES_PER_PIXEL * 12e6
    assert feature_bytes([photo], faint._replace(even_contrast=False)) == BYTES_PER_PIXEL * 750_000


def test_what_is_free_where_tensors_go(free, monkeypatch: pytest.MonkeyPatch):
    free(77)
    for name, value in {"mem_get_info": (100, 1000), "memory_reserved": 30, "memory_allocated": 10}.items():
        monkeypatch.setattr(f"torch.cuda.{name}", lambda value=value: value)
    assert (available_on("cpu"), available_on("cuda")) == (77, 120)
