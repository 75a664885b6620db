"""What the report says of the cameras: whether they are doubtful, why, which photos, and what to do."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

from stages.io.amounts import counted

MAX_DOUBTFUL = 0.05  # fraction of the photos that are excluded, differ from global mapping, or are weakly linked
MIN_AGREEING = 0.5  # share of the verified pairs
MIN_LINKED = 0.95  # share of the photos that pairs which agree with either mapping link together
MIN_SUPPORT = 0.9  # share of the pairs that agree with our poses must agree with the other mapping's, to cast doubt
MAX_SHOWN = 8  # photos of a group
MIN_SHOWN = 0.0001  # share of the extent: 0.00% would be no figure
MAX_WEAK = 4  # weakly linked groups shown one by one
BETTER_PHOTOS = "take photos that lead from one part to the other, or mask what repeats"
CHECK_GIVEN = "Check the imported poses, or leave out --cameras to find the cameras from the photos."


class PhotoGroup(NamedTuple):
    """Photos with something in common, by file: the first few to show, and how many more there are."""

    title: str
    files: list[str]
    more: int


class CameraReport(NamedTuple):
    """``doubt`` says why the cameras are doubtful, null where they are not, and ``advice`` what that means and what to
    try. ``figures`` say how far verified pairs and global mapping agree, null where nothing was checked."""

    doubt: str | None
    advice: str
    figures: str | None
    groups: list[PhotoGroup]

    @property
    def verdict(self) -> str | None:
        """All of it in words; null where nothing was checked."""
        return f"{self.doubt} {self.advice}" if self.doubt else self.figures


def camera_report(registration: Mapping[str, Any] | None, config: Mapping[str, Any]) -> CameraReport:
    """What registration.json says of the cameras. ``config``: the settings of stage sfm that made it.

    Imported poses lack some of it, or all.
    """
    if not registration:
        return CameraReport(None, "", None, [])
    reasons = [
        *_doubts_of_check(registration),
        *_doubts_of_global_mapping(registration.get("global_mapping")),
        *_doubts_of_structure(registration.get("repeated_structure")),
    ]
    doubt = f"The cameras are doubtful: {'; '.join(reasons)}." if reasons else None
    return CameraReport(doubt, _advice(registration, config), _figures(registration), _groups(registration))


def doubtful_files(registration: Mapping[str, Any]) -> list[str]:
    """The photos whose matches contradict their poses: they lost them, unless these were given."""
    return list((registration.get("check") or {"doubtful": []})["doubtful"])


def order_is_informative(registration: Mapping[str, Any] | None) -> bool:
    """Whether photos that follow each other by name were taken one after the other, as far as anybody knows."""
    graph = (registration or {}).get("match_graph")
    return graph is None or graph["order"]


# --- why they are doubtful


def _doubts_of_check(registration: Mapping[str, Any]) -> list[str]:
    photos, check = registration["photos"], registration.get("check")
    doubtful, found = doubtful_files(registration), []
    if len(doubtful) > MAX_DOUBTFUL * photos:
        kept = any(image["registered"] and image["file"] in doubtful for image in registration["images"])
        excluded = "" if kept else ", which were excluded"
        found.append(f"verified matches contradict the poses of {len(doubtful)} of {photos} photos{excluded}")
    if check is None:
        return found
    if check["agreeing"] < MIN_AGREEING * check["pairs"]:
        found.append(f"only {check['agreeing']:,} of {check['pairs']:,} verified image pairs agree with them")
    if not check["fits"] and registration["source"] != "import":
        noise = f"{check['error_px'] / check['noise_px']:.0f} times their noise"
        found.append(f"verified matches are {check['error_px']:.1f} px off, {noise}")
    if len(breaks := _sequence_breaks(registration)) > MAX_DOUBTFUL * photos:
        found.append(f"the matches of {counted(len(breaks), 'pair')} of consecutive photos contradict their poses")
    links = _weak_links(registration)
    weak = {file for link in links for file in link["photos"]}
    # A lone photo at the edge of many does no harm; of a group the place and size beside the rest are not sure.
    if len(weak) > MAX_DOUBTFUL * photos or any(len(link["photos"]) > 1 for link in links):
        found.append(f"few matches link {counted(len(weak))} to the rest")
    return found


def _weak_links(registration: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Groups that few matches link to the rest; none of imported poses that do not rest on matches."""
    check = registration.get("check") or {}
    rest_on_matches = registration["source"] != "import" or check.get("adjusted_from_px") is not None
    return check.get("weak_links", []) if rest_on_matches else []


