"""Retired words stay out of code, command line, report, documents and what a run writes; CHANGELOG alone may name them.

tests/end_to_end/test_chain.py looks for them in the outputs of a run.

Each entry is a regular expression and the field's standard term that stands in its place.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
KINDS = (".py", ".md", ".toml", ".j2")
FOLDERS = ("nerf", "stages", "pipeline", "tests", "benchmarks", "docs")
EXEMPT = "tests/test_vocabulary.py"

SCENE_FIELDS_RENDERING: dict[str, str] = {
    r"Paper(Nerf|Mlp|Settings|Trainer)": "Vanilla*",
    r"\bGrid(Field|Settings|Pass|Gradients|Trainer|TrainerSettings|Batch)\b": "HashGrid*",
    r"(?i)density.?cache": "occupancy grid",
    r"\b(raise_cache|occupied_bits|cache_cells)\b": "scatter_max, occupancy_bits, occupancy_resolution",
    r"\bMOST_CLEAR\b|\bclearance\b": "empty-space distance",
    r"\bLattice\b|\blattice_(distance|coordinate|measure)\b": "RayStepping, s_to_t, t_to_s, normalised_distance",
    r"density.lattice": "density grid",
    r"\b(end_wave|pack_waves|front_to_back)\b|\bwaves of samples\b": "marching rounds, march_with_early_termination",
    r"HIDDEN_BEHIND": "EARLY_STOP_TRANSMITTANCE",
    r"quantum of light|\bQUANTUM\b|\b(drawn_samples|add_drawn)\b": "opacity-quantised colour sampling",
    r"LEAST_CHANCE": "MIN_KEEP_PROBABILITY",
    r"\bsky_(colour|backward)\b|\binitial_sky\b": "background model",
    r"usable_cells": "frustum mask",
    r"robust_error|LARGEST_PULL": "Huber loss",
    r"(?i)ray.?bank": "ray dataset",
    r"PixelOrder|\bSTRATUM\b": "pixel sampler, block",
    r"\bbearings?\b": "ray directions",
    r"range_between_views": "near_and_far_between_views",
    r"\b(StepPlan|Decision)\b": "StepSchedule, ScheduleRevision",
    r"\bGUIDED_EVERY\b": "sparse depth supervision",
    r"\bFOLDED\b|\b[Ff]olded space|space folded": "contraction, contracted space",
    r"\bnearest photo\b": "nearest training view",
    r"(?i)\bunseen photos?\b": "test photo",
}

EFFECTS: dict[str, str] = {
    r"\b(PhotoRays|PhotoColours|AsGiven|AsRendered|photo_parts)\b": "ImageEffects",
    r"\b(Exposures|RefinedPoses)\b": "ExposureModel, PoseRefinement",
    r"neutral exposure": "reference exposure",
    r"\b(HARM|SURE)\b": "MIN_EFFECT, MIN_SIGNAL_TO_NOISE",
    r"\b_?judged\(": "classify",
    r"(?i)two.?way\b": "additive view/point model",
    r"\b(Odd|odd_photos)\b": "outlier images",
    r"\b(lens|media|scale)_evidence": "camera_model_evidence, participating_media_evidence, scale_variation_evidence",
}

SFM_AND_INGEST: dict[str, str] = {
    r"second.opinion": "global mapping",
    r"\blooser\b": "relaxed ratio test",
    r"\bequip\b|flaw_of": "intrinsics, degenerate",
    r"row_breaks|\bis_torn\b": "capture sequence, is_fragmented",
    r"sfm_child|sfm_process": "worker process",
    r"\blikeness\b|\blook_alike\b(?!\()": "similarity",
    r"\b(Effort|efforts)\b": "retry strategies",
    r"\bTier\b|(?i:bearable)": "quality level",
    r"found no place": "unregistered image",
}

TRAINING: dict[str, str] = {
    r"\bpaper('s)? fields?\b|--train\.field paper|_ONLY\b": "vanilla NeRF, --train.field vanilla",
    r"\b(log2_rows|batch_samples)\b": "log2_hashmap_size, target_samples",
    r"--train\.(log2-rows|finest|levels|chunks|batch-samples|ray-samples)\b": "--train.grid.*",
    r"\b(load_)?[Pp]ainter\b": "Renderer",
    r"\bpsnr_(right|fitted_right|posed_right)\b": "psnr_right_half, psnr_exposure_fitted, psnr_pose_fitted",
    r"\bparts\.json\b|\b(floor_share|most_rays_per_second|steps_timed)\b": "profile.json, efficiency, profiled steps",
    r"validation_probe|\b(make_probe|make_patches|ProbeResult|PROBE_RAYS|unseen_photos)\b": "evaluation pixels",
    r"\bsymptom|\bis_suspicious\b|\bunripe\b|\b(field is|stays) dead\b": "failure reason, undertrained, collapsed",
    r"\b(CLOSING_SHARE|schedule_of\(steps|is_whole\b.*revision)|\bplan\.json\b": "step schedule, schedule.json",
    r"\brate_(start|end)\b|\bleast_photos\b": "learning rate, min_photos",
    r"\b(REGION_HALF|ALIGNED_ROWS|first_rows|of_directions)\b": "REGION_HALF_SIZE, ROW_ALIGNMENT, level_offsets",
    r"\b(KNEE|KNEE_DB)\b|predicted to buy|\bthe knee\b": "diminishing returns, gain",
    r"\b(observed|parts_table|write_parts)\(take": "profiled step",
    r"training cannot go on|going on from step": "cannot continue, resuming",
}

MESH_AND_TRADEOFF: dict[str, str] = {
    r"--mesh\.level\b": "--mesh.iso-level",
    r"\bmiss_voxels\b|\blevel_reason\b": "surface error in voxels, iso_level_reason",
    r"\byardstick\b": "reference timing",
    r"\bFEWEST_WINDOWS\b|\bmake_exam\b|\bExam\b": "benchmark, evaluation crops",
    r"\brungs?\b|\bRUNGS?\b": "budget level",
    r"\bown_field\b|workspace's own field": "this workspace's field",
    r"\bpoints? that nothing beats\b": "Pareto front",
    r"\btells? its density\b": "density query rate",
}

PIPELINE: dict[str, str] = {
    r"\b_?(MOST|LEAST|FEWEST|LARGEST|FARTHEST)_[A-Z]": "MAX_, MIN_",
    r"\b(UNKEYED|LINKS|NEEDS)\b": "not_hashed, published, inputs",
    r"--like\b": "--match-exposure",
}

RETIRED = SCENE_FIELDS_RENDERING | EFFECTS | SFM_AND_INGEST | TRAINING | MESH_AND_TRADEOFF | PIPELINE


def texts() -> dict[str, str]:
    """Path and text of every file that we write."""
    paths = [ROOT / "README.md", ROOT / "pyproject.toml"]
    paths += [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")) if path.suffix in KINDS]
    names = {path.relative_to(ROOT).as_posix(): path for path in paths}
    return {name: path.read_text("utf-8") for name, path in names.items() if name != EXEMPT}


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    return texts()


def offenders(pattern: str, sources: dict[str, str]) -> list[str]:
    """``file:line: text`` of each line, and ``file`` of each path, in which the pattern is found."""
    found = [name for name in sources if re.search(pattern, name)]
    for name, text in sources.items():
        if not re.search(pattern, text):  # many times as fast as line by line
            continue
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(pattern, line):
                found.append(f"{name}:{number}: {line.strip()}")
    return found


def test_no_retired_word_is_left(sources: dict[str, str]):
    assert len(sources) > 100
    left = {f"{old} -> {new}": places for old, new in RETIRED.items() if (places := offenders(old, sources))}
    assert not left, "\n".join(f"{words}\n  " + "\n  ".join(places[:20]) for words, places in left.items())


def test_a_retired_word_would_be_found():
    assert offenders(r"\bwaves\b", {"a.py": "x = 1\nfor waves in rays:\n"}) == ["a.py:2: for waves in rays:"]
    assert offenders(r"ray_bank", {"tests/test_ray_bank.py": ""}) == ["tests/test_ray_bank.py"]
