"""Large synthetic photo sets of places that repeat themselves, with exactly known cameras; and a score against them.

    python -m benchmarks.large_sets draw {rings,corridor,corridor_in_step,facades} FOLDER [--photos N] [--shuffle]
    python -m benchmarks.large_sets score TRUTH_JSON SPARSE_FOLDER INGEST_FOLDER

``draw`` writes photos of 480 × 360 into FOLDER and the true cameras beside it, into truth.json: so each set needs a
folder of its own around FOLDER. Photos that exist already are kept, and an interrupted run goes on where it stopped.
Names follow the walk; with ``--shuffle`` they are in random order and say nothing.

* ``rings``: 300 photos in three rings around a table with one tile laid again and again, plain areas and a few distinct
  things, in a room with the same wallpaper on two walls, plain ones with pictures, and two equal cupboards.
* ``corridor``: 300 photos of a walk along a corridor of equal doors, lamps and floor tiles, and back; pictures hang and
  boxes stand here and there. Looks swing from wall to wall, and are the mirror image on the way back.
* ``corridor_in_step``: the same, but a swing takes as long as four doors, so that photos a swing apart show the same;
  and looks swing so far that the right pairs alone do not hold it together. It is to be named, not solved.
* ``facades``: 120 photos around a building whose two long sides are the same but for a few signs and flower boxes. The
  two short sides are unlike each other.

``score`` reads what stage sfm made of a set: SPARSE_FOLDER is its COLMAP model, INGEST_FOLDER knows the photos' names.
Cameras count as placed within 0.5 % of the largest distance between true centres, and as turned right within 1 degree,
after the similarity that suits most of them.
"""

import argparse
import math
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.record import Record, add_out
from benchmarks.repeating_places import SETS, Poses
from nerf.geometry.alignment import align
from nerf.geometry.pose_distance import rotation_angles
from nerf.geometry.scene import Camera, Similarity
from nerf.synthetic.scenes import Solid, photograph
from stages.io.files import read_json, write_jpeg, write_json
from stages.io.photos import read_photos
from stages.sfm.colmap.cameras import camera_rays
from stages.sfm.colmap.models import read_model

LENS = Camera("SIMPLE_RADIAL", 480, 360, (400.0, 240.0, 180.0, -0.04))
QUALITY = 95  # of the JPEG files


def in_view(solids: tuple[Solid, ...], pose: Tensor, widest: float, margin: float) -> tuple[Solid, ...]:
    """The solids that reach to within ``margin`` of a cone around the viewing direction, ``widest`` radians to every
    side of it."""

    def beyond(solid: Solid) -> float:
        to_centre = (solid.world_from_shape[:, 3] - pose[:, 3]) @ pose[:, :3]
        aside = math.hypot(float(to_centre[0]), float(to_centre[1]))
        return aside * math.cos(widest) - float(to_centre[2]) * math.sin(widest)

    return tuple(solid for solid in solids if beyond(solid) < solid.shape.reach + margin)


def draw(name: str, folder: Path, count: int, shuffle: bool) -> None:
    """Write the photos that are not there yet, and truth.json beside them."""
    place, random = SETS[name], np.random.default_rng(0)
    poses = place.poses(count, random)
    numbers = random.permutation(count) if shuffle else np.arange(count)
    files = [f"{number:04d}.jpg" for number in numbers]
    lens = vars(LENS) | {"params": list(LENS.params)}
    truth = {"camera": lens, "world_from_camera": dict(zip(files, poses.tolist(), strict=True))}
    folder.mkdir(parents=True, exist_ok=True)
    beside = folder.parent / "truth.json"
    if beside.exists() and read_json(beside) != truth:
        raise SystemExit(f"{beside} is the truth of another set: choose another folder")
    write_json(beside, truth)
    scene, directions = place.scene(count), torch.from_numpy(camera_rays(LENS, LENS.width, LENS.height))
    widest = math.acos(float(directions[..., 2].min()))
    begin, drawn = time.perf_counter(), 0
    for file_name, world_from_camera in zip(files, poses, strict=True):
        file = folder / file_name
        if file.exists():
            continue
        pose = torch.from_numpy(world_from_camera).float()
        seen = scene._replace(solids=in_view(scene.solids, pose, widest, place.shading))
        with torch.inference_mode():
            image = photograph(seen, directions, pose, 1)
        part = folder.parent / f"{file.name}.part"
        write_jpeg(part, (255 * image).round().byte().numpy(), QUALITY)
        part.replace(file)  # whole or not at all: what is there counts as drawn
        drawn += 1
        if drawn % 20 == 0:
            print(f"{drawn} photos, {(time.perf_counter() - begin) / drawn:.2f} s each", flush=True)


CENTRE_SHARE, TURN_DEG = 0.005, 1.0  # a camera is right within this share of the scene's size, and this angle
TRIALS = 1000
WORST = 15


