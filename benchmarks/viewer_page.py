"""How far the picture of viewer.html is from the Python renderer's, and how well it measures.

    pipeline run PHOTOS --until viewer
    python -m benchmarks.viewer_page PHOTOS.nerf
    python -m benchmarks.viewer_page demo/demo.nerf --truth demo/truth.json

A row per test photo: PSNR between the page's picture and the renderer's, at SIDE pixels, without distortion: of the
field as it was trained, and in the bits that the page has; samples per pixel; how much worse the renderer's picture
scores against the page's small photo in these bits; how much better or worse the page's picture does. With --truth (of
`pipeline demo`'s photos) also lengths between points that are clicked, LENGTHS of them: the median error, and by how
much the median one is too long.
"""

import argparse
import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.record import Record, add_out
from nerf.fields.hash_grid import HashGridField
from nerf.geometry.alignment import align
from nerf.geometry.rays import rays_of_view
from nerf.geometry.scene import Scene, View
from nerf.synthetic.scenes import still_life
from pipeline.demo.truth import Truth
from pipeline.engine.workspace import Workspace
from stages.effects.image_effects import photo_effects
from stages.io.files import read_json, read_scene
from stages.render.renderer import Renderer, load_renderer
from stages.viewer.tables import quantised, with_table
from tests.stages.viewer.browser import Viewer, chromium, pinhole_rays, psnr, request_of

SIDE, VIEWS, LENGTHS = 320, 4, 40
MIN_LENGTH = 0.2  # of a pair, in units of the truth, whose table is 2.4 across


def packed(page: Viewer, renderer: Renderer) -> Renderer:
    """The field in the page's bits."""
    field = renderer.field
    assert isinstance(field, HashGridField)
    table = quantised(field.layout, field.table, page.run("viewer.contents.field.bits"))
    return replace(renderer, model=with_table(field, table))


