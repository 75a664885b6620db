"""index.html of a batch: its scenes ranked by PSNR, each with a picture, and what failed with the reason."""

from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from PIL import Image

from pipeline.batch.batch_file import BatchFile, SceneState
from stages.io.amounts import counted, duration
from stages.io.files import write_durably
from stages.report.html import jpeg_uri, templates

PAGE = "index.html"
PICTURE_PX = 360
LINKED = {"viewer.html": "viewer", "report.html": "report", "mesh.glb": "mesh", "video.mp4": "video"}


def write_page(folder: Path, batch: BatchFile) -> None:
    """Write the page of the batch in ``folder``, whose workspaces lie beside it. Raises OSError."""
    environment = templates(Path(__file__).parent)
    environment.filters |= {"counted": counted, "duration": duration}
    scenes = list(batch.scenes.items())
    done = [(name, scene) for name, scene in scenes if scene.state == "done"]
    page = environment.get_template("batch.html.j2").render(
        budget=batch.budget,
        count=len(scenes),
        spent=sum(scene.spent for _, scene in scenes),
        ranked=[_entry(folder, name, scene) for name, scene in sorted(done, key=lambda pair: -_rank(pair[1]))],
        failed=[(name, scene, f"{name}.log") for name, scene in scenes if scene.state == "failed"],
        waiting=[(name, scene.state) for name, scene in scenes if scene.state in ("waiting", "running")],
    )
    write_durably(folder / PAGE, page.encode())


def _rank(scene: SceneState) -> float:
    psnr = scene.figures.get("psnr")
    return float("-inf") if psnr is None else float(psnr)


def _entry(folder: Path, name: str, scene: SceneState) -> dict[str, Any]:
    output = folder / f"{name}.nerf" / "output"
    found = {words: f"{name}.nerf/output/{file}" for file, words in LINKED.items() if (output / file).exists()}
    return {"name": name, "scene": scene, "links": found, "picture": _picture(output / "renders")}


def _picture(renders: Path) -> str | None:
    """A small render of a test photo as a data URI; None where there is none that can be read."""
    with suppress(OSError):
        for file in sorted(renders.glob("*.png"))[:1]:
            return _shrunk(file, file.stat().st_mtime_ns)
    return None


@cache
def _shrunk(file: Path, changed_ns: int) -> str:
    """``changed_ns`` tells a new picture under an old name; the page is written twice for each scene."""
    with Image.open(file) as image:
        image.thumbnail((PICTURE_PX, PICTURE_PX))
        return jpeg_uri(image.convert("RGB"))
