"""How a scene fills the cube of its field: chosen by what stage effects decided and how the cameras stand."""

from typing import TYPE_CHECKING

import numpy as np

from nerf.geometry.space_maps import Box, SpaceMap
from nerf.geometry.space_maps.contraction import Contraction
from nerf.geometry.space_maps.ndc import MAX_ANGLE_DEG, Ndc, enclosing_ndc
from stages.contract import StageError
from stages.sfm.colmap.cameras import border_rays
from stages.train.config import Config

if TYPE_CHECKING:
    from nerf.geometry.scene import Scene
    from stages.effects.decisions import Decisions, Space

# Of a pyramid, in photos: in a wider one cells are coarser than the contraction's, whose cube has the region of
# interest in 0.45 of its width (docs/experiments/forward_facing.md).
MAX_WIDTH = 2.0
# How many times as far from the hindmost camera as from its own photo the nearest things may be, in NEAR_SHARE of the
# photos: before a camera that walked forwards, cells and samples are as many times too coarse.
MAX_NEAR_RATIO, NEAR_SHARE = 3.0, 0.9


def chosen_space(decisions: "Decisions", scene: "Scene") -> tuple["Space", str]:
    """The space that a field is to have, and the reason in words."""
    if "background" not in decisions.on:
        return "bounded", "bounded: the photos show nothing beyond the region of interest"
    if scene.capture_type != "forward-facing":
        return "contracted", "contracted: the background is unbounded, and the capture is not forward-facing"
    pyramid = enclosing_pyramid(scene)
    if pyramid is None:
        return (
            "contracted",
            "contracted: the capture is forward-facing, but some photos look too far aside for one frustum",
        )
    width = width_in_photos(pyramid, scene)
    spread = f"one frustum {width:.1f} times as wide as a photo's holds the scene"
    if width > MAX_WIDTH:
        return "contracted", f"contracted: the capture is forward-facing, but only {spread}"
    if (ratio := near_ratio(pyramid, scene)) > MAX_NEAR_RATIO:
        walked = f"some cameras stand deep in the scene (what is near them would be {ratio:.0f} times too coarse)"
        return "contracted", f"contracted: the capture is forward-facing, but {walked}"
    return "ndc", f"normalised device coordinates: the capture is forward-facing, and {spread}"


def space_map_of(config: Config, scene: "Scene") -> SpaceMap:
    """The map of the space that ``config`` names, for this scene. Raises StageError where there is none."""
    if config.space != "ndc":
        return map_without_scene(config)
    if (pyramid := enclosing_pyramid(scene)) is None:
        why = f"some photos look more than {MAX_ANGLE_DEG:g} degrees away from the mean viewing direction"
        hint = "Leave out --train.space ndc."
        raise StageError("train.no-pyramid", "cannot train in normalised device coordinates", why, hint)
    return pyramid


def map_without_scene(config: Config) -> SpaceMap:
    """A map that is marched by the same steps, for where there is no scene: the box for normalised device
    coordinates."""
    assert config.space is not None, "plan() chooses it"
    return Contraction() if config.space == "contracted" else Box()


def enclosing_pyramid(scene: "Scene") -> Ndc | None:
    """The space of cameras that face one way, all photos of the scene counted: what test photos show is in it, too.
    None where they do not face one way."""
    of_cameras = [border_rays(camera) for camera in scene.cameras]
    poses = np.stack([view.scene_from_camera for view in scene.views])
    borders = [of_cameras[view.camera] for view in scene.views]
    return enclosing_ndc(poses, borders, np.array([view.near for view in scene.views]))


def width_in_photos(pyramid: Ndc, scene: "Scene") -> float:
    """How many times as wide as a photo the pyramid is at infinity, along the axis where that is more."""
    rays = [border_rays(camera) for camera in scene.cameras]
    own = np.median([np.abs(ray[:, :2] / ray[:, 2:]).max(0) for ray in rays], axis=0)
    return float((np.array(pyramid.slopes) / own).max())


def near_ratio(pyramid: Ndc, scene: "Scene") -> float:
    """How many times as far along the axis from the hindmost camera as from its photo the things at a photo's near
    distance are: at most so many times in NEAR_SHARE of the photos."""
    depth = np.stack([view.scene_from_camera[:, 3] for view in scene.views]) @ np.array(pyramid.axes[2])
    return float(np.quantile(1 + (depth - depth.min()) / [view.near for view in scene.views], NEAR_SHARE))
