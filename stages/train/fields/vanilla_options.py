"""The options of the vanilla NeRF."""

from typing import ClassVar, Literal

from pydantic import Field

from stages.contract import Auto, Options


class VanillaOptions(Options):
    """How to train the vanilla NeRF."""

    tells_ray_gradients: ClassVar[bool] = False
    predicts_gains: ClassVar[bool] = False  # its learning rate falls all the way

    batch_rays: Auto[int] = Field(default=None, ge=1, description="Rays per step (default: from the preset).")
    depth: Auto[int] = Field(default=None, ge=1, description="Layers before the density (default: from the preset).")
    width: Auto[int] = Field(default=None, ge=2, description="Units per layer (default: from the preset).")
    skip: Auto[int] = Field(
        default=None,
        ge=0,
        description="Index of the layer after which the position is concatenated again (default: 4).",
    )
    position_frequencies: int = Field(
        default=10, ge=1, description="Frequencies L of the positional encoding of the position."
    )
    direction_frequencies: int = Field(
        default=4, ge=1, description="Frequencies L of the positional encoding of the direction."
    )
    samples_coarse: Auto[int] = Field(
        default=None, ge=2, description="Samples per ray of the coarse network (default: from the preset)."
    )
    samples_fine: Auto[int] = Field(
        default=None, ge=1, description="Additional samples per ray of the fine network (default: from the preset)."
    )
    positional_encoding: bool = Field(default=True, description="Apply the positional encoding.")
    hierarchical: bool = Field(default=True, description="Sample hierarchically, with a coarse and a fine network.")
    density_activation: Literal["softplus", "relu"] = Field(
        default="softplus", description="Activation of the density; relu is the published one."
    )
    spacing: Auto[Literal["linear", "log"]] = Field(
        default=None, description="Spacing of the coarse samples (default: log in contracted space, else linear)."
    )