class Errors(NamedTuple):
    """How far cameras are from where they were: in shares of the scene's size, and in degrees."""

    share: Float[np.ndarray, "n"]
    turn_deg: Float[np.ndarray, "n"]

    @property
    def good(self) -> np.ndarray:
        return (self.share < CENTRE_SHARE) & (self.turn_deg < TURN_DEG)


def errors(world_from_sfm: Similarity, found: Poses, true: Poses, size: float) -> Errors:
    """Of every camera after a similarity."""
    share = np.linalg.norm(world_from_sfm.points(found[:, :, 3]) - true[:, :, 3], axis=1) / size
    turn = rotation_angles(world_from_sfm.rotation @ found[:, :, :3], true[:, :, :3])
    return Errors(share, np.rad2deg(turn))


def fit(found: Poses, true: Poses, scale: float, arm: float) -> Similarity:
    """The similarity between cameras, of which each counts as its centre and points ``arm`` before it along its axes.

    Centres alone leave open how a straight walk turns around its line. ``scale``, true over found, is needed for equal
    arms; that of the result is closer to the truth.
    """
    ends = np.concatenate([np.zeros((3, 1)), np.eye(3), -np.eye(3)], axis=1)

    def marks(poses: Poses, length: float) -> np.ndarray:
        return (poses[:, :, 3:] + length * poses[:, :, :3] @ ends).transpose(0, 2, 1).reshape(-1, 3)

    return align(marks(found, arm / scale), marks(true, arm))


def robust_fit(found: Poses, true: Poses, size: float) -> Similarity:
    """The similarity under which most cameras are right, from random pairs of them, then from all right ones."""
    random = np.random.default_rng(0)
    arm = size * CENTRE_SHARE / math.radians(TURN_DEG)  # the largest errors allowed move an arm's end equally far
    best, most = None, -1
    for _ in range(TRIALS):
        pair = random.choice(len(found), 2, replace=False)
        spans = [np.linalg.norm(np.diff(poses[pair, :, 3], axis=0)) for poses in (true, found)]
        if min(spans) == 0:
            continue
        similarity = fit(found[pair], true[pair], float(spans[0] / spans[1]), arm)
        right = int(errors(similarity, found, true, size).good.sum())
        if right > most:
            best, most = similarity, right
    if best is None:
        raise SystemExit("fewer than two different cameras were found")
    for _ in range(5):
        right = errors(best, found, true, size).good
        if right.sum() < 2:
            break
        best = fit(found[right], true[right], best.scale, arm)
    return best


def score(truth_json: Path, sparse: Path, ingest_folder: Path, record: Record) -> None:
    """Record how many cameras are where they were, and which are farthest off."""
    truth = {name: np.array(pose) for name, pose in read_json(truth_json)["world_from_camera"].items()}
    names = {photo.image_name: photo.name for photo in read_photos(ingest_folder)}
    images = read_model(sparse).images
    if len(images) < 2:
        raise SystemExit(f"registered {len(images)} of {len(truth)}: too few to compare")
    registered = [names[image.file] for image in images]
    found = np.stack([image.sfm_from_camera for image in images])
    true, all_centres = np.stack([truth[name] for name in registered]), np.stack(list(truth.values()))[:, :, 3]
    size = float(np.linalg.norm(all_centres[:, None] - all_centres, axis=2).max())
    off = errors(robust_fit(found, true, size), found, true, size)
    record.add(
        set=truth_json.parent.name,
        attempt=None,
        superseded=False,
        photos=len(truth),
        registered=len(images),
        right=int(off.good.sum()),
        median_share_of_size=round(float(np.median(off.share)), 6),
        largest_share_of_size=round(float(off.share.max()), 6),
        median_deg=round(float(np.median(off.turn_deg)), 4),
        excluded=len(truth) - len(images),
    )
    print(f"farthest off, of {len(images)}:")
    for index in np.argsort(-off.share)[:WORST]:
        print(f"  {registered[index]}  {100 * off.share[index]:9.4f} %  {off.turn_deg[index]:9.4f} degrees")


def main() -> None:
    """Draw a set or score a result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw", help="write the photos of a set and their true cameras")
    drawing.add_argument("name", choices=SETS)
    drawing.add_argument("folder", type=Path, help="for the photos; truth.json goes beside it")
    drawing.add_argument("--photos", type=int, help="instead of the set's own number")
    drawing.add_argument("--shuffle", action="store_true", help="names in random order")
    scoring = commands.add_parser("score", help="compare a COLMAP model with the truth")
    for argument in ("truth_json", "sparse_folder", "ingest_folder"):
        scoring.add_argument(argument, type=Path)
    add_out(scoring)
    arguments = parser.parse_args()
    if arguments.command == "score":
        score(arguments.truth_json, arguments.sparse_folder, arguments.ingest_folder, Record(arguments.out))
    else:
        draw(arguments.name, arguments.folder, arguments.photos or SETS[arguments.name].photos, arguments.shuffle)


if __name__ == "__main__":
    main()
