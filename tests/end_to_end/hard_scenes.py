"""Small photo sets with given cameras, as they are hard to make a scene of; and the whole chain run on them."""

import contextlib
import io
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from nerf.geometry.rays import rays_of_view
from nerf.synthetic.scenes import ring_of_cameras, still_life
from pipeline.cli.commands import run_command
from tests.small_scenes import OPENGL_FROM_OPENCV, pinhole_directions

SIZE, FOCAL_PX = 40, 52.0
SMALL = (
    "--train.steps 300 --train.grid.num-levels 3 --train.grid.log2-hashmap-size 12 --train.grid.max-res 64"
    " --train.grid.target-samples 4096"
    " --train.downscale 1 --render.frames 2 --render.width 32 --mesh.resolution 32 --mesh.formats ply glb"
).split()

Picture = Float[np.ndarray, "height width channels"]
Poses = Float[np.ndarray, "n 3 4"]
RING: Poses = ring_of_cameras(12)


def as_taken(picture: Picture, index: int) -> Picture:
    """The picture as it is."""
    return picture


def over_white(picture: Picture, index: int) -> Picture:
    """Without alpha: nothing says that the background is one."""
    return picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:]


def moved(poses: Poses, scale: float = 1.0, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Poses:
    """The same cameras in another unit, around another place."""
    poses = poses.copy()
    poses[:, :, 3] = scale * poses[:, :, 3] + offset
    return poses


@cache
def _picture(pose: bytes, zoom: float) -> Picture:
    with torch.inference_mode():
        ray_directions = pinhole_directions(SIZE, SIZE, zoom * FOCAL_PX)
        world_from_camera = torch.tensor(np.frombuffer(pose).reshape(3, 4), dtype=torch.float32)
        trace = still_life(0).trace(rays_of_view(ray_directions, world_from_camera, 0.0, 1e5))
        return torch.cat([trace.colour, trace.hit[..., None].float()], -1).double().numpy()


def write_set(
    folder: Path,
    poses: Poses = RING,
    told: Poses | None = None,
    develop: Callable[[Picture, int], Picture] = as_taken,
    **values: Any,
) -> Path:
    """Photos with alpha of the still life from ``poses``, and the path of a transforms.json that tells of ``told``."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, (pose, say) in enumerate(zip(poses, poses if told is None else told, strict=True)):
        name = f"p{index:02d}.png"
        picture = develop(_picture(pose.tobytes(), values.get("fl_x", FOCAL_PX) / FOCAL_PX), index)
        Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(folder / name)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = say[:, :3] @ OPENGL_FROM_OPENCV, say[:, 3]
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    lens = {"w": SIZE, "h": SIZE, "fl_x": FOCAL_PX, "cx": SIZE / 2, "cy": SIZE / 2}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, **values, "frames": frames}))
    return path


class Run(NamedTuple):
    """How `pipeline run` ended: its code, its events, its workspace."""

    code: int
    events: list[dict[str, Any]]
    workspace: Path

    def lines(self, kind: str = "end") -> list[str]:
        """What was said in events of a kind."""
        of_kind = [event for event in self.events if event["event"] == kind]
        return [event.get("line") or event.get("message") or event.get("text", "") for event in of_kind]

    @property
    def error(self) -> tuple[str, str, str]:
        """What, why and hint of the one error."""
        return self._error["what"], self._error["why"], self._error["hint"]

    @property
    def error_code(self) -> str:
        return self._error["code"]

    @property
    def _error(self) -> dict[str, Any]:
        (error,) = (event for event in self.events if event["event"] == "error")
        return error

    def output(self, name: str) -> Path:
        """A file of the current results."""
        return self.workspace / "output" / name

    def read(self, name: str) -> Any:
        """A JSON file of the current results."""
        return json.loads(self.output(name).read_text())


def run(photos: Path, workspace: Path, *flags: str) -> Run:
    """`pipeline run` in this process, with a training of seconds."""
    said, aside = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(aside):
        code = run_command(["run", str(photos), "-o", str(workspace), "--json", *SMALL, *flags])
    assert aside.getvalue() == "", "with --json everything is an event"
    return Run(code, [json.loads(line) for line in said.getvalue().splitlines()], workspace)
