"""The calibrated scene: cameras, views and the similarity between the sfm frame and ours.

Plain numpy float64 and no disk; ``to_json`` and ``from_json`` convert to and from JSON values.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

Split = Literal["train", "validation", "test"]
"""Validation photos are set aside from the training photos while a run is made that asks for them; no file has any."""
SCHEMA_VERSION = 4


@dataclass(frozen=True)
class Camera:
    """Intrinsics as COLMAP names them: ``model`` ("OPENCV", ...), size in pixels, ``params`` in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Similarity:
    """x' = scale · rotation @ x + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def points(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map points."""
        return self.scale * points @ self.rotation.T + self.translation

    def pose(self, from_camera: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
        """Map a camera pose [R | centre]; the rotation part stays orthonormal."""
        rotation = self.rotation @ from_camera[:, :3]
        return np.concatenate([rotation, self.points(from_camera[:, 3])[:, None]], axis=1)

    def inverse(self) -> "Similarity":
        """The similarity that undoes this one."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The homogeneous matrix of this similarity."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix


@dataclass(frozen=True)
class View:
    """One photo with its pose. ``near`` and ``far`` are distances along the unit ray in scene units. ``mask`` is a grey
    picture of the photo's size inside ingest's folder, 0 where the photo is to be ignored; None: nowhere. ``alpha`` is
    another one, 0 where the photo is transparent and 255 where it is opaque; None: its own alpha tells, if any."""

    name: str  # the photo's own name
    file: str  # the decoded image inside ingest's folder
    camera: int  # index into Scene.cameras
    scene_from_camera: Float[np.ndarray, "3 4"]
    near: float
    far: float
    split: Split
    mask: str | None = None
    alpha: str | None = None


# Of 255, in each channel: within this a colour is that of a plain backdrop. Deviations spread evenly over it have a
# root mean square of 0.018 of the range of colours, twice the MIN_EFFECT of nerf/effects/statistics/statistic.py: with
# more, leaving the backdrop out would be seen.
BACKDROP_TOLERANCE = 8


@dataclass(frozen=True)
class Scene:
    """Everything that training and rendering need to know of the geometry.

    ``bounded``: all that the photos show lies inside the region of interest; otherwise space beyond it is contracted
    (nerf/geometry/space_maps/contraction.py). ``has_alpha``: the photos' alpha, or masks in its place, says what is
    background. ``backdrop``: without alpha, the one colour (sRGB in [0, 1]) that the photos show wherever nothing of
    the scene is; None: they show other things. ``capture_type``: cameras around an object, cameras that look outward or
    through a room, or all facing one way.
    """

    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    scene_from_sfm: Similarity
    bounded: bool
    has_alpha: bool
    capture_type: Literal["object-centric", "inside-out", "forward-facing"]
    up_known: bool
    backdrop: tuple[float, float, float] | None = None

    def of_split(self, split: Split) -> tuple[View, ...]:
        """The views of one split, in order of name."""
        return tuple(view for view in self.views if view.split == split)

    def indices_of(self, split: Split) -> list[int]:
        """Where the views of one split are among all of them."""
        return [index for index, view in enumerate(self.views) if view.split == split]

    def to_json(self) -> dict[str, Any]:
        """This scene as JSON values."""
        similarity = self.scene_from_sfm
        return {
            "version": SCHEMA_VERSION,
            "cameras": [vars(c) | {"params": list(c.params)} for c in self.cameras],
            "views": [vars(v) | {"scene_from_camera": v.scene_from_camera.tolist()} for v in self.views],
            "scene_from_sfm": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "bounded": self.bounded,
            "has_alpha": self.has_alpha,
            "capture_type": self.capture_type,
            "up_known": self.up_known,
            "backdrop": self.backdrop,
        }

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> "Scene":
        """The inverse of :meth:`to_json`. Raises ValueError for another schema version."""
        value = dict(value)
        if (version := value.pop("version", None)) != SCHEMA_VERSION:
            raise ValueError(f"scene.json has version {version}, this program reads version {SCHEMA_VERSION}")
        cameras = tuple(Camera(**c | {"params": tuple(c["params"])}) for c in value.pop("cameras"))
        views = tuple(
            View(**v | {"scene_from_camera": np.array(v["scene_from_camera"], float)}) for v in value.pop("views")
        )
        s = value.pop("scene_from_sfm")
        similarity = Similarity(s["scale"], np.array(s["rotation"], float), np.array(s["translation"], float))
        red_green_blue = value.pop("backdrop")
        backdrop = None if red_green_blue is None else tuple(red_green_blue)
        return cls(cameras=cameras, views=views, scene_from_sfm=similarity, backdrop=backdrop, **value)
