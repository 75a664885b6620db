from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf.effects.appearance import AppearanceModel
from nerf.effects.exposure import ExposureModel
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.rays import Rays
from nerf.geometry.space_maps.contraction import Contraction
from stages.contract import StageError
from stages.hardware.backend import BackendName, backend_name, chosen_backend, load_backend
from stages.io.field_files import load_field, save_field
from stages.io.files import read_json, read_tensors, write_json, write_tensors
from tests.refusals import refused

SMALL = VanillaSettings(depth=2, width=8, samples_coarse=4, samples_fine=4, space=Contraction(), spacing="log")
GRID = HashGridSettings(
    num_levels=2, log2_hashmap_size=8, base_res=4, max_res=16, space=Contraction(), occupancy_resolution=8
)
KERNELS = load_backend(chosen_backend("cpu"), "cpu")
OUTDOORS = HashGridField(replace(GRID, background_model=True), 5, KERNELS)
OUTDOORS.background_table.normal_(generator=torch.Generator().manual_seed(6))
KINDS = {"vanilla": VanillaNerf(SMALL, seed=5), "grid": HashGridField(GRID, 5, KERNELS), "sky": OUTDOORS}
INFO = {"background": [1.0, 1.0, 1.0], "downscale": 2.5, "steps": 7, "rays": 700, "effects": {}}


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_comes_back_the_same(kind: str, tmp_path: Path) -> None:
    model = KINDS[kind]
    save_field(tmp_path, model, INFO)
    loaded, info = load_field(tmp_path)
    rays = Rays(torch.zeros(3, 3), torch.eye(3), torch.full((3,), 0.5), torch.full((3,), 4.0))
    with torch.no_grad():
        seen = model.render(rays, torch.ones(3))
        assert all(torch.equal(*pair) for pair in zip(seen, loaded.render(rays, torch.ones(3)), strict=True))
    assert seen.opacity.min() > 0 and seen.colour.std() > 0
    assert {key: info[key] for key in INFO} == INFO
    assert info["kind"] == ("vanilla" if kind == "vanilla" else "grid")
    assert info["settings"]["space"] == {"kind": "contraction"}


