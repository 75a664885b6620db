"""Cache keys: equal for equal content, different for any difference, blind to place and time."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.cache_keys import ContentIndex, canonical_json, config_for_key, digest, stage_key
from stages.contract import StageConfig
from tests.refusals import refused

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), json_values))
def test_the_order_of_keys_does_not_matter(value: dict):
    assert digest(value) == digest(dict(reversed(list(value.items()))))


@given(json_values, json_values)
def test_different_values_have_different_digests(a: object, b: object):
    assert (digest(a) == digest(b)) == (canonical_json(a) == canonical_json(b))


def test_not_a_number_has_no_key():
    with pytest.raises(ValueError, match="Out of range float"):
        digest({"x": float("nan")})


def test_every_part_enters_the_key():
    base = ("train", 1, {"steps": 3}, {"ingest": "aa"})
    changed = [
        ("sfm", *base[1:]),
        ("train", 2, *base[2:]),
        (*base[:2], {"steps": 4}, base[3]),
        (*base[:3], {"ingest": "b"}),
    ]
    keys = {stage_key(*parts) for parts in [base, *changed]}
    assert len(keys) == 5


def test_the_index_notices_changes_and_survives_damage(tmp_path: Path):
    file, cache = tmp_path / "a", tmp_path / "cache.json"
    file.write_text("one")
    index = ContentIndex(cache)
    first = index.sha256(file)
    index.save()
    assert ContentIndex(cache).known[str(file.resolve())][-1] == first
    file.write_text("two")
    os.utime(file, ns=(1, 1))
    assert ContentIndex(cache).sha256(file) != first
    cache.write_text("{torn")
    assert ContentIndex(cache).sha256(file) != first


def test_paths_enter_by_content(tmp_path: Path):
    class Config(StageConfig):
        cameras: Path | None = None
        steps: int = 1

    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "b.json").write_text("{}")
    index = ContentIndex(tmp_path / "cache.json")
    a = config_for_key(Config(cameras=tmp_path / "a.json"), index, {}, ())
    assert a == config_for_key(Config(cameras=tmp_path / "b.json"), index, {}, ())
    assert a["cameras"] not in (None, str(tmp_path / "a.json"))
    with refused("pipeline.no-such-file"):
        config_for_key(Config(cameras=tmp_path / "c.json"), index, {}, ())


@pytest.mark.parametrize(
    ("read", "beside"),
    [
        (("transforms_train.json", "transforms_test.json"), ("transforms.json", "cameras.bin", "train/r_0.png")),
        (("transforms_train.json", "transforms_val.json"), ("cameras.bin",)),
        (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "rigs.bin", "points3D.ply", ".DS_Store")),
        (("cameras.txt", "images.txt", "points3D.txt"), ("project.ini",)),
    ],
)
def test_of_a_folder_the_cameras_count_that_are_read(tmp_path: Path, read: tuple[str, ...], beside: tuple[str, ...]):
    folder = tmp_path / "cameras"
    (folder / "train").mkdir(parents=True)
    for name in read:
        (folder / name).write_text("1")
    index = ContentIndex(tmp_path / "cache.json")
    before = index.of_path(folder)
    for name in beside:
        (folder / name).write_text("2")
    (folder / "itself").symlink_to(folder)
    (folder / "again").symlink_to(folder)
    assert index.of_path(folder) == before
    assert {Path(known).name for known in index.known} == set(read)
    for name in read:
        (folder / name).write_text("3")
        before, changed = index.of_path(folder), before
        assert before != changed


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file that nobody can read")
def test_a_file_that_cannot_be_read_is_refused_in_words(tmp_path: Path):
    (tmp_path / "a.jpg").symlink_to("/proc/self/mem")
    with refused("ingest.cannot-read", "a.jpg"):
        ContentIndex(tmp_path / "index.json").of_path(tmp_path / "a.jpg")