def _sequence_breaks(registration: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Photos next to each other by name or time whose matches contradict their poses."""
    return (registration.get("check") or {}).get("sequence_breaks", [])


def _doubts_of_global_mapping(comparison: Mapping[str, Any] | None) -> list[str]:
    if not _disagrees(comparison):
        return []
    different = f"{len(comparison['different'])} of {comparison['photos']} photos"
    return [f"incremental and global mapping give {different} different poses"]


def _disagrees(comparison: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
    return _differs(comparison) and not comparison["drift"] and not _is_refuted(comparison)


def _differs(comparison: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
    if not comparison or comparison["failed"]:
        return False
    return len(comparison["different"]) > MAX_DOUBTFUL * comparison["photos"]


def _is_refuted(comparison: Mapping[str, Any]) -> bool:
    """Whether clearly more verified pairs of the photos in question agree with the cameras than with those of the
    mapping that was not taken, or those that agree link all photos here, and there fall into groups."""
    return _falls_apart(comparison) or comparison["agreeing_other"] < MIN_SUPPORT * comparison["agreeing"]


def _falls_apart(comparison: Mapping[str, Any]) -> bool:
    return comparison["linked_other"] < MIN_LINKED <= comparison["linked"]


def _doubts_of_structure(repeated: Mapping[str, Any] | None) -> list[str]:
    if not repeated:
        return []
    others, moved = len(repeated["others"]), len(repeated["photos"])
    contradict = counted(others, "photo contradicts", "photos contradict")
    return [f"repeated structure: {contradict} the poses of {moved} others"]


def _advice(registration: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    meaning = "The field cannot be better than its cameras."
    if registration["source"] == "import":
        return f"{meaning} {CHECK_GIVEN}"
    seed = f"--sfm.seed {config.get('seed', 0) + 1}"
    options = seed if config.get("matcher") == "exhaustive" else f"--sfm.matcher exhaustive or {seed}"
    return f"{meaning} Run again with {options}; if that does not help, {BETTER_PHOTOS}."


# --- what is said and shown of them in any case


def _figures(registration: Mapping[str, Any]) -> str | None:
    check, comparison = registration.get("check"), registration.get("global_mapping")
    said = []
    if check and check["pairs"]:
        pairs = f"{check['agreeing']:,} of {check['pairs']:,} verified image pairs"
        before = check.get("adjusted_from_px")  # of imported poses
        adjusted = "" if before is None else f"; {before:.1f} px before the given poses were adjusted"
        said.append(f"the cameras agree with {pairs} (median error {check['error_px']:.2f} px{adjusted})")
    if _differs(comparison) and _is_refuted(comparison):
        name = "incremental" if comparison["taken"] else "global"
        agreeing, with_these = f"{comparison['agreeing_other']:,}", f"{comparison['agreeing']:,} with these"
        support = f"{agreeing} of their image pairs agree with it and {with_these}"
        if _falls_apart(comparison):
            support = f"the image pairs that agree with it link only {comparison['linked_other']:.0%} of the photos"
        said.append(f"{name} mapping gives {counted(len(comparison['different']))} other poses; {support}")
    elif _differs(comparison) and comparison["drift"]:
        name = "incremental" if comparison["taken"] else "global"
        bent = f"against {name} mapping the path is bent or stretched at {counted(len(comparison['different']))}"
        said.append(f"{bent}, little by little: no loop tells which is right")
    elif comparison and not comparison["failed"] and comparison["centre"] is not None:
        same = f"{comparison['agree']} of {comparison['photos']} photos the same pose"
        extent = f"{max(comparison['centre'], MIN_SHOWN):.2%} of the extent"
        said.append(f"global mapping gives {same} (within {extent})")
    sentence = "; ".join(said)
    return f"{sentence[0].upper()}{sentence[1:]}." if said else None


def _groups(registration: Mapping[str, Any]) -> list[PhotoGroup]:
    comparison, repeated = registration.get("global_mapping"), registration.get("repeated_structure") or {}
    lost = "" if registration["source"] == "import" else "Excluded: "
    groups = [(f"{lost}verified matches contradict their poses", doubtful_files(registration))]
    groups += _weak_groups(_weak_links(registration))
    breaks = [first for first, _ in _sequence_breaks(registration)]
    groups.append(("Their matches with the next photo by name or time contradict their poses", breaks))
    groups.append(
        (
            "Incremental and global mapping give these different poses",
            comparison["different"] if _disagrees(comparison) else [],
        )
    )
    groups.append(
        ("Excluded for repeated structure: they contradict the poses of the next group", repeated.get("others", []))
    )
    groups.append(("Kept: the excluded photos contradict these poses", repeated.get("photos", [])))
    return [
        PhotoGroup(f"{title[0].upper()}{title[1:]}", list(files[:MAX_SHOWN]), max(0, len(files) - MAX_SHOWN))
        for title, files in groups
        if files
    ]


def _weak_groups(links: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """The largest weakly linked groups one by one, and all others together: most are single photos."""
    largest = sorted((link for link in links if len(link["photos"]) > 1), key=lambda link: -len(link["photos"]))
    shown = largest[:MAX_WEAK]
    groups = [
        (
            f"Linked to the rest by {link['matches']} matches of {counted(link['pairs'], 'image pair')}"
            if link["pairs"]
            else "Linked to the rest by inexact matches alone",
            link["photos"],
        )
        for link in shown
    ]
    others = [file for link in links if link not in shown for file in link["photos"]]
    return [*groups, ("Each linked to the rest by few matches", others)]


# --- how they were found


def missing(registration: Mapping[str, Any] | None, name_of: Mapping[str, str]) -> list[dict[str, str]]:
    """The photos without a known camera, by their own names, and why."""
    if registration is None or not name_of:
        return []
    return [
        {"name": name_of[f"images/{image['file']}"], "reason": image["reason"] or "no reason is known"}
        for image in registration["images"]
        if not image["registered"]
    ]


def camera_models(registration: Mapping[str, Any] | None) -> dict[str, Any]:
    """The comparison of camera models in stage sfm."""
    from stages.sfm.colmap.adjustment.camera_model_selection import NOISE_MULTIPLES

    rows = (registration or {}).get("camera_models", [])
    chosen = [f"{row['model']}, principal point {row['principal_point']}" for row in rows if row["chosen"]]
    return {
        "rows": rows,
        "several": len({row["group"] for row in rows}) > 1,
        "multiples": f"{NOISE_MULTIPLES:g}",
        "summary": f"Camera model: {'; '.join(dict.fromkeys(chosen)) or 'every candidate is degenerate'}",
    }


def strategies(registration: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """What stage sfm tried and its ``outcome`` in words; empty where the default strategy was enough."""
    rows = (registration or {}).get("strategies", [])
    kept = next((row for row in rows if row["kept"]), None)
    return [row | {"outcome": _outcome(row, kept)} for row in rows] if len(rows) > 1 else []


def _outcome(row: dict[str, Any], kept: dict[str, Any] | None) -> str:
    if row["kept"] or row["skipped"] is not None:
        return "kept" if row["kept"] else f"skipped: {row['skipped']}"
    if not row["registered"] or kept is None:
        return "no model"
    for fact, words in (("registered", "fewer photos"), ("points", "fewer points")):
        if row[fact] != kept[fact]:
            return words
    return "a larger error" if row["reprojection_px"] > kept["reprojection_px"] else "no better"


def uncertainty(registration: Mapping[str, Any] | None, name_of: Mapping[str, str]) -> dict[str, Any] | None:
    """How well poses are known, of the median and the worst photo."""
    if registration is None or not name_of:
        return None
    known = [(i["uncertainty_px"], i["file"]) for i in registration["images"] if i.get("uncertainty_px")]
    if not known:
        return None
    most, file = max(known)
    return {"median": sorted(known)[len(known) // 2][0], "most": most, "worst": name_of[f"images/{file}"]}
