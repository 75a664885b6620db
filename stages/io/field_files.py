"""A trained field on disk: ``field.safetensors`` (weights) and ``field.json`` (what they belong to)."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save

from nerf.effects.appearance import AppearanceModel
from nerf.fields.hash_grid import HashGridField, HashGridSettings
from nerf.fields.interface import RadianceModel
from nerf.fields.vanilla import VanillaNerf, VanillaSettings
from nerf.geometry.space_maps import space_map
from stages.contract import Progress, StageError
from stages.effects.image_effects import check_learnt_colours, new_view_effects
from stages.hardware.backend import BackendName, backend_name, backend_of_field, load_backend
from stages.io.files import first_fault, read_json, write_json

TRAIN_AGAIN = "Train again: pipeline train WORKSPACE --force"


def save_field(folder: Path, model: RadianceModel, info: dict[str, Any]) -> None:
    """Write a field; ``info`` says what it was trained on (background, downscale, steps, rays) and what its ``effects``
    learnt. What computes a grid field is written, too.

    Raises:
        TypeError: for a kind of field that has no file format.
    """
    if not isinstance(model, VanillaNerf | HashGridField):
        raise TypeError(f"no file format for a {type(model).__name__}")
    kind = {"kind": "vanilla"}
    if isinstance(model, HashGridField):
        kind = {"kind": "grid", "backend": backend_name(model.backend)}
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    (folder / "field.safetensors").write_bytes(save(weights))
    write_json(folder / "field.json", {**kind, "settings": asdict(model.settings), **info})


def load_field(
    folder: Path, device: str = "cpu", progress: Progress | None = None, renders: bool = True
) -> tuple[RadianceModel, dict[str, Any]]:
    """The field in ``folder``, ready to render, and the content of its field.json.

    One that never ``renders``, whose numbers alone are wanted, has torch's kernels: to load Warp takes seconds.

    One with colour effects comes as new views show it, in an AppearanceModel. ``progress`` is told why a grid field is
    computed by torch's kernels: they trained it, or Warp's do not run on ``device``.

    Raises:
        StageError: if the files are missing or damaged, or another version of the program wrote them.
    """
    info = read_json(folder / "field.json")
    try:
        weights = folder / "field.safetensors"
        model = _untrained(info, weights.stat().st_size, device, progress, renders)
        model.load_state_dict(load(weights.read_bytes()))  # load_file takes paths in Unicode alone
        check_learnt_colours(info)
    except ValidationError as error:
        raise StageError(
            "io.field-settings", "cannot read the trained field", first_fault(error), TRAIN_AGAIN
        ) from error
    except (
        OSError,
        KeyError,
        TypeError,
        AttributeError,
        ValueError,
        OverflowError,
        RuntimeError,
        SafetensorError,
    ) as error:
        why = " ".join(str(error).split())  # torch lists mismatches over several lines
        raise StageError("io.field-weights", "cannot read the trained field", why, TRAIN_AGAIN) from error
    model = model.to(device).requires_grad_(False)
    effects = new_view_effects(info, device=device)
    return AppearanceModel(model, effects) if effects else model, info


def _untrained(
    info: dict[str, Any], stored: int, device: str, progress: Progress | None, renders: bool
) -> VanillaNerf | HashGridField:
    """The field that ``info`` describes; ``stored`` is the size of its weights in bytes, which it must not exceed.
    Raises ValueError, before anything is allocated."""
    kind, settings = info["kind"], info["settings"]
    if kind not in ("grid", "vanilla"):
        raise ValueError(f"a field of kind {kind!r} is unknown to this version")
    text, named = json.dumps(settings), settings | {"space": space_map(**settings["space"])}
    if kind == "grid":
        HashGridSettings(**named)  # which refuses unknown names; their types are checked next
        grid = TypeAdapter(HashGridSettings).validate_json(text, strict=True)
        _check_size(grid.layout.rows * grid.features_per_level, stored)
        trained_with = _trained_with(info)
        backend = backend_of_field(trained_with, device, progress) if renders else "torch"
        return HashGridField(grid, 0, load_backend(backend, device))
    VanillaSettings(**named)
    vanilla = TypeAdapter(VanillaSettings).validate_json(text, strict=True)
    _check_size(vanilla.depth * vanilla.width**2, stored)
    return VanillaNerf(vanilla, seed=0)


def _trained_with(info: dict[str, Any]) -> BackendName:
    """Raises ValueError where that is not said, or no backend."""
    if "backend" not in info:
        raise ValueError("an earlier version of this program wrote it and did not record the kernels that trained it")
    if info["backend"] not in get_args(BackendName):
        raise ValueError(f"kernels called {info['backend']!r} are unknown to this version")
    return info["backend"]


def _check_size(numbers: int, stored: int) -> None:
    if 4 * numbers > stored:
        raise ValueError(f"its settings need at least {4 * numbers} bytes of weights, and it has {stored}")
