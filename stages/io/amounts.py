"""Amounts in words: counts, times, bytes."""

import math
from collections.abc import Sequence

GB = 2**30


def short_count(count: float) -> str:
    """``950``, ``9.4 k``, ``24 k``, ``2.4 M``: a count at a glance."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if count >= size:
            return f"{count / size:.{0 if count >= 10 * size else 1}f} {unit}"
    return f"{count:.0f}"


def counted(count: int, one: str = "photo", many: str | None = None) -> str:
    """``1 photo``, ``2 photos``: so many things, each called ``one``, and ``many`` where that takes more than an s."""
    return f"{count:,} {one if count == 1 else many or f'{one}s'}"


def rgb(colour: Sequence[float]) -> str:
    """``rgb(255, 255, 255)``: a colour of numbers from 0 to 1, as style sheets write it."""
    return f"rgb({', '.join(f'{255 * value:.0f}' for value in colour)})"


def duration(seconds: float) -> str:
    """``0.4 s``, ``58 s``, ``3 min 20 s``, ``1 h 5 min``: seconds as people say them."""
    if seconds < 9.95:
        return f"{seconds:.1f} s".replace(".0 s", " s")
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    big, small, units = (
        (whole // 60, whole % 60, ("min", "s")) if whole < 3600 else (whole // 3600, whole % 3600 // 60, ("h", "min"))
    )
    return f"{big} {units[0]} {small} {units[1]}" if small else f"{big} {units[0]}"


def rough_duration(seconds: float) -> str:
    """``40 s``, ``7 min``, ``3 h``: a time as one says it beforehand."""
    return duration(max(1, round(seconds)) if seconds < 60 else 60 * round(seconds / 60))


def least_duration(seconds: float) -> str:
    """``36 s``, ``1 min 10 s``, ``12 min``: a time that is needed at least, rounded up. So where it is more than the
    time there is, words say so, too."""
    step = 1 if seconds < 60 else 10 if seconds < 600 else 60
    return duration(step * max(1, math.ceil(seconds / step)))


def duration_option(seconds: float) -> str:
    """``75s``, ``3m``, ``1h30m``: a time as ``--more`` and ``--budget`` take it, from ten minutes on in whole ones."""
    whole = max(1, round(seconds))
    if whole < 600 and whole % 60:
        return f"{whole}s"
    hours, minutes = divmod(round(whole / 60), 60)
    return (f"{hours}h" if hours else "") + (f"{minutes}m" if minutes else "")


def bytes_in_words(count: float) -> str:
    """``1.5 GB``, ``40 MB``: an amount of memory or disk."""
    return f"{count / GB:.1f} GB" if count >= 0.1 * GB else f"{count / 2**20:.0f} MB"


def resolution_name(downscale: float) -> str:
    """``full resolution``, ``half resolution``, ``a quarter of the resolution``, ``1/2.7 of the resolution``."""
    names = {1.0: "full resolution", 2.0: "half resolution", 3.0: "a third of the resolution"}
    names[4.0] = "a quarter of the resolution"
    return names.get(downscale, f"1/{downscale:g} of the resolution")
