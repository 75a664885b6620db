"""Stage viewer without a browser: what is packed, what that costs, what the page holds and what it says."""

import base64
import gzip
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.kernels import grid_layout
from stages import viewer
from stages.contract import run_stage
from stages.io.field_files import save_field
from stages.io.files import read_json, write_json
from stages.viewer import contents
from stages.viewer.contents import Contents, photo_side
from stages.viewer.page import save
from stages.viewer.tables import quantised, sections, with_table
from tests.conftest import RecordedProgress
from tests.stages.viewer.made_fields import NAMES, Made, made, renamed

LAYOUT = grid_layout(num_levels=3, base_res=4, max_res=16, log2_hashmap_size=9, features_per_level=4)


@pytest.fixture
def table() -> torch.Tensor:
    """Values whose size differs from level to level by far."""
    values = torch.randn(LAYOUT.rows, 4, generator=torch.Generator().manual_seed(0))
    for level, size in enumerate((1e-3, 1.0, 30.0)):
        values[LAYOUT.level_offsets[level] : LAYOUT.level_offsets[level + 1]] *= size
    return values


def page_of(field: Made, folder: Path, **config: Any) -> tuple[str, dict[str, Any], dict[str, bytes]]:
    """The HTML, and what is packed in it: header and sections."""
    folder.mkdir()
    run_stage(viewer.STAGE, viewer.Config(**config), field.inputs, folder, RecordedProgress())
    text = (folder / "viewer.html").read_text("utf-8")
    packed = re.findall(r'type="application/octet-stream">([^<]*)<', text)
    whole = gzip.decompress(base64.b64decode(packed[0]))
    length = int.from_bytes(whole[:4], "little")
    header, body = json.loads(whole[4 : 4 + length]), whole[4 + length :]
    return text, header, {name: body[start : start + size] for name, (start, size) in header["sections"].items()}


def test_8_bits_keep_each_level_within_its_scale(table: torch.Tensor):
    packed = quantised(LAYOUT, table, 8)
    error = np.abs(packed.values() - table.numpy())
    for level in range(3):
        rows = slice(LAYOUT.level_offsets[level], LAYOUT.level_offsets[level + 1])
        spread = table[rows].numpy().std()
        assert 0 < np.sqrt(np.square(error[rows]).mean()) < 0.012 * spread
        assert (np.abs(packed.codes[rows]).max(axis=0) == 127).all(), "all codes are used"


def test_16_bits_are_nearer_than_8(table: torch.Tensor):
    errors = [np.square(quantised(LAYOUT, table, bits).values() - table.numpy()).sum() for bits in (8, 16)]
    assert 0 < errors[1] < 1e-3 * errors[0]


