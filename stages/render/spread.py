"""A few of many, evenly."""


def spread(length: int, count: int) -> list[int]:
    """``count`` indices in the middle of equal parts of a list of ``length``."""
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]
