"""What the demo knows of its scene, and how far a reconstruction is from it.

Errors of position and of the mesh are shares of the scene's size, the diameter of the table. The reconstruction's own
frame is arbitrary, so it is first brought onto the truth by the similarity that fits the camera centres best.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from nerf.geometry.alignment import align
from nerf.geometry.scene import Camera, Similarity
from nerf.synthetic.scenes import TABLE_RADIUS, SyntheticScene, still_life
from stages.io.files import read_json, write_json
from stages.io.transforms_export import OPENGL_FROM_OPENCV
from stages.mesh.surface import sample_surface

MAX_ROTATION_DEG, MAX_POSITION_PERCENT = 0.5, 1.0  # what the demo promises of its worst camera
MESH_SAMPLES = 200_000  # on a perfect mesh these are 0.17 % of the scene's size from a point at random
TRUE_SAMPLES = 30_000
SEEN_TOLERANCE = 1e-3  # scene units; a ray that ends this close to a surface point has reached it


@dataclass(frozen=True)
class Truth:
    """The cameras and the scene of a set of synthetic photos; ``poses`` are world_from_camera by photo name."""

    camera: Camera
    poses: Mapping[str, Float[np.ndarray, "3 4"]]
    seed: int

    def write(self, path: Path) -> None:
        """Write truth.json."""
        write_json(path, self.to_json())

    def to_json(self) -> dict[str, Any]:
        """This truth as JSON values."""
        poses = {name: pose.tolist() for name, pose in self.poses.items()}
        camera = asdict(self.camera) | {"params": list(self.camera.params)}
        return {"camera": camera, "world_from_camera": poses, "seed": self.seed}

    @classmethod
    def read(cls, path: Path) -> "Truth":
        """The inverse of :meth:`write`. Raises StageError where the file is not readable."""
        value = read_json(path)
        camera = Camera(**value["camera"] | {"params": tuple(value["camera"]["params"])})
        poses = {name: np.array(pose, float) for name, pose in value["world_from_camera"].items()}
        return cls(camera, poses, value["seed"])


class MeshError(NamedTuple):
    """Mean distances in percent of the scene's size.

    ``accuracy``: from the mesh to the true surface, all of it, by its signed distance. ``completeness``: to the mesh
    from those parts of the true surface that at least one camera sees, for nobody can ask for the others.
    ``chamfer``: their mean.
    """

    accuracy: float
    completeness: float
    chamfer: float


@dataclass(frozen=True)
class Comparison:
    """A reconstruction against the truth; arrays have one entry per registered photo, in order of name."""

    photos: int
    rotation_deg: Float[np.ndarray, "registered"]
    position_percent: Float[np.ndarray, "registered"]
    focal_percent: float
    mesh: MeshError | None

    def holds(self) -> bool:
        """Whether every photo is registered and within the demo's promise."""
        worst_rotation, worst_position = self.rotation_deg.max(), self.position_percent.max()
        complete = len(self.rotation_deg) == self.photos
        return bool(complete and worst_rotation <= MAX_ROTATION_DEG and worst_position <= MAX_POSITION_PERCENT)

    def lines(self) -> list[str]:
        """For the user to read."""
        rotation, position = self.rotation_deg, self.position_percent
        said = [
            f"cameras    {len(rotation)}/{self.photos} registered · rotation off by {np.median(rotation):.3f}°, at "
            f"worst {rotation.max():.3f}° · position by {np.median(position):.3f}%, at worst {position.max():.3f}% "
            f"of the scene's size · focal length by {self.focal_percent:+.2f}%",
            f"promise    every camera within {MAX_ROTATION_DEG}° and {MAX_POSITION_PERCENT:g}%: "
            + ("kept" if self.holds() else "NOT kept"),
        ]
        if self.mesh is not None:
            accuracy, completeness, chamfer = self.mesh
            said.append(
                f"mesh       {chamfer:.2f}% of the scene's size from the true surface (two-sided chamfer: mesh to "
                f"truth {accuracy:.2f}%, what the photos show of the truth to mesh {completeness:.2f}%)"
            )
        return said