@pytest.mark.parametrize("bits", [8, 16])
def test_planes_hold_every_code(table: torch.Tensor, bits: Any):
    packed = quantised(LAYOUT, table, bits)
    planes, at = np.frombuffer(packed.planes(), np.uint8), 0
    rows = np.empty((LAYOUT.rows, 4, bits // 8), np.uint8)
    for level in range(3):
        for feature in range(4):
            for byte in range(bits // 8):
                count = LAYOUT.level_rows(level)
                first = LAYOUT.level_offsets[level]
                rows[first : first + count, feature, byte] = planes[at : at + count]
                at += count
    assert at == len(planes) and np.array_equal(rows.view(packed.codes.dtype)[..., 0], packed.codes)


def test_a_table_of_zeros_is_packed():
    assert (quantised(LAYOUT, torch.zeros(LAYOUT.rows, 4), 8).values() == 0).all()


def test_networks_are_packed_with_the_scales(tmp_path: Path):
    """The first layer of the packed network on codes is that of the field on their values."""
    field = made(tmp_path, "box").field
    packed = quantised(field.layout, field.table, 8)
    matrices = np.frombuffer(sections(field, packed)["density_network"], np.float32)[: 16 * 3 * 16].reshape(16, 3, 4, 4)
    codes = packed.codes[:3] / 127.0  # as the features of levels 0, 1 and 2
    hidden = np.einsum("jlch,lc->jh", matrices, codes).flatten()
    values = packed.codes[:3] * packed.scales
    assert np.allclose(hidden, values.flatten() @ field.density_hidden.numpy(), rtol=1e-4, atol=1e-4)
    assert not torch.equal(with_table(field, packed).table, field.table)


def test_equal_inputs_give_equal_bytes(tmp_path: Path):
    field = made(tmp_path, "contraction")
    assert page_of(field, tmp_path / "a")[0] == page_of(field, tmp_path / "b")[0]


def test_names_of_photos_are_in_no_html(tmp_path: Path):
    field = made(tmp_path, "box")
    renamed(field)
    text, header, parts = page_of(field, tmp_path / "page")
    assert [view["name"] for view in header["views"][:3]] == list(NAMES)
    assert not any(name in text for name in NAMES) and len(re.findall("</script>", text)) == 2
    assert re.findall(r"(?:src|href)=[\"']?(?!.?data:)\S+", text) == [] and "http:" not in text and "https:" not in text
    assert parts["photo0"][:2] == b"\xff\xd8"


def test_without_photos_none_is_in_the_file(tmp_path: Path):
    _, _, parts = page_of(made(tmp_path, "box"), tmp_path / "page", photos="off")
    assert [name for name in parts if name.startswith("photo")] == [] and "table" in parts


def test_the_mesh_is_in_the_file_unless_told_otherwise(tmp_path: Path):
    field = made(tmp_path, "box")
    _, header, parts = page_of(field, tmp_path / "page")
    assert header["mesh"] == {"middle": [0.0, 0.0, 0.1], "radius": pytest.approx(0.4), "faces": 8}
    assert [len(parts[f"mesh_{name}"]) for name in ("positions", "faces", "colours")] == [36, 48, 18]
    assert viewer.more_inputs(viewer.Config()) == ("mesh",) and viewer.more_inputs(viewer.Config(mesh="off")) == ()
    assert viewer.STAGE.dispensable == ("mesh",), "a mesh that fails leaves a page without one"
    del field.inputs["mesh"]
    _, header, parts = page_of(field, tmp_path / "without")
    assert header["mesh"] is None and not any(name.startswith("mesh") for name in parts)


def test_8_bits_that_lose_too_much_become_16(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    field = made(tmp_path, "box")
    assert page_of(field, tmp_path / "a")[1]["field"]["bits"] == 8
    monkeypatch.setattr(contents, "MAX_LOSS_DB", -10.0)
    _, header, parts = page_of(field, tmp_path / "b")
    assert header["field"]["bits"] == 16 and len(parts["table"]) == 8 * field.field.layout.rows


def test_lengths_are_in_metres_where_the_scale_is_known(tmp_path: Path):
    field = made(tmp_path, "box")
    assert page_of(field, tmp_path / "a")[1]["scene"]["metres_per_unit"] is None
    (field.inputs["scale"] / "scale.json").write_text('{"metres_per_unit": 2.5}', "utf-8")
    scale = field.scene.scene_from_sfm.scale
    assert page_of(field, tmp_path / "b")[1]["scene"]["metres_per_unit"] == pytest.approx(2.5 / scale)


def test_a_vanilla_nerf_has_a_page_that_says_why_not(tmp_path: Path):
    field, progress = made(tmp_path, "box"), RecordedProgress()
    model = VanillaNerf(VanillaSettings(depth=2, width=16), seed=0)
    save_field(field.inputs["train"], model, {"background": [1.0, 1.0, 1.0], "downscale": 1.0, "effects": {}})
    (tmp_path / "page").mkdir()
    result = run_stage(viewer.STAGE, viewer.Config(), field.inputs, tmp_path / "page", progress)
    text = (tmp_path / "page/viewer.html").read_text("utf-8")
    assert progress.codes == ["viewer.not-rendered"] and result.facts == {"drawn": False}
    assert "vanilla NeRF" in text and "<script" not in text


@pytest.mark.parametrize(
    ("loss_db", "words"),
    [(0.0041, "0.004 dB lost"), (-0.0021, "0.002 dB gained"), (-0.0002, " 0.000 dB lost"), (0.0, " 0.000 dB lost")],
)
def test_a_loss_below_nothing_is_a_gain(tmp_path: Path, loss_db: float, words: str):
    assert save(Contents({"field": {"bits": 8}, "name": "it"}, {}, loss_db), tmp_path).line.endswith(words)


def test_small_photos_of_a_large_set_are_smaller():
    assert photo_side(8) == 320 and photo_side(10_000) == 96
    assert 96 < photo_side(200) < 320


def test_a_live_page_needs_neither_warp_nor_mesh_libraries(tmp_path: Path):
    """They take seconds to load, on cores that train many."""
    field = made(tmp_path, "box")
    write_json(
        field.inputs["train"] / "field.json", read_json(field.inputs["train"] / "field.json") | {"backend": "warp"}
    )
    program = f"""if True:
        import sys
        from pathlib import Path
        from stages.io.field_files import load_field
        from stages.viewer.live import LiveContents
        contents = LiveContents(Path({str(field.inputs["normalise"])!r}))
        assert contents.field_contents(*load_field(Path({str(field.inputs["train"])!r}), renders=False))
        print([name for name in ("scipy.spatial", "trimesh", "warp") if name in sys.modules])"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
