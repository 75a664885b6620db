"""What a mesh looks like beside the photos: rasterised at the held-out cameras, scored where it covers them.

    pipeline run PHOTOS --until train
    python -m benchmarks.mesh_looks PHOTOS.nerf --pictures /tmp/looks --field

The textured mesh; the same mesh with a colour per vertex; the default mesh without a texture, of more faces; with
--field the field itself (minutes per photo). All are shown as each photo is expected to be exposed (the photos taken
nearest by tell), and scored on the pixels that all of them cover. PSNR is of the mean squared error over these pixels,
SSIM of the windows that hold nothing else; both are means over the photos. Pictures: the photo, then these in order.
"""

import argparse
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.record import Record, add_out
from nerf.geometry.rays import Rays
from pipeline.engine.workspace import Workspace
from stages import mesh
from stages.contract import Inputs, SilentProgress, plan_stage
from stages.evaluate.image_metrics import ssim
from stages.io.files import write_png
from stages.mesh import Config
from stages.mesh.extraction import Source, extract_mesh, load
from stages.mesh.files import ColouredMesh
from stages.mesh.photos.photo import Photo, photo_of, projected, sampled_picture
from stages.mesh.rasteriser import barycentric, nearest_faces
from stages.render.renderer import load_renderer
from stages.train.data import PhotoReader, view_mask, view_rays

MAX_SHIFT = 8  # image sides, beyond which a vertex lies too far outside to be drawn


class Seen(NamedTuple):
    """What a camera sees of a mesh, per pixel on it: its flat index, the face, its barycentric coordinates and the
    point (n, 3)."""

    pixel: np.ndarray
    face: np.ndarray
    corner: np.ndarray
    point: np.ndarray


def rasterised(mesh: ColouredMesh, photo: Photo, width: int, height: int) -> Seen:
    """What a photo's camera sees of a mesh at a reduced size."""
    place = projected(photo, mesh.vertices)
    scale = np.array([width / photo.camera.width, height / photo.camera.height])
    pixels = place.pixels * scale
    ahead = place.ahead & (np.abs(pixels) < MAX_SHIFT * max(width, height)).all(axis=1)
    faces = np.flatnonzero(ahead[mesh.faces].all(axis=1))
    winner, _ = nearest_faces(pixels, place.depth, mesh.faces[faces], width, height)
    pixel = np.flatnonzero(winner >= 0)
    face = faces[winner[pixel]]
    row, column = np.divmod(pixel, width)
    vertex = mesh.faces[face]
    flat = barycentric(pixels[vertex], np.stack([column, row], axis=1) + 0.5)
    corner = flat / place.depth[vertex]
    corner /= corner.sum(axis=1, keepdims=True)
    return Seen(pixel, face, corner, np.einsum("ni,nic->nc", corner, mesh.vertices[vertex]))


def colours_of(mesh: ColouredMesh, seen: Seen, textured: bool) -> np.ndarray:
    """The mesh's own colours, (n, 3) float32, sRGB in [0, 1]."""
    if not textured:
        return np.einsum("ni,nic->nc", seen.corner, mesh.colours[mesh.faces[seen.face]] / np.float32(255))
    assert mesh.texture is not None
    at = np.einsum("ni,nic->nc", seen.corner, mesh.texture.atlas.uv[mesh.texture.atlas.corner[seen.face]])
    return sampled_picture(mesh.texture.picture, at) / np.float32(255)


