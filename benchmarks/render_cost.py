"""What a frame costs: seconds and held-out PSNR against samples per ray and resolution, of one finished field.

    pipeline run PHOTOS --until train --train.steps 1500
    python -m benchmarks.render_cost PHOTOS.nerf --downscales 4 2 1

The field is drawn with other samples than it was trained with: nothing is trained anew (what training with them
gives is in the study, `pipeline tradeoff`).
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.record import Record, add_out
from nerf.effects.appearance import AppearanceModel
from nerf.fields.hash_grid import HashGridField
from nerf.fields.interface import RadianceModel
from nerf.fields.vanilla import VanillaNerf
from nerf.training.psnr import mean_squared_error, psnr
from pipeline.engine.workspace import Workspace
from stages.effects.image_effects import photo_effects
from stages.io.amounts import resolution_name
from stages.io.files import read_json, read_scene
from stages.io.photos import spread
from stages.render.renderer import Renderer, load_renderer
from stages.train.data import PhotoReader, view_rays


def with_samples(model: RadianceModel, factor: float) -> RadianceModel:
    """The same field with so many times the samples along each ray."""
    if isinstance(model, AppearanceModel):
        return AppearanceModel(with_samples(model.model, factor), model.effects)
    if isinstance(model, HashGridField):
        given = model.settings
        finer = {"min_step_size": given.min_step_size / factor, "cone_angle": given.cone_angle / factor}
        settings = replace(given, diagonal_steps=max(1, round(given.diagonal_steps * factor)), **finer)
        changed: HashGridField | VanillaNerf = HashGridField(settings, 0, model.backend)
    else:
        assert isinstance(model, VanillaNerf)
        given = model.settings
        coarse, fine = (max(2, round(count * factor)) for count in (given.samples_coarse, given.samples_fine))
        changed = VanillaNerf(replace(given, samples_coarse=coarse, samples_fine=fine), seed=0)
    changed.load_state_dict(model.state_dict())
    return changed.to(next(iter(model.state_dict().values())).device).requires_grad_(False)


def samples_of(model: RadianceModel) -> str:
    """How the samples of a field are laid, in its own terms."""
    if isinstance(model, AppearanceModel):
        return samples_of(model.model)
    if isinstance(model, HashGridField):
        step, bounded = model.render_stepping.step_size, f"{model.settings.diagonal_steps} along the box's diagonal"
        return f"steps from {step:.4f}" if model.space.bends_rays else bounded
    assert isinstance(model, VanillaNerf)
    return f"{model.settings.samples_coarse} + {model.settings.samples_fine}"


def measured(renderer: Renderer, folders: dict[str, Path], downscale: float, photos: int) -> tuple[float, float]:
    """Mean seconds a frame and mean PSNR (dB) over ``photos`` test photos."""
    scene = read_scene(folders["normalise"])
    test = scene.of_split("test")
    info = read_json(folders["train"] / "field.json")
    reader, seconds, scores = PhotoReader(folders["ingest"], scene, downscale), [], []
    for index in spread(len(test), min(photos, len(test))):
        view = test[index]
        shown = renderer.through(photo_effects(info, scene, view, renderer.device))
        rays = view_rays(scene, view, downscale)
        truth = reader.pixels(view, renderer.background.tolist())
        started = time.perf_counter()
        picture = shown.render(rays).colour.clamp(0, 1)
        seconds.append(time.perf_counter() - started)
        scores.append(psnr(mean_squared_error(picture, truth)))
    return sum(seconds) / len(seconds), sum(scores) / len(scores)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.25, 0.5, 1.0, 2.0])
    parser.add_argument("--downscales", type=float, nargs="+", default=[4.0, 2.0, 1.0])
    parser.add_argument("--photos", type=int, default=2)
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    workspace = Workspace.existing(given.workspace)
    keys = workspace.read_run().keys
    folders = {stage: workspace.folder(stage, keys[stage]) for stage in ("ingest", "normalise", "train")}
    renderer = load_renderer(folders["train"])
    for downscale in given.downscales:
        for factor in given.factors:
            other = replace(renderer, model=with_samples(renderer.model, factor))
            measured(other, folders, max(given.downscales) * 4, 1)  # the first picture pays for memory and kernels
            with torch.no_grad():
                seconds, score = measured(other, folders, downscale, given.photos)
            words = f"× {factor:g} ({samples_of(other.model)})"
            record.add(samples=words, resolution=resolution_name(downscale), frame_seconds=seconds, psnr=score)


if __name__ == "__main__":
    main()
