"""viewer.html: the contents packed into one file with the scripts and shaders that draw them."""

import base64
import gzip
import json
import struct
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from stages.contract import StageResult
from stages.io.amounts import bytes_in_words
from stages.viewer.contents import Contents

FILES = Path(__file__).with_name("page")
SHADERS = ("space", "field", "march", "overlay")
SCRIPTS = ("geometry", "contents", "graphics", "renderer", "overlay", "navigation", "path", "panels", "main")
ALIGNMENT = 8  # of a section, for typed arrays


def save(contents: Contents, folder: Path) -> StageResult:
    """Write viewer.html."""
    payload = packed(contents)
    text = page(contents.header["field"] is not None, payload)
    (folder / "viewer.html").write_text(text, "utf-8")
    size = (folder / "viewer.html").stat().st_size
    if contents.loss_db is None:
        return StageResult(("viewer.html",), "this field cannot be shown in a browser", facts={"drawn": False})
    bits = contents.header["field"]["bits"]
    facts = {"drawn": True, "bits": bits, "loss_db": contents.loss_db, "bytes": size}
    line = f"{bytes_in_words(size)} · {bits} bits a number, {contents.loss_db:+.3f} dB lost"
    return StageResult(("viewer.html",), line, facts=facts)


def packed(contents: Contents) -> str:
    """Header and sections as gzip in base64: the header's length, the header, the sections at the places that it says,
    counted from behind the header. Names of photos stand in there alone, so no HTML ever holds them."""
    places, body = dict[str, tuple[int, int]](), bytearray()
    for name, content in contents.sections.items():
        places[name] = len(body), len(content)
        body += content + bytes(-len(content) % ALIGNMENT)
    header = json.dumps({**contents.header, "sections": places}, allow_nan=False).encode()
    header += b" " * (-(len(header) + 4) % ALIGNMENT)
    whole = struct.pack("<I", len(header)) + header + bytes(body)
    return base64.b64encode(gzip.compress(whole, 9, mtime=0)).decode("ascii")


def page(drawn: bool, payload: str) -> str:
    """The HTML around it."""
    environment = Environment(
        loader=FileSystemLoader(FILES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    parts: dict[str, Any] = {"drawn": drawn, "payload": Markup(payload), "style": Markup(_text("style.css"))}
    shaders = json.dumps({name: _text(f"{name}.glsl") for name in SHADERS})
    script = "\n".join([f"const SHADERS = {shaders};", *(_text(f"{name}.js") for name in SCRIPTS)])
    return environment.get_template("page.html.j2").render(**parts, script=Markup(script))


def _text(name: str) -> str:
    return (FILES / name).read_text("utf-8")
