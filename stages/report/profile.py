"""The report's account of where training spent its time."""

from typing import Any

# By part: its colour in the bar, and what it does.
PARTS = {
    "batch": ("#64748b", "pixels and rays of the photos drawn"),
    "march": ("#0ea5e9", "samples placed along rays, through cells that may hold something"),
    "sampling": ("#0ea5e9", "samples placed along rays, by the coarse network's weights"),
    "gather": ("#3b82f6", "features of samples read from the grids"),
    "encode": ("#8b5cf6", "positions and directions lifted to waves"),
    "mlp": ("#f2711c", "networks, forward"),
    "composite": ("#10b981", "samples added up to colours; the loss"),
    "backward": ("#e11d48", "gradients, back through all of it"),
    "scatter": ("#eab308", "gradients added to the grids"),
    "optimiser": ("#a16207", "Adam"),
    "cache": ("#14b8a6", "the memory of which cells are empty"),
    "rest": ("#94a3b8", "everything between these parts"),
    "waiting": ("transparent", "cores waiting for each other, or for other programs"),
}


def parts_bar(table: dict[str, Any] | None) -> dict[str, Any] | None:
    """Rows for the page, longest first and waiting last: name, words, colour, shares in percent; None where nothing was
    timed."""
    if table is None:
        return None
    ordered = sorted(table["parts"], key=lambda row: row["part"] == "waiting")
    rows = [row | dict(zip(("colour", "words"), PARTS[row["part"]], strict=True)) for row in ordered]
    for row in rows:
        row["percent"] = 100 * row["share"]
        row["of_rate"] = 100 * row["floor"] / row["seconds"] if row["floor"] and row["seconds"] else None
    speeds = {f"{name}_per_second": table[name] / table["seconds"] for name in ("rays", "samples")}
    return table | speeds | {"rows": rows, "reached": 100 * table["floor_share"]}
