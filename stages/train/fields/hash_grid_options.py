"""The options of the hash-grid field."""

from typing import ClassVar, Literal

from pydantic import Field

from stages.contract import Auto, Options

MAX_MICRO_BATCHES = 64  # of a step


class HashGridOptions(Options):
    """How to train the hash-grid field."""

    tells_ray_gradients: ClassVar[bool] = True  # so that poses of test photos can be fitted to it
    predicts_gains: ClassVar[bool] = True  # nerf/training/learning_curve.py was fitted to it

    backend: Auto[Literal["warp", "torch"]] = Field(
        default=None,
        description="Kernels that compute the field; torch runs anywhere, slowly (default: warp where it runs).",
    )
    micro_batches: Auto[int] = Field(
        default=None,
        ge=1,
        le=MAX_MICRO_BATCHES,
        description="Micro-batches per step, one per core at a time (default: the number of cores).",
    )
    num_levels: Auto[int] = Field(
        default=None, ge=1, le=16, description="Number of resolution levels (default: as the training time allows)."
    )
    log2_hashmap_size: Auto[int] = Field(
        default=None,
        ge=8,
        le=24,
        description="Entries of the hash table of a level, as a power of 2 (default: as the training time allows).",
    )
    max_res: Auto[int] = Field(
        default=None,
        ge=16,
        le=4096,
        description="Resolution of the finest level, in cells per axis (default: from the photos).",
    )
    target_samples: Auto[int] = Field(
        default=None, ge=256, description="Colour evaluations per step (default: from the scene and the device)."
    )
    ray_samples: float = Field(default=1.0, gt=0, le=16, description="Multiplies the number of samples per ray.")
