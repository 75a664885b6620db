"""Metres per unit of the sfm frame, by all that has a known length: markers, a distance, GPS."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from stages.contract import Inputs, Progress, StageResult
from stages.io.amounts import counted
from stages.io.files import read_json, read_scene, read_tensors, write_json
from stages.scale.marker_scale import MAX_ERROR, marker_references
from stages.scale.references import (
    MAX_GPS_ERROR,
    MAX_STANDARD_ERRORS,
    Reference,
    combined,
    distance_references,
    gps_reference,
    in_words,
    with_error,
    without_contradictions,
)

if TYPE_CHECKING:
    from stages.scale import Config


def measure_scale(config: "Config", inputs: Inputs, folder: Path, progress: Progress) -> StageResult:
    """The stage's work: look for the markers, weigh all references, write scale.json."""
    scene = read_scene(inputs["normalise"])
    sparse = read_tensors(inputs["normalise"] / "points.safetensors")["xyz"]
    references = [
        *marker_references(config, scene, inputs["ingest"], progress),
        *distance_references(config, scene, sparse, progress),
    ]
    references = without_contradictions(references, progress)
    used = [reference for reference in references if reference.usable]
    gps = gps_reference(read_json(inputs["sfm"] / "registration.json")["georeference"], scene)
    if gps and used:
        _compare_with_gps(gps, combined(used)[0], progress)
    elif gps and gps.usable:
        used = [gps]
    elif gps:
        why = f"1 unit = {with_error(gps)}, and the error may be {MAX_GPS_ERROR:.0%} at most"
        progress.note("scale.gps-inexact", f"GPS is not used for metres: {why}. Give a marker or a distance")
    metres, error = combined(used) if used else (None, None)
    facts = {"metres_per_unit": metres, "relative_error": error, "source": used[0].kind if used else None}
    known = [*references, gps] if gps else references
    write_json(folder / "scale.json", facts | {"references": [asdict(reference) for reference in known]})
    return StageResult(("scale.json",), _line(used, metres, error, asked=bool(references)), facts=facts)


def _compare_with_gps(gps: Reference, metres: float, progress: Progress) -> None:
    assert gps.metres_per_unit and gps.relative_error
    apart = abs(math.log(gps.metres_per_unit / metres))
    if apart > max(MAX_ERROR, MAX_STANDARD_ERRORS * gps.relative_error):
        progress.note(
            "scale.gps-disagrees",
            f"GPS says 1 unit = {with_error(gps)}, {apart:.0%} off what the given lengths say: the lengths are used",
        )


def _line(used: Sequence[Reference], metres: float | None, error: float | None, asked: bool) -> str:
    if metres is None or error is None:
        return "unknown: none of the lengths given can be used" if asked else "unknown: lengths are in scene units"
    markers = sum(reference.kind == "marker" for reference in used)
    kinds = {"marker": counted(markers, "marker"), "distance": "the distance given", "gps": "GPS"}
    sources = " and ".join(dict.fromkeys(kinds[reference.kind] for reference in used))
    return f"1 unit = {in_words(metres, error)} by {sources}"
