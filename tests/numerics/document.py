"""docs/NUMERICS.md: the matrix as it was measured here, and where the rest of nerf/ is tested."""

from collections.abc import Iterable
from pathlib import Path

from pipeline.doctor.numerics.matrix import Row, figure, limit
from tests.numerics.descriptions import DESCRIPTIONS

DOCUMENT = Path(__file__).parents[2] / "docs" / "NUMERICS.md"

# What has no row. A module of nerf/ stands in a row, here, or fails a test.
ELSEWHERE = {
    "nerf/kernels/__init__.py": "resolutions rounded, rows in whole numbers: tests/nerf/kernels/torch/test_encoding.py",
    "nerf/kernels/torch/gather.py": "rows are copied: tests/nerf/kernels/warp/test_gpu_kernels.py",
    "nerf/kernels/torch/occupancy.py": "comparisons and bits, exact: "
    "tests/nerf/kernels/torch/test_occupancy.py; a NaN cell "
    "counts as occupied",
    "nerf/kernels/torch/early_termination.py": "sums of optical depth in float64, the step size as marching "
    "takes it: tests/nerf/kernels/test_early_termination.py",
    "nerf/kernels/torch/colour_sampling.py": "1 − exp(−x) as in compositing, of optical depth summed in float64; "
    "differences of it are off by 1e-7, and NaN is left out and spoils the transmittance behind it: "
    "tests/nerf/kernels/test_colour_sampling.py",
    "nerf/rendering/early_termination.py": "ends rays at a transmittance below 1e-3: "
    "tests/nerf/fields/test_hash_grid.py",
    "nerf/fields/hash_grid.py": "puts rows together: tests/nerf/fields/test_hash_grid.py",
    "nerf/fields/occupancy_grid.py": "σ times the step size; the outermost cells, which reach to infinity, count "
    "half a cell within: tests/nerf/training/test_hash_grid_trainer.py",
    "nerf/training/frustum_mask.py": "angles and distances of the middles of cells; the cells around them count as "
    "well: tests/nerf/training/test_frustum_mask.py",
    "nerf/training/ray_dataset.py": "ray directions linear within a patch, of length 1/2 or more before they are "
    "divided by it: tests/nerf/training/test_ray_dataset.py",
    "nerf/rendering/srgb.py": "the standard's own curve, its inverse, from nothing to 1e30: "
    "tests/nerf/rendering/test_srgb.py",
    "nerf/rendering/srgb_arrays.py": "the same in float64: tests/nerf/rendering/test_srgb.py",
    "nerf/effects/exposure.py": "from one power law to the other, without linear light in between; value, "
    "gradient, extremes: "
    "tests/nerf/effects/test_exposure.py",
    "nerf/effects/__init__.py": "effects in order, by the chain rule: tests/nerf/effects/test_composition.py; "
    "gains of a photo's rays, from nothing to 1e30: tests/nerf/effects/test_exposure_model.py",
    "nerf/effects/appearance.py": "changes no bit where effects change nothing: tests/nerf/effects/test_exposure.py",
    "nerf/geometry/rotations.py": "its series below 0.1 radians, against the matrix exponential from 0 to beyond π: "
    "tests/nerf/geometry/test_rotations.py",
    "nerf/effects/pose_refinement.py": "rotations and translations of rays, up to 3.1 radians: "
    "tests/nerf/effects/test_pose_refinement.py; the fit of one is a search: tests/nerf/effects/test_pose_fit.py",
    "nerf/geometry/pose_distance.py": "float64, ratios of distances: tests/nerf/geometry/test_pose_distance.py",
    "nerf/rendering/images.py": "cuts images into chunks: tests/nerf/rendering/test_images.py",
    "nerf/training/evaluation_pixels.py": "mean colour, PSNR, patches of pixels: "
    "tests/nerf/training/test_evaluation_pixels.py",
    "nerf/training/trainer.py": "a pixel over its background, linear in alpha: "
    "tests/nerf/training/test_vanilla_trainer.py",
    "nerf/training/vanilla_trainer.py": "sums of micro-batches; refuses non-finite values before the update: "
    "tests/nerf/training/test_vanilla_trainer.py",
    "nerf/training/hash_grid_trainer.py": "likewise: tests/nerf/training/test_hash_grid_trainer.py",
    "nerf/training/graph_trainer.py": "zeros for gradients that are not finite: "
    "tests/nerf/training/test_graph_trainer.py",
    "nerf/kernels/torch/packing.py": "zeros behind samples: tests/nerf/training/test_graph_trainer.py",
    "nerf/training/data_parallel.py": "sums over processes, bit for bit or to 1e-6 those of one: "
    "tests/nerf/training/test_data_parallel.py",
    "nerf/runtime/matmul_precision.py": "lets matrix products be off by 1e-4 if that is faster: "
    "tests/nerf/runtime/test_matmul_precision.py",
    "nerf/training/learning_rate.py": "within the range that is given, in float64: "
    "tests/nerf/training/test_learning_rate.py",
    "nerf/training/step_schedule.py": "progress from 0 to 1, in float64: tests/nerf/training/test_step_schedule.py",
    "nerf/training/learning_curve.py": "interpolation in log time, in float64: "
    "tests/nerf/training/test_learning_curve.py",
    "nerf/geometry/space_maps/__init__.py": "the box changes nothing: "
    "tests/nerf/geometry/space_maps/test_space_maps.py",
    "nerf/geometry/space_maps/mapped_rays.py": "distances along straight rays, measured with normalised device "
    "coordinates above; further laws: tests/nerf/geometry/space_maps/test_space_maps.py",
    "nerf/geometry/reconstruction.py": "float64, relative to the cameras' middle: "
    "tests/nerf/geometry/test_reconstruction.py",
    "nerf/geometry/normalisation.py": "float64, the same for every similar reconstruction, 1e6 off the origin too: "
    "tests/nerf/geometry/test_normalisation.py",
    "nerf/geometry/region_of_interest.py": "float64: tests/nerf/geometry/test_normalisation.py",
    "nerf/geometry/up_vector.py": "float64: tests/nerf/geometry/test_up_vector.py",
    "nerf/geometry/near_far.py": "float64: tests/nerf/geometry/test_normalisation.py",
    "nerf/geometry/alignment.py": "float64, refuses points on one line: tests/nerf/geometry/test_alignment.py",
    "nerf/geometry/georeference.py": "float64, in metres on WGS 84, positions far off the rest left out: "
    "tests/nerf/geometry/test_georeference.py",
    "nerf/geometry/camera_paths.py": "float64: tests/nerf/geometry/test_camera_paths.py",
    "nerf/synthetic/shapes.py": "the synthetic scene, without gradient, against exact geometry: "
    "tests/nerf/synthetic/test_shapes.py",
    "nerf/synthetic/textures.py": "the synthetic scene: tests/nerf/synthetic/test_textures.py",
    "nerf/synthetic/scenes.py": "the synthetic scene: tests/nerf/synthetic/test_scenes.py",
}
NO_FORMULA = {
    "nerf/geometry/scene.py", "nerf/fields/interface.py", "nerf/runtime/parallel.py", "nerf/runtime/randomness.py",
    "nerf/runtime/ranks.py", "nerf/runtime/profiler.py", "nerf/runtime/machine_rates.py",
    "nerf/training/pixel_sampler.py",
}  # fmt: skip
# Measured as the rows of the functions they repeat.
REPEATED = ("nerf/kernels/warp/",)
# Statistics in float64, each with its own noise: tests/nerf/effects/statistics.
STATISTICS = ("nerf/effects/statistics/",)

