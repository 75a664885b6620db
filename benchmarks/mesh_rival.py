"""Our textured mesh beside another program's, rasterised at our held-out cameras and scored where it covers the photos.

    pipeline run PHOTOS -o OURS --mesh.formats glb ply obj
    python -m benchmarks.mesh_rival --set OURS RIVAL [RIVAL ...] --pictures /tmp/rival

A folder RIVAL is one result of the other program, in a frame of its own: `cameras` with a COLMAP model of its photos,
which have the names of ours; one .obj file with a texture; and `seconds.json`, which says how long each step took. The
row is named like the folder. pyarchinit-photogrammetry 1.6.0 (GPL) makes it in an environment of its own; here it saw
our training photos alone:

    python -m venv ENV && ENV/bin/pip install "pyarchinit-photogrammetry[mesh,fast]==1.6.0"
    ENV/bin/ppg new P.ppg && ENV/bin/ppg add-photos P.ppg TRAINING_PHOTOS && ENV/bin/ppg align P.ppg
    ENV/bin/ppg dense P.ppg && ENV/bin/ppg mesh P.ppg
    ENV/bin/ppg export P.ppg --model RIVAL/model.obj --cameras RIVAL/cameras

These are its `defaults`. `fine` has align --quality ultra, dense --quality high and mesh --faces 100000; `fused` also
mesh --source depth_maps; `patchmatch` is `fine` with dense --backend patchmatch.

A similarity moves its mesh. It brings sparse points to those of ours that show in the same place of a photo; cameras
would do worse, for each is turned by what its principal point is off. ``off`` is the median distance that it leaves
between these points, in our training photos. Its colours are shown as they are, ours as the photo is expected to be
exposed. PSNR and SSIM are as in benchmarks/mesh_looks.py, means over the photos: first on what a mesh covers itself,
then on what all meshes of the set cover. ``fitted`` is the PSNR once each picture has the gains, of its channels in
linear light, that fit it best to the photo. Seconds are those of all steps up to the mesh; ours count the stages that
the mesh needs. Pictures: the photo, ours, the others in order.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from benchmarks.mesh_looks import looks, scores, truth_of, write_strip
from benchmarks.record import Record, add_out
from nerf.geometry.alignment import MAX_DEVIATION, align
from nerf.geometry.scene import Similarity
from nerf.rendering.srgb_arrays import linear_light, srgb_values
from pipeline.engine.workspace import Workspace
from stages import mesh
from stages.contract import SilentProgress
from stages.io.files import read_json
from stages.io.pixels import pillow
from stages.io.sparse_model import SparseModel
from stages.mesh.extraction import Source, load
from stages.mesh.files import ColouredMesh
from stages.mesh.photos.photo import Photo, photo_of, projected
from stages.mesh.surface import Surface, vertex_normals
from stages.mesh.texture.atlas import Atlas, Texture
from stages.sfm.colmap.models import read_model

MAX_PAIR_PX = 1.0  # between features of two programs that are taken for one
ALIGNMENT_ROUNDS = 5


class Result(NamedTuple):
    """A program's mesh in our scene frame and what is known of it. ``is_ours``: its colours are at the reference
    exposure. ``facts``: figures of its row."""

    name: str
    mesh: ColouredMesh
    is_ours: bool
    facts: dict[str, Any]


class Score(NamedTuple):
    """Of one photo: the share of it that counts, in [0, 1], PSNR in dB and SSIM there, and the PSNR once its exposure
    is fitted to the photo."""

    share: float
    psnr: float
    ssim: float | None
    psnr_fitted: float


def read_obj(file: Path) -> ColouredMesh:
    """A mesh of triangles with one texture, as the .obj file has it; vertices without a colour of their own. Raises
    ValueError for another number of textures."""
    lines: dict[str, list[list[str]]] = {key: [] for key in ("v", "vt", "f", "mtllib")}
    with file.open(encoding="utf-8") as stream:
        for key, *words in (line.split() for line in stream if line.strip()):
            if key in lines:
                lines[key].append(words)
    vertices = np.array([words[:3] for words in lines["v"]], float)
    index = np.array([[corner.split("/")[:2] for corner in words] for words in lines["f"]], np.int64) - 1
    faces, corner = index[..., 0].astype(np.int32), index[..., 1]
    uv = np.array([words[:2] for words in lines["vt"]], float)
    picture = np.asarray(pillow().open(texture_of(file.with_name(lines["mtllib"][0][0]))).convert("RGB"))
    height, width = picture.shape[:2]
    vertex = np.zeros(len(uv), np.int64)
    vertex[corner] = faces
    atlas = Atlas((uv * [1, -1] + [0, 1]) * [width, height], corner, vertex, width, height, 1.0)
    normals = vertex_normals(Surface(vertices, faces))
    return ColouredMesh(vertices, faces, normals, np.zeros((len(vertices), 3), np.uint8), Texture(atlas, picture))


def texture_of(materials: Path) -> Path:
    """The only texture that an .mtl file names. Raises ValueError where there is another number of them."""
    words = [line.split(maxsplit=1) for line in materials.read_text("utf-8").splitlines()]
    names = {word[1].strip() for word in words if word[:1] == ["map_Kd"]}
    if len(names) != 1:
        raise ValueError(f"{materials} names {len(names)} textures")
    return materials.with_name(names.pop())


def moved(mesh: ColouredMesh, similarity: Similarity) -> ColouredMesh:
    """The mesh in another frame."""
    return mesh._replace(vertices=similarity.points(mesh.vertices), normals=mesh.normals @ similarity.rotation.T)


def our_result(workspace: Workspace, source: Source) -> Result:
    """The mesh that a run of ours wrote, and the seconds of the stages that it needs."""
    keys = workspace.read_run().keys
    folder = workspace.folder("mesh", keys["mesh"])
    manifests = dict(manifests_behind(workspace, "mesh", keys))
    seconds = {stage: round(manifest["seconds"], 1) for stage, manifest in manifests.items()}
    shown = moved(read_obj(folder / "mesh.obj"), source.scene.scene_from_sfm)
    train = len(source.scene.of_split("train"))
    facts = {"seconds": round(sum(seconds.values())), "photos": train, "test_photos": None, "off_px": None}
    return Result("ours", shown, True, facts)


def manifests_behind(workspace: Workspace, stage: str, keys: dict[str, str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The manifests of a stage and of all that it was made of; some may come twice."""
    manifest = read_json(workspace.folder(stage, keys[stage]) / "manifest.json")
    yield stage, manifest
    for needed in manifest["inputs"]:
        if needed in keys:
            yield from manifests_behind(workspace, needed, keys)


