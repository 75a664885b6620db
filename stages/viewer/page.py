"""viewer.html: the contents packed into one file with the scripts and shaders that draw them."""

import base64
import gzip
import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from stages.contract import StageResult
from stages.io.amounts import bytes_in_words

if TYPE_CHECKING:
    from stages.viewer.contents import Contents

FILES = Path(__file__).with_name("page")
SHADERS = ("space", "field", "march", "overlay")
SCRIPTS = ("geometry", "contents", "graphics", "renderer", "overlay", "navigation", "path", "panels", "main")
NO_NETWORK, OWN_SERVER = 'img-src data: blob:">', "img-src data: blob:; connect-src 'self'\">"  # ends of page policies
ALIGNMENT = 8  # of a section, for typed arrays


def save(contents: "Contents", folder: Path) -> StageResult:
    """Write viewer.html."""
    payload = packed(contents)
    text = page("not drawn" if contents.loss_db is None else "still", payload)
    (folder / "viewer.html").write_text(text, "utf-8")
    size = (folder / "viewer.html").stat().st_size
    if contents.loss_db is None:
        return StageResult(("viewer.html",), "this field cannot be shown in a browser", facts={"drawn": False})
    bits = contents.header["field"]["bits"]
    facts = {"drawn": True, "bits": bits, "loss_db": contents.loss_db, "bytes": size}
    line = f"{bytes_in_words(size)} · {bits} bits a number, {_loss(contents.loss_db)}"
    return StageResult(("viewer.html",), line, facts=facts)


def _loss(loss_db: float) -> str:
    """``0.004 dB lost``: rounding may also happen to gain a little."""
    return f"{abs(loss_db):.3f} dB {'gained' if round(loss_db, 3) < 0 else 'lost'}"


def packed(contents: "Contents") -> str:
    """:func:`binary` as gzip in base64. Names of photos stand in there alone, so no HTML ever holds them."""
    return base64.b64encode(gzip.compress(binary(contents), 9, mtime=0)).decode("ascii")


def binary(contents: "Contents") -> bytes:
    """The header's length, the header in JSON, the sections at the places that it says, counted from behind the header,
    each as typed arrays want it."""
    places, parts, length = dict[str, tuple[int, int]](), list[bytes](), 0
    for name, content in contents.sections.items():
        places[name] = length, len(content)
        parts += [content, bytes(-len(content) % ALIGNMENT)]
        length += len(content) + len(parts[-1])
    header = json.dumps({**contents.header, "sections": places}, allow_nan=False).encode()
    header += b" " * (-(len(header) + 4) % ALIGNMENT)
    return b"".join([struct.pack("<I", len(header)), header, *parts])


def page(kind: Literal["still", "not drawn", "live"], payload: str = "") -> str:
    """The HTML around the contents; of a running training, ``live``, these come from a server."""
    environment = Environment(
        loader=FileSystemLoader(FILES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    parts: dict[str, Any] = {"kind": kind, "payload": Markup(payload), "style": Markup(_text("style.css"))}
    scripts = (*SCRIPTS, "live") if kind == "live" else SCRIPTS
    shaders = json.dumps({name: _text(f"shaders/{name}.glsl") for name in SHADERS})
    script = "\n".join([f"const SHADERS = {shaders};", *(_text(f"{name}.js") for name in scripts)])
    return environment.get_template("page.html.j2").render(**parts, script=Markup(script))


def watching(text: str) -> str:
    """A page of a finished training, as a server hands it out: another training that has begun takes its place."""
    if text.count(NO_NETWORK) != 1:  # made by another version, whose policy would forbid to ask
        return text
    script = f'<script id="watch">\n"use strict";\n{_text("watch.js")}</script>\n</head>'
    return text.replace(NO_NETWORK, OWN_SERVER).replace("</head>", script, 1)


def _text(name: str) -> str:
    return (FILES / name).read_text("utf-8")