def as_exposed(photo: Photo, colour: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What the photo is expected to show of colours at the reference exposure, (n, 3)."""
    directions = torch.nn.functional.normalize(
        torch.from_numpy(points - photo.view.scene_from_camera[:, 3]).float(), dim=1
    )
    none, shown = torch.zeros(len(points)), torch.from_numpy(colour).float()
    rays, view = Rays(torch.zeros_like(directions), directions, none, none), torch.zeros(len(points), dtype=torch.int64)
    for effect in reversed(photo.shown):
        shown = effect.inverse(shown, rays, view)
    for effect in photo.effects:
        shown = effect.forward(shown, rays, view)
    return shown.clamp(0, 1).numpy()


def looks(mesh: ColouredMesh, textured: bool, photo: Photo, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh as a photo's camera sees it, (height, width, 3) in [0, 1], and where it is, (height, width) bool."""
    seen = rasterised(mesh, photo, width, height)
    image, covered = np.zeros((height * width, 3), np.float32), np.zeros(height * width, bool)
    image[seen.pixel] = as_exposed(photo, colours_of(mesh, seen, textured), seen.point)
    covered[seen.pixel] = True
    return image.reshape(height, width, 3), covered.reshape(height, width)


def scores(image: np.ndarray, truth: np.ndarray, used: np.ndarray) -> tuple[float, float | None]:
    """PSNR and SSIM of the pixels that are ``used``."""
    error = float(((image - truth)[used] ** 2).mean())
    shown, photo = (torch.from_numpy(np.asarray(each, np.float32)) for each in (image, truth))
    similarity = ssim(shown, photo, torch.from_numpy(used))
    return -10 * math.log10(max(error, 1e-10)), similarity


def truth_of(source: Source, photo: Photo) -> tuple[np.ndarray, np.ndarray]:
    """A photo at the size at which it is scored, over the field's background, (h, w, 3) float32 sRGB in [0, 1], and
    where no mask excludes it, (h, w) bool."""
    reader = PhotoReader(source.ingest, source.scene, None)
    truth = reader.pixels(photo.view, source.info["background"]).numpy()
    mask = view_mask(source.ingest, source.scene, photo.view, None)
    return truth, np.ones(truth.shape[:2], bool) if mask is None else mask.numpy()


def write_strip(pictures: Path, photo: Photo, images: Iterable[np.ndarray]) -> None:
    """Pictures of a photo side by side, in a file that is called as the photo."""
    pictures.mkdir(parents=True, exist_ok=True)
    strip = np.rint(np.concatenate([*images], axis=1) * 255).astype(np.uint8)
    write_png(pictures / f"{Path(photo.view.file).stem}.png", strip)


def meshes_of(source: Source, inputs: Inputs, resolution: int) -> dict[str, tuple[ColouredMesh, bool]]:
    """The meshes compared, and whether to show their texture."""
    made = []
    for size in (Config().texture_size, 0):
        asked = Config(resolution=resolution, texture_size=size)
        config = plan_stage(mesh.STAGE, asked, inputs, SilentProgress())
        made.append(extract_mesh(config, source, SilentProgress()).mesh)
    return {"texture": (made[0], True), "vertex": (made[0], False), "untextured": (made[1], False)}


def figures(source: Source, inputs: Inputs, given: argparse.Namespace, pictures: Path | None) -> dict[str, Any]:
    """The row of a workspace."""
    kinds = meshes_of(source, inputs, given.resolution)
    found: dict[str, list[tuple[float, float | None]]] = {}
    shares = []
    for view in source.scene.of_split("test"):
        photo = photo_of(view, source.scene, source.ingest, source.info)
        truth, unmasked = truth_of(source, photo)
        height, width = unmasked.shape
        drawn = {kind: looks(mesh, has_texture, photo, width, height) for kind, (mesh, has_texture) in kinds.items()}
        used = np.logical_and.reduce([covered for _, covered in drawn.values()]) & unmasked
        images = {kind: image for kind, (image, _) in drawn.items()}
        if given.field:
            images["field"] = field_render(source, inputs["train"], photo)
        shares.append(used.mean())
        for kind, image in images.items():
            found.setdefault(kind, []).append(scores(image, truth, used))
        if pictures:
            write_strip(pictures, photo, [truth, *images.values()])
    row: dict[str, Any] = {
        "faces": len(kinds["texture"][0].faces),
        "untextured_faces": len(kinds["untextured"][0].faces),
        "covered_percent": round(100 * float(np.mean(shares)), 1),
    }
    for kind, pairs in found.items():
        row[f"{kind}_db"] = round(float(np.mean([psnr for psnr, _ in pairs])), 2)
        row[f"{kind}_ssim"] = round(float(np.mean([value for _, value in pairs if value is not None])), 3)
    return row


def field_render(source: Source, train: Path, photo: Photo) -> np.ndarray:
    """What the field shows of a test photo, (height, width, 3)."""
    renderer = load_renderer(train).through(photo.effects)
    return renderer.render(view_rays(source.scene, photo.view, None)).colour.clamp(0, 1).numpy()


def main() -> None:
    """Print a row per workspace."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", type=Path, nargs="+")
    parser.add_argument("--resolution", type=int, default=192)
    parser.add_argument("--field", action="store_true", help="render the field as well")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of every held-out photo")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for path in given.workspaces:
        workspace = Workspace.existing(path)
        keys = workspace.read_run().keys
        folders = {stage: workspace.folder(stage, keys[stage]) for stage in mesh.STAGE.inputs}
        source = load(folders, SilentProgress())
        pictures = None if given.pictures is None else given.pictures / path.stem
        record.add(set=path.stem, **figures(source, folders, given, pictures))


if __name__ == "__main__":
    main()
