"""What strangers' files may hold: valid ones with edits, and JSON trees; all shrink towards the valid file."""

import json
import struct
from typing import Any

from hypothesis import strategies as st

W, H = 24, 20  # of every picture, and of the cameras that took them

# Counts and offsets that parsers stumble over, and floats that arithmetic does.
NUMBERS = [0, 1, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1]
FLOATS = [0.0, -0.0, 5e-324, 1e-300, 1e300, 1.7e308, -1e308, float("nan"), float("inf"), float("-inf")]


@st.composite
def damaged(draw: st.DrawFn, valid: bytes) -> bytes:
    """``valid`` with a few edits: bytes changed, numbers written over, parts cut out, repeated or put in."""
    content = bytearray(valid)
    for _ in range(draw(st.integers(0, 4))):
        place = draw(st.integers(0, max(len(content) - 1, 0)))
        if draw(st.booleans()):  # most counts are at the front
            place = min(place, draw(st.integers(0, 64)))
        kind = draw(st.sampled_from(("bytes", "number", "float", "cut", "end", "repeat", "insert")))
        if kind == "bytes":
            new = draw(st.binary(min_size=1, max_size=4))
            content[place : place + len(new)] = new
        elif kind == "number":
            size, order = draw(st.sampled_from((1, 2, 4, 8))), draw(st.sampled_from(("little", "big")))
            content[place : place + size] = (draw(st.sampled_from(NUMBERS)) % 256**size).to_bytes(size, order)
        elif kind == "float":
            content[place : place + 8] = struct.pack("<d", draw(st.sampled_from(FLOATS)))
        elif kind == "cut":
            del content[place : place + draw(st.integers(1, 64))]
        elif kind == "end":
            del content[place:]
        elif kind == "repeat":
            content[place:place] = content[place : place + draw(st.integers(1, 64))] * draw(st.integers(1, 8))
        else:
            content[place:place] = draw(st.binary(max_size=64))
    return bytes(content)


STRINGS = st.one_of(
    st.text(max_size=8),
    st.sampled_from(
        ["", ".", "..", "../a.png", "/etc/passwd", "a\0b", "\ud800", "x" * 300, "x" * 70_000, "a/" * 3000, "~"]
    ),
)
LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([*NUMBERS, *FLOATS, -1, 10**400, -(10**30)]),
    st.floats(),
    STRINGS,
)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(STRINGS, inner, max_size=4)),
    max_leaves=12,
)


def _places(value: Any, path: tuple = ()) -> list[tuple]:
    """The path to every part of a JSON value."""
    found = [path]
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        found += _places(part, (*path, key))
    return found


@st.composite
def edited(draw: st.DrawFn, valid: Any) -> Any:
    """A valid JSON value of which a few parts are replaced by any other, removed, or doubled."""
    value = json.loads(json.dumps(valid))
    for _ in range(draw(st.integers(0, 3))):
        *path, last = draw(st.sampled_from(_places(value)[1:] or [(None,)]))
        if last is None:
            break
        holder = value
        for key in path:
            holder = holder[key]
        kind = draw(st.sampled_from(("replace", "remove", "double", "rename")))
        if kind == "replace":
            holder[last] = draw(TREES)
        elif kind == "remove":
            del holder[last]
        elif kind == "double" and isinstance(holder, list):
            holder.append(holder[last])
        elif kind == "rename" and isinstance(holder, dict):
            holder[draw(STRINGS)] = holder.pop(last)
    return value


def json_files(valid: Any) -> st.SearchStrategy[bytes]:
    """Texts of a JSON file: the valid value edited, any tree, deep nests, or the valid text with damaged bytes."""
    trees = st.one_of(edited(valid), edited(valid), TREES)
    nests = st.sampled_from([b"[" * 100_000, b'{"frames":' * 2000 + b"1" + b"}" * 2000, b"[" * 900 + b"]" * 900])
    texts = trees.map(lambda tree: json.dumps(tree).encode("utf-8", "surrogatepass"))
    return st.one_of(texts, texts, texts, damaged(json.dumps(valid).encode()), nests)


def one_of(files: dict[str, bytes]) -> st.SearchStrategy[dict[str, bytes]]:
    """Valid files of which one is damaged."""
    return st.sampled_from(sorted(files)).flatmap(
        lambda name: damaged(files[name]).map(lambda new: {**files, name: new})
    )


def single(name: str, content: st.SearchStrategy[bytes]) -> st.SearchStrategy[dict[str, bytes]]:
    """One file."""
    return content.map(lambda data: {name: data})
