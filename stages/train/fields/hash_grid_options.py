"""The options of the hash-grid field."""

from typing import ClassVar, Literal

from pydantic import Field

from stages.contract import Options

MAX_MICRO_BATCHES = 64  # of a step


class HashGridOptions(Options):
    """How to train the hash-grid field."""

    tells_ray_gradients: ClassVar[bool] = True  # so that poses of test photos can be fitted to it
    predicts_gains: ClassVar[bool] = True  # nerf/training/learning_curve.py was fitted to it

    backend: Literal["warp", "torch"] | None = Field(
        default=None, description="its kernels; torch runs anywhere (default: warp where it runs)"
    )
    micro_batches: int | None = Field(
        default=None, ge=1, le=MAX_MICRO_BATCHES, description="of a step, each on a core (default: as many as cores)"
    )
    num_levels: int | None = Field(
        default=None, ge=1, le=16, description="grids of features (default: as the budget allows)"
    )
    log2_hashmap_size: int | None = Field(
        default=None,
        ge=8,
        le=24,
        description="entries of a grid's table, as power of 2 (default: as the budget allows)",
    )
    max_res: int | None = Field(
        default=None, ge=16, le=4096, description="cells along an axis of the finest grid (default: by the photos)"
    )
    target_samples: int | None = Field(
        default=None, ge=256, description="colours computed in a step (default: by the scene and the device)"
    )
    ray_samples: float = Field(
        default=1.0, gt=0, le=16, description="samples along a ray, times what suits its finest cells"
    )
