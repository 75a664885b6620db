"""The report's account of where training spent its time."""

from typing import Any

# By part: its colour in the bar, and what it does.
PARTS = {
    "batch": ("#64748b", "pixels and rays of the batch"),
    "march": ("#0ea5e9", "samples along rays, through occupied cells"),
    "sampling": ("#0ea5e9", "samples along rays, by the coarse network's weights"),
    "gather": ("#3b82f6", "features read from the grids"),
    "encode": ("#8b5cf6", "positional encoding"),
    "mlp": ("#f2711c", "networks, forward"),
    "composite": ("#10b981", "volume rendering and the loss"),
    "backward": ("#e11d48", "backward pass"),
    "scatter": ("#eab308", "gradients added to the grids"),
    "optimiser": ("#a16207", "Adam"),
    "occupancy": ("#14b8a6", "update of the occupancy grid"),
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