def samples_per_pixel(page: Viewer, width: int, height: int, request: dict[str, Any]) -> float:
    """Densities that the shader evaluates, of a picture at a quarter of the size."""
    drawn = page.picture(width // 4, height // 4, request | {"view": "cost"})
    low, high = (255 * drawn[..., :2]).round().transpose(2, 0, 1)
    return float((low + 256 * high).mean())


def pictures(page: Viewer, renderer: Renderer, info: dict[str, Any], scene: Scene, index: int) -> dict[str, float]:
    """The figures of one photo but lengths."""
    view, of_page = scene.views[index], page.run(f"viewer.contents.views[{index}]")
    lens, (width, height) = of_page["lens"], (of_page["lens"]["width"], of_page["lens"]["height"])
    shrink = max(width, height) / SIDE
    size = [round(width / shrink), round(height / shrink)]
    small = [*size, *(lens[name] * size[0] / width for name in ("fx", "fy", "cx", "cy"))]
    gains = {"logGain": of_page["log_gain"], "falloff": of_page["falloff"]}
    request = request_of(view.scene_from_camera, small, (view.near, view.far), **gains)
    drawn = page.picture(size[0], size[1], request)[..., :3]
    rays = pinhole_rays(view.scene_from_camera, small, (view.near, view.far)).each(
        lambda part: part.to(renderer.device)
    )
    effects = photo_effects(info, scene, view, renderer.device)
    both = (renderer, packed(page, renderer))
    colour, in_bits = (each.through(effects).render(rays).colour.clamp(0, 1).numpy() for each in both)
    photo = page.run(f"Array.from(viewer.contents.section('photo{index}'))")
    with Image.open(BytesIO(bytes(photo))) as opened:
        pixels = np.asarray(opened.resize((size[0], size[1]), Image.Resampling.BOX)) / 255
    return {
        "agreement_db": round(psnr(drawn, colour), 1),
        "agreement_in_bits_db": round(psnr(drawn, in_bits), 1),
        "samples_per_pixel": round(samples_per_pixel(page, size[0], size[1], request), 1),
        "bits_cost_db": round(psnr(colour, pixels) - psnr(in_bits, pixels), 3),
        "score_difference_db": round(psnr(drawn, pixels) - psnr(colour, pixels), 3),
    }


def true_points(truth: Truth, scene: Scene, view: View, directions: np.ndarray) -> tuple[np.ndarray, float]:
    """What rays of ``view`` (n, 3; its camera's frame) meet first of the true scene, in its frame, and its units per
    scene unit.

    The page's own rays, brought there by all cameras together: those of the true camera pass beside them by what the
    principal point is off, and would meet other points of the surface.
    """
    views = [each for each in scene.views if each.name in truth.poses]
    centres = np.stack([each.scene_from_camera[:, 3] for each in views])
    truth_from_scene = align(centres, np.stack([truth.poses[each.name][:, 3] for each in views]))
    pose = torch.tensor(truth_from_scene.pose(view.scene_from_camera)).float()
    rays = rays_of_view(torch.tensor(directions).float(), pose, 0.0, math.inf)
    distance = still_life(truth.seed).intersect(rays.origins, rays.directions).amin(0)
    return (rays.origins + distance[:, None] * rays.directions).numpy(), truth_from_scene.scale


def length_errors(page: Viewer, truth: Truth, scene: Scene, view: View, index: int) -> dict[str, float]:
    """In percent, over pairs of clicked pixels: the median error, and the median of what lengths are too long by."""
    page.run(f"viewer.showPhoto({index})")
    page.until(f"viewer.photo === {index}")
    width, height = page.run("[viewer.canvas.width, viewer.canvas.height]")
    random = np.random.default_rng(0)
    clicks = random.uniform([0.3 * width, 0.4 * height], [0.7 * width, 0.9 * height], (2 * LENGTHS, 2))
    lens = page.run("fitted(viewer.lens, viewer.canvas.width, viewer.canvas.height)")
    at = np.stack([(clicks[:, 0] - lens["cx"]) / lens["fx"], (clicks[:, 1] - lens["cy"]) / lens["fy"]], axis=1)
    directions = np.concatenate([at, np.ones((len(at), 1))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    known, scale = true_points(truth, scene, view, directions)
    errors = []
    for one, other in np.arange(len(clicks)).reshape(-1, 2):
        if not np.isfinite(known[[one, other]]).all():  # one of the clicks shows the sky
            continue
        true = np.linalg.norm(known[one] - known[other])
        measures = "; ".join(f"viewer.measure({x}, {y})" for x, y in clicks[[one, other]])
        page.run(f"() => {{ viewer.measured = []; {measures}; }}")
        found = page.run("viewer.measured.length === 2 ? norm(subtract(...viewer.measured)) : null")
        if found is not None and true > MIN_LENGTH:
            errors.append(100 * (found * scale / true - 1))
    figures = {"length_error_percent": np.median(np.abs(errors)), "length_bias_percent": np.median(errors)}
    return {name: round(float(value), 2) for name, value in figures.items()}


def main() -> None:
    """Each workspace, a few of its test photos."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", nargs="+", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--photos", type=int, default=VIEWS, help="test photos of each workspace")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    truth = Truth.read(given.truth) if given.truth else None
    with chromium() as browser:
        for root in given.workspaces:
            workspace, keys = Workspace.existing(root), Workspace.existing(root).read_run().keys
            train = workspace.folder("train", keys["train"])
            scene = read_scene(workspace.folder("normalise", keys["normalise"]))
            page = Viewer(browser, workspace.folder("viewer", keys["viewer"]) / "viewer.html", SIDE, SIDE)
            tests = [index for index, view in enumerate(scene.views) if view.split == "test"][: given.photos]
            for index in tests:
                figures = pictures(page, load_renderer(train), read_json(train / "field.json"), scene, index)
                if truth is not None and scene.views[index].name in truth.poses:
                    figures |= length_errors(page, truth, scene, scene.views[index], index)
                record.add(scene=root.name.removesuffix(".nerf"), photo=scene.views[index].name, **figures)
            page.close()


if __name__ == "__main__":
    main()
