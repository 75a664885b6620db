"""The page on effects: what the photos call for, and how test photos are exposed and posed for each score."""

import json
import re
from pathlib import Path
from typing import Any

from stages.io.files import write_json
from stages.report.plots import BLUE
from tests.stages.report.report_workspace import make_workspace, written


def test_page_shows_both_scores_of_right_halves(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "right half, exposure fitted on the left (dB)</th>" in html
    assert '<td class="number">23.50</td><td class="number">28.25</td></tr>' in html
    assert "On the right halves of the photos: 21.0 dB, and 25.8 dB with the exposure of each photo fitted" in html
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    unknown = {"psnr_right_half": None, "psnr_exposure_fitted": None}
    write_json(path, metrics | unknown | {"images": [image | unknown for image in metrics["images"]]})
    html, _ = written(inputs, tmp_path / "unknown", progress)
    assert "On the right halves" not in html and '<td class="number">–</td><td class="number">–</td></tr>' in html


def test_page_says_how_unseen_photos_were_exposed(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    assert "Each test photo was rendered" not in written(inputs, tmp_path / "out", progress)[0]
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    write_json(path, metrics | {"appearance": ["exposed as the photos taken nearest by", "darkened"]})
    html, _ = written(inputs, tmp_path / "exposed", progress)
    assert (
        "Each test photo was rendered exposed as the photos taken nearest by and darkened; nothing was fitted to it"
        in html
    )


def test_page_shows_what_fitted_poses_add_apart_from_fitted_exposures(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "pose fitted" not in html
    path = inputs["evaluate"] / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    images = [image | {"psnr_pose_fitted": image["psnr_exposure_fitted"] + 2} for image in metrics["images"]]
    write_json(path, metrics | {"psnr_pose_fitted": 27.8, "poses_fitted": True, "images": images})
    html, _ = written(inputs, tmp_path / "posed", progress)
    assert "right half, exposure and pose fitted on the left (dB)</th>" in html
    assert '<td class="number">23.50</td><td class="number">28.25</td><td class="number">30.25</td></tr>' in html
    assert "25.8 dB with the exposure of each photo fitted" in html and "pose fitted there too: 27.8 dB" in html


def effect(on: bool, reason: str, **figures: Any) -> dict[str, Any]:
    """An entry of effects.json."""
    nothing = dict.fromkeys(("statistic", "threshold", "noise", "pilot_gain_db", "pilot_noise_db", "cost"))
    return nothing | {"on": on, "modelled": True, "unit": "", "seconds": 0.0, "reason": reason} | figures


EFFECTS = {
    "background": effect(False, "no pixel looks beyond the region"),
    "exposure": effect(
        True, "gains span 0.8 EV", statistic=0.8, threshold=0.05, noise=0.016, unit="EV", seconds=2.5, cost=0.04
    ),
    "view_dependence": effect(True, "it pays", pilot_gain_db=0.94, pilot_noise_db=0.21, seconds=0.02),
    "tone": effect(True, "<i>smeared</i>", modelled=False, statistic=4.0, threshold=2.5, unit="px"),
    "transients": effect(False, "none seen", modelled=False),
}


def test_page_shows_what_the_photos_call_for(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path)
    assert "Effects of these photos" not in written(inputs, tmp_path / "without", progress)[0]
    inputs["effects"] = tmp_path / "fox.nerf" / "effects" / "0123456789abcdef"
    inputs["effects"].mkdir(parents=True)
    manifest = json.loads((inputs["train"] / "manifest.json").read_text("utf-8"))
    write_json(inputs["effects"] / "manifest.json", manifest | {"stage": "effects", "config": {}, "facts": {}})
    write_json(inputs["effects"] / "effects.json", EFFECTS)
    html, _ = written(inputs, tmp_path / "out", progress)
    begins = html.index("Effects of these photos")
    section = html[begins : html.index("<h2", begins)]
    cells = re.findall(r"<t[dh](?: [^>]*)?>(.*?)</t[dh]>", section)
    rows = [cells[i : i + 9] for i in range(0, len(cells), 9)]
    assert rows[0] == [
        "effect",
        "",
        "why",
        "statistic",
        "threshold",
        "noise",
        "gain in A/B run",
        "costs when on",
        "deciding took",
    ]
    assert rows[1:] == [
        ["exposure", "<b>on</b>", "gains span 0.8 EV", "0.8 EV", "0.05 EV", "0.016 EV", "–", "+4% time", "2.5 s"],
        ["view dependence", "<b>on</b>", "it pays", "–", "–", "–", "+0.9 ± 0.2 dB", "–", "&lt; 0.1 s"],
        ["background", "off", "no pixel looks beyond the region", "–", "–", "–", "–", "–", "–"],
    ]
    flags = re.findall(r"<li>(.*?)</li>", section)
    assert flags == [
        "tone: &lt;i&gt;smeared&lt;/i&gt; (4 px, threshold 2.5 px). Turn off automatic contrast, HDR and filters, or "
        "develop all photos with one curve."
    ]


def test_page_shows_the_curve_of_each_cameras_vignetting(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path) | {"effects": tmp_path / "effects"}
    inputs["effects"].mkdir()
    write_json(inputs["effects"] / "manifest.json", json.loads((inputs["mesh"] / "manifest.json").read_text("utf-8")))
    write_json(inputs["effects"] / "effects.json", EFFECTS)
    field = json.loads((inputs["train"] / "field.json").read_text("utf-8"))
    rows = {"a.png": [0.4, 0.1, 0.1, 0.2], "b.png": [0.4, 0.1, 0.1, 0.2], "c.png": [0.4, 0.0, 0.0, 0.1]}
    write_json(inputs["train"] / "field.json", field | {"effects": {"vignetting": rows}})
    html, _ = written(inputs, tmp_path / "out", progress)
    drawn = html[html.index('aria-label="gain against') : html.index("Learnt vignetting")]
    assert drawn.count(BLUE) == 2, "two cameras"
    write_json(inputs["train"] / "field.json", field | {"effects": {}})
    assert "Vignetting as it was learnt" not in written(inputs, tmp_path / "without", progress)[0]


def test_without_flags_there_is_no_list_of_them(tmp_path: Path, progress: Any):
    inputs = make_workspace(tmp_path) | {"effects": tmp_path / "effects"}
    inputs["effects"].mkdir()
    write_json(inputs["effects"] / "manifest.json", json.loads((inputs["mesh"] / "manifest.json").read_text("utf-8")))
    write_json(inputs["effects"] / "effects.json", {"exposure": EFFECTS["exposure"]})
    html, _ = written(inputs, tmp_path / "out", progress)
    assert "Effects of these photos" in html and "not modelled" not in html
