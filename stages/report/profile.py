"""The training profile as the report shows it."""

from typing import Any

# Per span: its colour in the bar, and what it is.
SPANS = {
    "batch": ("#64748b", "pixels and rays of the batch"),
    "march": ("#0ea5e9", "samples along rays, through occupied cells"),
    "sampling": ("#0ea5e9", "samples along rays, by the coarse network's weights"),
    "gather": ("#3b82f6", "features read from the hash grids"),
    "encode": ("#8b5cf6", "positional encoding"),
    "mlp": ("#f2711c", "networks, forward"),
    "composite": ("#10b981", "volume rendering and the loss"),
    "backward": ("#e11d48", "backward pass"),
    "scatter": ("#eab308", "gradients added to the hash grids"),
    "optimiser": ("#a16207", "Adam"),
    "occupancy": ("#14b8a6", "update of the occupancy grid"),
    "rest": ("#94a3b8", "everything between these spans"),
    "idle": ("transparent", "cores that wait for each other or for other programs"),
}


def profile_bar(table: dict[str, Any] | None) -> dict[str, Any] | None:
    """Rows for the page, longest first and idle last: span, words, colour, percentages; None without a profile."""
    if table is None:
        return None
    ordered = sorted(table["spans"], key=lambda row: row["span"] == "idle")
    rows = [row | dict(zip(("colour", "words"), SPANS[row["span"]], strict=True)) for row in ordered]
    for row in rows:
        row["percent"] = 100 * row["share"]
        row["of_rate"] = 100 * row["min_seconds"] / row["seconds"] if row["min_seconds"] and row["seconds"] else None
    amounts = {"rays_per_second": table["rays"], "colours_per_second": table["colour_evaluations"]}
    speeds = {name: amount / table["seconds"] for name, amount in amounts.items()}
    return table | speeds | {"rows": rows}