def test_files_are_read_from_folders_whose_names_are_not_unicode(tmp_path: Path) -> None:
    folder = tmp_path / "caf\udce9"
    folder.mkdir()
    save_field(folder, KINDS["vanilla"], INFO)
    assert load_field(folder)[1]["steps"] == 7
    write_tensors(folder / "points.safetensors", {"none": np.zeros((0, 3))})
    assert read_tensors(folder / "points.safetensors")["none"].shape == (0, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_equal_fields_are_equal_bytes(kind: str, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        save_field(tmp_path / name, KINDS[kind], INFO)
    for file in ("field.safetensors", "field.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_field_asks_for_no_gradients(kind: str, tmp_path: Path) -> None:
    save_field(tmp_path, KINDS[kind], INFO)
    loaded, _ = load_field(tmp_path)
    assert not loaded.density(torch.zeros(2, 3)).requires_grad


@pytest.mark.parametrize("harm", ["cut weights", "no weights", "another kind", "another size", "unknown setting"])
def test_a_damaged_field_is_refused_in_words(harm: str, tmp_path: Path) -> None:
    save_field(tmp_path, VanillaNerf(SMALL, seed=5), INFO)
    weights, info = tmp_path / "field.safetensors", read_json(tmp_path / "field.json")
    if harm == "cut weights":
        weights.write_bytes(weights.read_bytes()[:-9])
    elif harm == "no weights":
        weights.unlink()
    elif harm == "another kind":
        write_json(tmp_path / "field.json", info | {"kind": "voxels"})
    elif harm == "another size":
        write_json(tmp_path / "field.json", info | {"settings": info["settings"] | {"width": 16}})
    else:
        write_json(tmp_path / "field.json", info | {"settings": info["settings"] | {"colour_space": "xyz"}})
    with pytest.raises(StageError) as failure:
        load_field(tmp_path)
    assert failure.value.code.startswith("io.")
    if harm == "another kind":
        assert "voxels" in failure.value.why


def test_a_model_without_a_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no file format for a Linear"):
        save_field(tmp_path, torch.nn.Linear(1, 1), INFO)  # type: ignore[arg-type]


RAYS = Rays(torch.zeros(3, 3), torch.eye(3), torch.full((3,), 0.5), torch.full((3,), 4.0))
EXPOSURE = {"a.jpg": [0.5, 0.0, 0.3], "b 2.jpg": [0.1, 0.0, -0.1], "c.jpg": [-0.5, 0.0, -0.3]}


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_with_exposure_is_shown_at_the_reference(kind: str, tmp_path: Path) -> None:
    plain = KINDS[kind]
    save_field(tmp_path, plain, INFO | {"effects": {"exposure": EXPOSURE}})
    loaded, info = load_field(tmp_path)
    assert info["effects"] == {"exposure": EXPOSURE} and isinstance(loaded, AppearanceModel)
    exposure = ExposureModel(torch.tensor([EXPOSURE["b 2.jpg"]]))
    wanted = AppearanceModel(plain, (exposure,)).render(RAYS, torch.ones(3)).colour
    assert torch.equal(loaded.render(RAYS, torch.ones(3)).colour, wanted)
    assert (wanted[:, 1] == plain.render(RAYS, torch.ones(3)).colour[:, 1]).all()
    assert (wanted[:, 0] > plain.render(RAYS, torch.ones(3)).colour[:, 0]).all()


def test_a_field_without_exposure_is_the_field_itself(tmp_path: Path) -> None:
    save_field(tmp_path, KINDS["vanilla"], INFO)
    loaded, _ = load_field(tmp_path)
    assert isinstance(loaded, VanillaNerf)


@pytest.mark.parametrize(
    "harm",
    [
        {"exposure": {"a.jpg": [0.0, 0.0]}},
        {"exposure": {"a.jpg": [0.0, "bright", 0.0]}},
        {"exposure": None},
        {"exposure": {"a.jpg": 1.0}},
        {"exposure": {"a.jpg": [10**400, 0, 0]}},
        {"exposure": {"a.jpg": [1e39, 0, 0]}},
        {"exposure": {}},
        None,
    ],
)
def test_damaged_effects_are_refused_in_words(harm: object, tmp_path: Path) -> None:
    save_field(tmp_path, KINDS["vanilla"], INFO | {"effects": harm})
    with refused("io.field-weights"):
        load_field(tmp_path)


@pytest.mark.parametrize("trained_with", ["warp", "torch"])
def test_a_field_keeps_to_torch_if_that_trained_it(trained_with: BackendName, tmp_path: Path, progress) -> None:
    save_field(tmp_path, HashGridField(GRID, 5, load_backend(trained_with, "cpu")), INFO)
    loaded, info = load_field(tmp_path, "cpu", progress)
    assert isinstance(loaded, HashGridField)
    assert backend_name(loaded.backend) == info["backend"] == trained_with
    assert progress.codes == ["hardware.trained-without-warp"] * (trained_with == "torch")


def test_a_warp_field_is_read_without_warp(tmp_path: Path, progress, monkeypatch) -> None:
    save_field(tmp_path, HashGridField(GRID, 5, load_backend("warp", "cpu")), INFO)
    monkeypatch.setattr("stages.hardware.backend.why_not_warp", lambda device: "it is not there")
    loaded, _ = load_field(tmp_path, "cpu", progress)
    assert isinstance(loaded, HashGridField)
    assert backend_name(loaded.backend) == "torch"
    assert progress.codes == ["hardware.torch-alone"] and progress.names("hardware.torch-alone", "it is not there")


@pytest.mark.parametrize(
    "backend, why",
    [
        (None, "an earlier version"),
        ("numba", "'numba'"),
    ],
)
def test_a_field_of_unknown_kernels_is_refused_in_words(backend: str | None, why: str, tmp_path: Path) -> None:
    save_field(tmp_path, KINDS["grid"], INFO)
    info = read_json(tmp_path / "field.json")
    del info["backend"]
    write_json(tmp_path / "field.json", info if backend is None else info | {"backend": backend})
    with refused("io.field-weights", why):
        load_field(tmp_path)
