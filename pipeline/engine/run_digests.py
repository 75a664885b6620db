"""Digests of what a run's results rest on: its photos, its options, and what of a stage's config enters its key."""

import os
from collections.abc import Mapping
from typing import Any

from pipeline.engine import run_file
from pipeline.engine.cache_keys import ContentIndex, config_for_key, digest
from pipeline.engine.display import Display
from pipeline.engine.stage_list import SOURCE
from pipeline.engine.workspace import Workspace
from stages.contract import Stage, StageConfig
from stages.ingest.sources import find_source, is_gone


class RunDigests:
    """Those of one run in a workspace. Its photos are listed, and files hashed, once."""

    def __init__(
        self, workspace: Workspace, run: run_file.RunFile, stages: Mapping[str, Stage], source: Any, display: Display
    ) -> None:
        """``source``: the config of the stage that reads the photos."""
        self.root, self.run_file, self.stages, self.source, self.display = workspace.root, run, stages, source, display
        self.index = ContentIndex(workspace.root / ".content.json")
        self._photos: str | None = None

    def of_options(self) -> str:
        """Of what a budget is kept for: a study has its own time."""
        recorded = run_file.portable(self.run_file.options, self.root)
        return digest({name: recorded[name] for name, stage in self.stages.items() if not stage.on_request})

    def of_photos(self) -> str:
        """Of the photos' names and bytes; the last known one where the photos are gone but were ingested."""
        if self._photos is not None:
            return self._photos
        if (known := self.run_file.photos_digest) and is_gone(self.source.photos):
            return known
        source = find_source(self.source.photos, self.source.cameras, self.source.photo_list)
        self.display.update("reading the video" if source.kind == "video" else f"reading {len(source.files)} photos")
        files = self.index.of_files(source.root, (*source.files, *(mask for _, mask in source.masks)))
        masks = [(name, os.path.relpath(mask, source.root)) for name, mask in source.masks]
        self._photos = digest({"kind": source.kind, "frames": source.frames, "masks": masks, "files": files})
        self.run_file.photos_digest = self._photos
        return self._photos

    def forget_photos(self) -> None:
        """List them again when they are next asked for: it may be hours since they were."""
        self._photos = None

    def config_for_key(self, stage: str, config: StageConfig) -> dict[str, Any]:
        """What of the config of ``stage`` enters its key, as JSON values; files by their content."""
        replaced = {"photos": self.of_photos()} if stage == SOURCE else {}
        return config_for_key(config, self.index, replaced, self.stages[stage].not_hashed)
