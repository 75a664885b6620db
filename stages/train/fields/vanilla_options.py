"""The options of the vanilla NeRF."""

from typing import ClassVar, Literal

from pydantic import Field

from stages.contract import Options


class VanillaOptions(Options):
    """How to train the vanilla NeRF."""

    tells_ray_gradients: ClassVar[bool] = False
    predicts_gains: ClassVar[bool] = False  # its learning rate falls all the way

    batch_rays: int | None = Field(default=None, ge=1, description="rays in a step (default: from the preset)")
    depth: int | None = Field(default=None, ge=1, description="layers before the density (default: from the preset)")
    width: int | None = Field(default=None, ge=2, description="units of each layer (default: from the preset)")
    skip: int | None = Field(
        default=None, ge=0, description="index of the layer after which the position enters again (default: 4)"
    )
    position_frequencies: int = Field(default=10, ge=1, description="L of the positional encoding of the position")
    direction_frequencies: int = Field(default=4, ge=1, description="L of the positional encoding of the direction")
    samples_coarse: int | None = Field(
        default=None, ge=2, description="on each ray, for the coarse network (default: from the preset)"
    )
    samples_fine: int | None = Field(
        default=None, ge=1, description="on each ray, placed by the coarse network's weights (default: from the preset)"
    )
    positional_encoding: bool = Field(default=True, description="lift coordinates to sines and cosines")
    hierarchical: bool = Field(default=True, description="place fine samples by a coarse network")
    density_activation: Literal["softplus", "relu"] = Field(default="softplus", description="relu is as published")
    spacing: Literal["linear", "log"] | None = Field(
        default=None, description="of coarse samples (default: log in contracted space)"
    )
