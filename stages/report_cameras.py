"""What the report says of the cameras: whether they are doubtful, why, which photos, and what to do."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

MAX_DOUBTFUL = 0.05  # share of the photos that were excluded, or stand elsewhere for a second opinion
MIN_AGREEING = 0.5  # share of the verified pairs
MAX_SHOWN = 8  # photos of a group

WHAT_TO_DO = (
    "The field cannot be better than its cameras: take photos that lead from one part to the other, mask what repeats, "
    "or try --sfm.matcher exhaustive or another --sfm.seed"
)


class PhotoGroup(NamedTuple):
    """Photos with something in common, by file: the first few to show, and how many more there are."""

    title: str
    files: list[str]
    more: int


class CameraReport(NamedTuple):
    """``verdict`` in one sentence, null where nothing was checked; it comes first on the page if the cameras are
    ``doubtful``."""

    verdict: str | None
    doubtful: bool
    groups: list[PhotoGroup]


def camera_report(registration: Mapping[str, Any] | None) -> CameraReport:
    """The verdict on the cameras, from registration.json."""
    if not registration or not (check := registration.get("check")):
        return CameraReport(None, False, [])
    opinion = registration.get("second_opinion")
    repeated = registration.get("repeated_structure")
    excluded = excluded_files(registration)
    reasons = _reasons_of_check(check, excluded, registration)
    if _disagrees(opinion):
        elsewhere = f"{len(opinion['elsewhere'])} of {opinion['photos']} photos elsewhere"
        reasons.append(f"a second, global reconstruction places {elsewhere}")
    if repeated:
        reasons.append("parts of the scene look alike, and some photos fit only where others contradict them")
    groups = [_group("Excluded: their matches contradict their poses", excluded)] if excluded else []
    groups += [
        _group(f"Held to the rest by {link['matches']} matches of {link['pairs']} pairs", link["photos"])
        for link in check["weak_links"]
    ]
    if _disagrees(opinion):
        groups.append(_group("Placed elsewhere by global mapping", opinion["elsewhere"]))
    if repeated and repeated.get("others"):
        groups.append(_group("Left out, since parts look alike: these fit only …", repeated["others"]))
        groups.append(_group("… if these were taken elsewhere", repeated["photos"]))
    if reasons:
        return CameraReport(f"The cameras are doubtful: {'; '.join(reasons)}. {WHAT_TO_DO}.", True, groups)
    return CameraReport(_agreement(check, opinion), False, groups)


def excluded_files(registration: Mapping[str, Any]) -> list[str]:
    """The photos that lost their poses because their matches contradict them."""
    found = [image["file"] for image in registration["images"] if "contradicted by" in (image["reason"] or "")]
    return found + [file for file in registration["check"]["doubtful"] if file not in found]


def _reasons_of_check(check: Mapping[str, Any], excluded: Sequence[str], registration: Mapping[str, Any]) -> list[str]:
    photos, found = registration["photos"], []
    if len(excluded) > MAX_DOUBTFUL * photos:
        found.append(f"the matches of {len(excluded)} of {photos} photos contradict their poses")
    if check["agreeing"] < MIN_AGREEING * check["pairs"]:
        found.append(f"only {check['agreeing']} of {check['pairs']} verified pairs agree with them")
    weak = {file for link in check["weak_links"] for file in link["photos"]}
    if len(weak) > MAX_DOUBTFUL * photos:
        found.append(f"{len(weak)} photos are held to the rest by few matches")
    return found


def _disagrees(opinion: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
    return (
        opinion is not None and not opinion["failed"] and len(opinion["elsewhere"]) > MAX_DOUBTFUL * opinion["photos"]
    )


def _agreement(check: Mapping[str, Any], opinion: Mapping[str, Any] | None) -> str:
    sentence = (
        f"The cameras agree with {check['agreeing']:,} of {check['pairs']:,} verified pairs of photos (usual distance "
        f"of a match from where they predict it: {check['error_px']:.2f} px)"
    )
    if opinion and not opinion["failed"] and opinion["centre"] is not None:
        same = f"{opinion['agree']} of {opinion['photos']} photos the same"
        extent = f"{opinion['centre']:.2%} of the cameras' extent"
        sentence += f"; a second, global reconstruction places {same}, within {extent}"
    return f"{sentence}."


def _group(title: str, files: Sequence[str]) -> PhotoGroup:
    return PhotoGroup(title, list(files[:MAX_SHOWN]), max(0, len(files) - MAX_SHOWN))


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
    from stages.colmap.held_out import NOISE_MULTIPLES

    rows = (registration or {}).get("camera_models", [])
    chosen = [f"{row['model']}, principal point {row['principal_point']}" for row in rows if row["chosen"]]
    return {
        "rows": rows,
        "several": len({row["group"] for row in rows}) > 1,
        "multiples": f"{NOISE_MULTIPLES:g}",
        "summary": f"Camera model: {'; '.join(dict.fromkeys(chosen)) or 'no candidate would do'}",
    }


def attempts(registration: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """What stage sfm tried and what became of it in words (``outcome``); empty where the first attempt did it all."""
    rows = (registration or {}).get("attempts", [])
    kept = next((row for row in rows if row["kept"]), None)
    return [row | {"outcome": _outcome(row, kept)} for row in rows] if len(rows) > 1 else []


def _outcome(row: dict[str, Any], kept: dict[str, Any] | None) -> str:
    if row["kept"] or row["passed"] is not None:
        return "kept" if row["kept"] else f"not made: {row['passed']}"
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
