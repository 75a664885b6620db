"""The words of the verdict and of the line."""

from typing import Any

import pytest

from stages.evaluate.summary import line_of, verdict

METRICS: dict[str, Any] = {"psnr": 28.9, "psnr_interval": (28.5, 29.3), "ssim": 0.9, "psnr_nearest_view": 14.2} | {
    "psnr_mean_image": 12.9,
    "psnr_right_half": None,
    "psnr_exposure_fitted": None,
    "psnr_pose_fitted": None,
    "photos_scored": 7,
    "photos_test": 7,
    "fraction": 1,
    "photo_size": (800, 600),
    "scored_size": (800, 600),
    "trained_size": (800, 600),
}


@pytest.mark.parametrize(
    ("psnr", "ssim", "kind", "figures"),
    [
        (11.2, 0.3, "Unusable: ", ["11.2 dB", "12.9 dB"]),
        (13.1, 0.4, "Worse than ", ["13.1 against 14.2 dB"]),
        (17.3, 0.61, "Better than ", ["by 3.1 dB", "17.3 dB on 7 ", "800 × 600", "SSIM 0.61"]),
        (25.0, 0.65, "Better than ", ["by 10.8 dB", "25.0 dB on 7 ", "800 × 600", "SSIM 0.65"]),
        (24.0, 0.8, "Good, ", ["24.0 dB on 7 ", "800 × 600", "SSIM 0.80", "9.8 dB better"]),
        (28.9, 0.87, "Sharp and trustworthy: ", ["28.9 dB on 7 ", "800 × 600", "SSIM 0.87", "14.7 dB better"]),
    ],
)
def test_verdicts(psnr: float, ssim: float, kind: str, figures: list[str]):
    sentence = verdict(METRICS | {"psnr": psnr, "ssim": ssim})
    assert sentence.startswith(kind) and all(figure in sentence for figure in figures)
    assert "camera" not in sentence, "nothing here tells how good they are"


@pytest.mark.parametrize(
    ("sizes", "begin"),
    [
        (
            {"photo_size": (4000, 3000), "scored_size": (790, 592), "trained_size": (790, 592)},
            "Sharp as a small image, with finer detail unscored: 28.9 dB on 7 test photos at 790 × 592, ",
        ),
        (
            {"photo_size": (4000, 3000), "scored_size": (1600, 1200), "trained_size": (1000, 750)},
            "Sharp and trustworthy: 28.9 dB on 7 test photos at 1600 × 1200 (trained at 1000 × 750), ",
        ),
    ],
)
def test_a_verdict_on_small_images_is_no_promise(sizes: dict[str, Any], begin: str):
    assert verdict(METRICS | sizes).startswith(begin)


def test_photos_too_small_for_ssim_are_judged_by_psnr_alone():
    words = verdict(METRICS | {"ssim": None})
    assert words.startswith("Sharp and trustworthy: 28.9 dB on 7 ") and "SSIM" not in words


@pytest.mark.parametrize(
    ("fraction", "part"), [(0.25, "25% of each of "), (0.29, "29% of each of "), (0.0052, "0.52% of each of "), (1, "")]
)
def test_a_score_of_a_part_says_so(fraction: float, part: str):
    metrics = METRICS | {"fraction": fraction}
    assert f"28.9 dB on {part}7 test photos at 800 × 600" in verdict(metrics)
    assert line_of(metrics).endswith(f" · {part}7 photos at 800 × 600")
    one = metrics | {"photos_scored": 1, "photos_test": 2}
    assert f"dB on {part.replace('each of ', '')}1 test photo at" in verdict(one)
    assert line_of(one).endswith(f" · {part.replace('each of ', '')}1 of 2 photos at 800 × 600")