def compare_with_truth(output: Path, truth: Truth) -> Comparison:
    """Compare a workspace's output folder (transforms.json and, where it is there, mesh.ply) with the truth.

    Raises StageError for a missing or damaged transforms.json, ValueError if too few cameras are registered.
    """
    content = read_json(output / "transforms.json")
    found = {frame["photo"]: np.array(frame["transform_matrix"])[:3] for frame in content["frames"]}
    names = sorted(found)
    estimated = np.stack([found[name] for name in names])
    estimated[:, :, :3] = estimated[:, :, :3] @ OPENGL_FROM_OPENCV
    true = np.stack([truth.poses[name] for name in names])
    truth_from_sfm = align(estimated[:, :, 3], true[:, :, 3])
    aligned = np.stack([truth_from_sfm.pose(pose) for pose in estimated])
    percent = 100 / (2 * TABLE_RADIUS)
    mesh = output / "mesh.ply"
    return Comparison(
        photos=len(truth.poses),
        rotation_deg=_angles_deg(aligned[:, :, :3], true[:, :, :3]),
        position_percent=percent * np.linalg.norm(aligned[:, :, 3] - true[:, :, 3], axis=1),
        focal_percent=_focal_percent(content, truth.camera),
        mesh=_mesh_error(mesh, truth_from_sfm, truth, percent) if mesh.exists() else None,
    )


def _angles_deg(a: Float[np.ndarray, "n 3 3"], b: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n"]:
    """Angle between rotations; from the chord |a - b| = 2 sqrt(2) sin(angle / 2), exact for small angles too."""
    chord = np.linalg.norm(a - b, axis=(1, 2)) / (2 * np.sqrt(2))
    return np.degrees(2 * np.arcsin(np.minimum(chord, 1)))


def _focal_percent(transforms: Mapping[str, Any], camera: Camera) -> float:
    """How much longer the mean estimated focal length is than the true one."""
    frames = [transforms | frame for frame in transforms["frames"]]
    estimated = np.mean([[frame["fl_x"], frame["fl_y"]] for frame in frames])
    return float(100 * (estimated / np.mean(camera.params[:2]) - 1))


def _mesh_error(mesh: Path, truth_from_sfm: Similarity, truth: Truth, percent: float) -> MeshError:
    loaded = trimesh.load_mesh(mesh, process=False)
    vertices = truth_from_sfm.points(np.asarray(loaded.vertices, float))
    sampled = sample_surface(vertices, np.asarray(loaded.faces), MESH_SAMPLES, seed=0)
    scene = still_life(truth.seed)
    accuracy = percent * scene.distance(torch.from_numpy(sampled)).abs().mean().item()
    points, normals = scene.surface_points(TRUE_SAMPLES, seed=0)
    centres = torch.tensor(np.stack([pose[:, 3] for pose in truth.poses.values()]), dtype=torch.float32)
    asked = points[seen(scene, points, normals, centres)].numpy()
    completeness = percent * float(KDTree(sampled).query(asked)[0].mean())
    return MeshError(accuracy, completeness, (accuracy + completeness) / 2)


def seen(scene: SyntheticScene, points: torch.Tensor, normals: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Which surface points (n, 3) face at least one of the camera centres (m, 3) with nothing in between.

    The edges of the photos are not looked at: all of them show nearly the whole still life.
    """
    visible = torch.zeros(len(points), dtype=torch.bool)
    for centre in centres:
        (open_,) = torch.where(~visible & ((normals * (centre - points)).sum(-1) > 0))
        towards = points[open_] - centre
        distance = towards.norm(dim=-1)
        directions = towards / distance[:, None]
        first = scene.intersect(centre.expand_as(directions), directions).amin(0)
        visible[open_] = first > distance - SEEN_TOLERANCE
    return visible
