"""The report's table of effects, and what was seen in the photos that no effect models."""

from typing import Any

from stages.io.amounts import duration

SHORTEST = 0.1  # seconds that are shown as a number
# What to do about it; the effect's own reason says what was seen.
ADVICE = {
    "tone": "Turn off automatic contrast, HDR and filters, or develop all photos with one curve.",
    "rolling_shutter": "Take photos standing still in place of a video, or move the camera slowly.",
    "participating_media": "Wait for clear air: the field takes haze, smoke and water for parts of the scene.",
    "transients": "Mask out what moves, or leave out the photos that show it.",
    "scale_variation": "Keep a similar distance, or add photos at the distances in between.",
}


def effects_table(effects: dict[str, Any] | None) -> dict[str, Any] | None:
    """``rows`` of the effects that can be modelled, those that are on first, with every figure in words, and ``flags``:
    what was seen and is not modelled, with advice. None where no stage has looked for effects."""
    if effects is None:
        return None
    modelled = [(name, entry) for name, entry in effects.items() if entry["modelled"]]
    ranked = sorted(modelled, key=lambda item: (not item[1]["on"], item[0]))
    seen = sorted((name, entry) for name, entry in effects.items() if not entry["modelled"] and entry["on"])
    return {
        "rows": [_row(name, entry) for name, entry in ranked],
        "flags": [_row(name, entry) | {"advice": ADVICE.get(name, "")} for name, entry in seen],
    }


def _row(name: str, entry: dict[str, Any]) -> dict[str, Any]:
    figures = {key: entry[key] for key in ("statistic", "threshold", "noise")}
    unit = f" {entry['unit']}" if entry["unit"] else ""
    gain, noise = entry["pilot_gain_db"], entry["pilot_noise_db"]
    return {
        "name": name.replace("_", " "),
        "on": entry["on"],
        **{key: "–" if figure is None else f"{figure:.3g}{unit}" for key, figure in figures.items()},
        "pilot": "–" if gain is None else f"{gain:+.1f}" + ("" if noise is None else f" ± {noise:.1f}") + " dB",
        "cost": "–" if entry["cost"] is None else f"{entry['cost']:+.0%} time",
        "seconds": _took(entry["seconds"]),
        "reason": entry["reason"],
    }


def _took(seconds: float) -> str:
    """A dash where another stage decided."""
    if not seconds:
        return "–"
    return duration(seconds) if seconds >= SHORTEST else f"< {duration(SHORTEST)}"
