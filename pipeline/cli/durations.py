"""Durations as people write them on a command line: ``90s``, ``10m``, ``1h30m``."""

import re

from pipeline.cli.options import UsageError

# Hours, minutes, seconds in this order, each at most once; the last may have decimals.
_WRITTEN = re.compile(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s)?")


def seconds_from(text: str) -> float:
    """The seconds in ``90s``, ``2.5m``, ``10m`` or ``1h30m``. A number without a unit means nothing: 10 of what?

    Raises UsageError for anything else, and for no time at all.
    """
    found = _WRITTEN.fullmatch(text.strip().lower())
    if not found or not any(found.groups()):
        raise UsageError(f"{text!r} is not a duration; write it like 90s, 10m or 1h30m")
    hours, minutes, seconds = (float(part or 0) for part in found.groups())
    total = 3600 * hours + 60 * minutes + seconds
    if total == 0:
        raise UsageError(f"{text!r} is not above 0; write a duration like 90s, 10m or 1h30m")
    return total
