"""The words of the verdict on held-out figures."""

import pytest

from stages.evaluate import verdict


@pytest.mark.parametrize(
    ("psnr", "ssim", "sentence"),
    [
        (11.2, 0.3, "Unusable: 11.2 dB is no better than the mean of the training photos (12.9 dB); "
         "look at the camera layout, then train longer."),
        (13.1, 0.4, "Worse than showing the nearest photo (13.1 against 14.2 dB): train longer."),
        (17.3, 0.61, "Better than any photo nearby by 3.1 dB but soft: 17.3 dB on unseen photos, SSIM 0.61."),
        (25.0, 0.65, "Better than any photo nearby by 10.8 dB but soft: 25.0 dB on unseen photos, SSIM 0.65."),
        (24.0, 0.8, "Good, with fine detail missing: 24.0 dB on unseen photos, SSIM 0.80, "
         "9.8 dB better than the nearest photo."),
        (28.9, 0.87, "Sharp and trustworthy: 28.9 dB on unseen photos, SSIM 0.87, "
         "14.7 dB better than the nearest photo."),
    ],
)  # fmt: skip
def test_verdicts(psnr: float, ssim: float, sentence: str):
    figures = {"psnr": psnr, "ssim": ssim, "psnr_nearest_view": 14.2, "psnr_mean_image": 12.9}
    assert verdict(figures | {"photos_scored": 7, "width_share": 1}) == sentence


@pytest.mark.parametrize(
    ("width_share", "begin"),
    [
        (
            0.13,
            "Sharp as a small picture, finer detail was not looked at: 28.9 dB on unseen photos at 13% of their width",
        ),
        (0.5, "Sharp and trustworthy: 28.9 dB on unseen photos at 50% of their width"),
    ],
)
def test_a_verdict_on_small_pictures_is_no_promise(width_share: float, begin: str):
    figures = {"psnr": 28.9, "ssim": 0.9, "psnr_nearest_view": 14.2, "psnr_mean_image": 12.9}
    assert verdict(figures | {"photos_scored": 7, "width_share": width_share}).startswith(begin)


def test_photos_too_small_for_ssim_are_judged_by_psnr_alone():
    figures = {"psnr": 28.9, "ssim": None, "psnr_nearest_view": 14.2, "psnr_mean_image": 12.9}
    words = verdict(figures | {"photos_scored": 7, "width_share": 1})
    assert words == "Sharp and trustworthy: 28.9 dB on unseen photos, 14.7 dB better than the nearest photo."
