"""A trained field on disk: ``field.safetensors`` (weights) and ``field.json`` (what they belong to)."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.contract import StageError
from stages.files import read_json, write_json

if TYPE_CHECKING:
    from nerf.grid_field import GridField
    from nerf.model import RadianceModel
    from nerf.paper import PaperNerf


def save_field(folder: Path, model: "RadianceModel", info: dict[str, Any]) -> None:
    """Write a field; ``info`` says what it was trained on: background, downscale, steps, rays.

    Raises:
        TypeError: for a kind of field that has no file format.
    """
    from safetensors.torch import save_file

    from nerf.grid_field import GridField
    from nerf.paper import PaperNerf

    if not isinstance(model, PaperNerf | GridField):
        raise TypeError(f"no file format for a {type(model).__name__}")
    kind = "grid" if isinstance(model, GridField) else "paper"
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    save_file(weights, folder / "field.safetensors")
    write_json(folder / "field.json", {"kind": kind, "settings": asdict(model.settings), **info})


def load_field(folder: Path, device: str = "cpu") -> "tuple[RadianceModel, dict[str, Any]]":
    """The field in ``folder``, ready to render, and the content of its field.json.

    Raises:
        StageError: if the files are missing or damaged, or another version of the program wrote them.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    info = read_json(folder / "field.json")
    try:
        model = _untrained(info["kind"], info["settings"], device)
        model.load_state_dict(load_file(folder / "field.safetensors"))
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
        why = " ".join(str(error).split())  # torch lists mismatches over several lines
        raise StageError("cannot read the trained field", why, "Run stage train again.") from error
    return model.to(device).requires_grad_(False), info


def _untrained(kind: str, settings: dict[str, Any], device: str) -> "PaperNerf | GridField":
    from nerf.grid_field import GridField, GridSettings
    from nerf.paper import PaperNerf, PaperSettings
    from stages.backend import chosen_backend, load_backend

    if kind == "grid":
        return GridField(GridSettings(**settings), 0, load_backend(chosen_backend(device), device))
    if kind == "paper":
        return PaperNerf(PaperSettings(**settings), seed=0)
    raise ValueError(f"a field of kind {kind!r} is unknown to this version")
