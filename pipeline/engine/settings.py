"""All options of a run: one pydantic model per stage, made from the list of stages."""

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, create_model

from pipeline.engine.stage_list import STAGES

if TYPE_CHECKING:

    class Settings(BaseModel):
        """The options of every stage, by its name."""

        def __init__(self, **options: Any) -> None: ...

        def __getattr__(self, stage: str) -> Any: ...

else:
    Settings = create_model(
        "Settings",
        __doc__='The options of every stage, as the user gave them: None still means "choose for me".',
        __config__=ConfigDict(extra="forbid", frozen=True),
        **{name: (stage.config, stage.config()) for name, stage in STAGES.items()},
    )