def rival_result(folder: Path, workspace: Workspace, source: Source) -> Result:
    """The other program's mesh, moved so that its sparse points fall on ours."""
    (file,) = folder.glob("*.obj")
    ours = read_model(workspace.folder("sfm", workspace.read_run().keys["sfm"]) / "sparse")
    theirs = read_model(folder / "cameras")
    here, there = paired_points(ours, theirs)
    here = source.scene.scene_from_sfm.points(here)
    similarity = aligned(there, here)
    test = {Path(view.name).stem for view in source.scene.of_split("test")}
    seconds = json.loads((folder / "seconds.json").read_text("utf-8"))
    facts = {
        "seconds": round(sum(seconds.values())),
        "photos": len(theirs.images),
        "test_photos": sum(Path(image.file).stem in test for image in theirs.images),
        "off_px": round(off_px(source, here, similarity.points(there)), 2),
    }
    return Result(folder.name, moved(read_obj(file), similarity), False, facts)


def paired_points(ours: SparseModel, theirs: SparseModel) -> tuple[np.ndarray, np.ndarray]:
    """The points of two models that show in the same place of a photo: (n, 3) of ours and of theirs, in their own
    frames."""
    numbers = {Path(image.file).stem: number for number, image in enumerate(ours.images)}
    pairs = [np.zeros((0, 2), np.int64)]
    for number, image in enumerate(theirs.images):
        if (own := numbers.get(Path(image.file).stem)) is None:
            continue
        here, there = ours.view == own, theirs.view == number
        sizes = (ours.cameras[ours.images[own].camera].width, theirs.cameras[image.camera].width)
        found = KDTree(ours.xy[here]).query(theirs.xy[there] * sizes[0] / sizes[1])
        distance, nearest = np.asarray(found[0]), np.asarray(found[1], np.int64)
        near = distance < MAX_PAIR_PX
        pairs.append(np.stack([ours.point[here][nearest[near]], theirs.point[there][near]], axis=1))
    pair = np.unique(np.concatenate(pairs), axis=0)
    return ours.xyz[pair[:, 0]], theirs.xyz[pair[:, 1]]


