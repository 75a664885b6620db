"""How far a picture is from the photo: SSIM, error maps, and how sure a mean over few photos is."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

SSIM_WINDOW = 11
ERROR_SCALE = 0.3
"""The error that error maps show brightest. Fixed, so that maps of different runs can be compared."""

MIN_FOR_INTERVAL = 3  # of two it would be thirteen times as wide as they differ


def ssim(image: "Tensor", truth: "Tensor", used: "Tensor | None" = None) -> float | None:
    """Mean structural similarity of (H, W, 3) images, or of (n, H, W, 3) parts of one, in [0, 1]; None where no window
    fits in.

    Wang et al. 2004: Gaussian window of 11 pixels and sigma 1.5, only where the window lies inside the image,
    so it equals scikit-image's ``structural_similarity(gaussian_weights=True, use_sample_covariance=False)``.
    With ``used``, ([n,] H, W) bool, only where all of the window is used.
    """
    from kornia.metrics import ssim as kornia_ssim

    height, width, channels = image.shape[-3:]
    if min(height, width) < SSIM_WINDOW:
        return None
    batch = (picture.reshape(-1, height, width, channels).permute(0, 3, 1, 2) for picture in (image, truth))
    similarity = kornia_ssim(*batch, window_size=SSIM_WINDOW, eps=0.0, padding="valid").transpose(0, 1)
    if used is None:
        return float(similarity.mean())
    inside = _windows_inside(used.reshape(-1, height, width))
    return float(similarity[:, inside].mean()) if inside.any() else None


def _windows_inside(used: "Tensor") -> "Tensor":
    """Where all of an SSIM window is used, (n, H - 10, W - 10) bool."""
    from torch.nn.functional import max_pool2d

    ignored = (~used).float()[:, None]
    return max_pool2d(ignored, SSIM_WINDOW, stride=1)[:, 0] == 0


def error_map(image: "Tensor", truth: "Tensor", used: "Tensor | None" = None) -> "np.ndarray":
    """The mean absolute error of the three channels as (H, W, 3) uint8: black 0, pale yellow ERROR_SCALE or more. What
    is not ``used``, (H, W) bool, counts as no error."""
    from matplotlib import colormaps

    error = (image - truth).abs().mean(-1) / ERROR_SCALE
    if used is not None:
        error = error * used
    return colormaps["magma"](error.clamp(0, 1).numpy(), bytes=True)[..., :3]


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """The 95 % interval of the mean of ``values`` by Student's t (1908); None for fewer than three.

    It says how the mean would vary with other test photos of the same scene, not with another training run.
    """
    import numpy as np
    from scipy.special import stdtrit

    count = len(values)
    if count < MIN_FOR_INTERVAL:
        return None
    mean = float(np.mean(values))
    half = float(stdtrit(count - 1, 0.975) * np.std(values, ddof=1) / count**0.5)
    return mean - half, mean + half