HEAD = """# Numerics

How far each formula of `nerf/` is from the truth in float32, in value and gradient, on ordinary and on extreme input.
The cases are in `pipeline/doctor/numerics`; this page is written from them by `python -m tests.numerics`,
`tests/numerics` holds them to the limits given here, and `pipeline doctor --selftest` measures them on your own
machine.

* **Errors** are the worst over all inputs tried, against float64 on the same float32 input: `itself`, as a share of the
  true number (below 1.2e-38, where float32 has fewer digits, of that); `row`, of the largest true number of its ray or
  point; `one`, absolute. Two figures are those of the two backends, torch / Warp. Limits are four or five times what
  was measured; a test fails as well if an error is fifty times smaller than its limit: then nothing was compared, or
  the limit says nothing.
* **Finite**: every value and gradient of every input tried, else the error would be infinite.
* **Gradients** are those the program uses, by autograd or by hand. All are checked against differences in float64
  (`gradcheck`) as well. The references themselves are checked with 50 digits (`tests/numerics/test_references.py`).
* **Laws** that hold for all input are in `tests/numerics/test_laws.py` and beside the formulas' other tests in
  `tests/nerf`.
* **NaN is never masked**: what is not a number stays so up to the loss, which refuses the step
  (`tests/numerics/test_not_a_number.py`). No `nan_to_num`, no swallowed exception (`tests/test_architecture.py`); every
  number that looks like an epsilon has a name and a reason (`tests/numerics/test_epsilons.py`).
* **bfloat16 and float16** are used nowhere. Were matrix products to run in them, rendering, loss and everything below
  would stay float32.
"""


def document(rows: Iterable[Row]) -> str:
    """The whole page."""
    rows = list(rows)
    inputs = sum(next(iter(row.measured.values())).rows for row in rows)
    table = [
        "| formula | where | domain | what float32 could do | what the code does | inputs tried | value | gradient |",
        "|---|---|---|---|---|---|---|---|",
        *(f"| {' | '.join(_cells(row))} |" for row in rows),
    ]
    others = [f"* `{module}`: {words}." for module, words in ELSEWHERE.items()]
    counts = f"{len(rows)} formulas, {inputs} rows of input."
    return "\n".join([HEAD, counts, "", *table, "", "## Elsewhere", "", *others, ""])


def _cells(row: Row) -> list[str]:
    case, backends = row.case, row.measured.values()
    domain, hazard, answer, tried = DESCRIPTIONS[case.formula]
    words = case.formula, f"`{case.where}`", domain, hazard, answer, f"{tried} ({next(iter(backends)).rows})"
    values = " / ".join(figure(measured.value) for measured in backends)
    gradients = " / ".join(figure(measured.gradient) for measured in backends)
    return [
        *(text.replace("|", "\\|") for text in words),
        f"{values} ({limit(case.value)})",
        f"{gradients} ({limit(case.gradient)})" if case.gradient else "none",
    ]