def aligned(points: np.ndarray, targets: np.ndarray) -> Similarity:
    """The similarity that brings points (n, 3) to their targets, without those that stay far off."""
    used = np.ones(len(points), bool)
    for _ in range(ALIGNMENT_ROUNDS):
        distance = np.linalg.norm(align(points[used], targets[used]).points(points) - targets, axis=1)
        used = distance <= MAX_DEVIATION * np.median(distance)
    return align(points[used], targets[used])


def off_px(source: Source, points: np.ndarray, others: np.ndarray) -> float:
    """The median distance between points (n, 3) and others of the scene frame in our training photos, in pixels."""
    distances = []
    for view in source.scene.of_split("train"):
        photo = photo_of(view, source.scene, source.ingest, source.info)
        here, there = projected(photo, points), projected(photo, others)
        both = here.inside & there.ahead
        distances.append(np.linalg.norm(here.pixels[both] - there.pixels[both], axis=1))
    return float(np.median(np.concatenate(distances)))


def photo_scores(
    results: list[Result], source: Source, photo: Photo, pictures: Path | None
) -> list[tuple[Score, Score]]:
    """Of each mesh in a test photo, on what it covers and on what all of them cover."""
    truth, unmasked = truth_of(source, photo)
    height, width = unmasked.shape
    as_it_is = photo._replace(effects=(), shown=())
    drawn = [looks(each.mesh, True, photo if each.is_ours else as_it_is, width, height) for each in results]
    common = np.logical_and.reduce([covered for _, covered in drawn]) & unmasked
    if pictures:
        write_strip(pictures, photo, [truth, *(image for image, _ in drawn)])
    return [(scored(image, truth, covered & unmasked), scored(image, truth, common)) for image, covered in drawn]


def scored(image: np.ndarray, truth: np.ndarray, used: np.ndarray) -> Score:
    """The score of the ``used`` pixels of a photo."""
    return Score(float(used.mean()), *scores(image, truth, used), scores(fitted(image, truth, used), truth, used)[0])


def fitted(image: np.ndarray, truth: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The image (h, w, 3), sRGB in [0, 1], times the gain of each channel in linear light that fits it best to the
    ``used`` pixels of the photo."""
    shown, photo = linear_light(image), linear_light(truth)
    gain = (shown * photo)[used].sum(axis=0) / np.maximum((shown**2)[used].sum(axis=0), np.finfo(np.float32).tiny)
    return srgb_values(shown * gain).clip(0, 1)


def rows(workspace: Workspace, rivals: list[Path], pictures: Path | None) -> Iterator[dict[str, Any]]:
    """A row for each mesh of a set, ours first."""
    keys = workspace.read_run().keys
    source = load({stage: workspace.folder(stage, keys[stage]) for stage in mesh.STAGE.inputs}, SilentProgress())
    results = [our_result(workspace, source), *(rival_result(folder, workspace, source) for folder in rivals)]
    photos = [photo_of(view, source.scene, source.ingest, source.info) for view in source.scene.of_split("test")]
    found = [photo_scores(results, source, photo, pictures) for photo in photos]
    for result, of_photos in zip(results, zip(*found, strict=True), strict=True):
        own, common = ([pair[kind] for pair in of_photos] for kind in (0, 1))
        yield {
            "set": workspace.root.name,
            "program": result.name,
            **result.facts,
            "faces": len(result.mesh.faces),
            **means("covered", own),
            **means("common", common),
        }


def means(kind: str, found: list[Score]) -> dict[str, float]:
    """Share in percent, PSNR in dB, SSIM, and PSNR in dB with the exposure fitted, means over the photos."""
    return {
        f"{kind}_percent": round(100 * float(np.mean([score.share for score in found])), 1),
        f"{kind}_db": round(float(np.mean([score.psnr for score in found])), 2),
        f"{kind}_ssim": round(float(np.mean([score.ssim for score in found if score.ssim is not None])), 3),
        f"{kind}_fitted_db": round(float(np.mean([score.psnr_fitted for score in found])), 2),
    }


def main() -> None:
    """Print a row per set and program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--set", type=Path, nargs="+", action="append", required=True, help="our workspace, then the other's folders"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of every held-out photo")
    add_out(parser)
    given = parser.parse_args()
    record = Record(given.out)
    for ours, *rivals in given.set:
        pictures = None if given.pictures is None else given.pictures / ours.name
        for row in rows(Workspace.existing(ours), rivals, pictures):
            record.add(**row)


if __name__ == "__main__":
    main()
