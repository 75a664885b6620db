"""The final adjustment of cameras and points. Call it in a child process."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.colmap.held_out import Choice, adjustment_options, choose
from stages.colmap.lenses import MODELS, equip
from stages.colmap.mapping import pipeline_options
from stages.colmap.observations import noise_px, observations
from stages.colmap.uncertainty import pose_uncertainty_px

if TYPE_CHECKING:
    import pycolmap

# The first choice can only go by what mapping's lens let in. Where another one lets in a tenth more, mostly from the
# borders of wide photos, that is where it shows what it is worth.
MANY_MORE = 1.1


@dataclass(frozen=True)
class Finished:
    """The model after the final adjustment and what there is to say about it."""

    model: "pycolmap.Reconstruction"
    camera_models: list[dict[str, Any]]  # the comparison, a row per candidate (registration.json)
    notes: list[str]
    uncertainty_px: dict[str, float]  # by the image's name


def finish(
    mapped: "pycolmap.Reconstruction", database: Path, seed: int, camera_model: str | None, lens_is_known: bool
) -> Finished:
    """Choose the camera model by held-out observations, unless it is given, and adjust everything with it.

    Of a given model it is only chosen whether its principal point is refined; a known lens is kept as it is. Where
    many more observations fit the chosen lens than mapping's, the choice is made again with them.
    """
    import pycolmap

    if lens_is_known:
        choice = Choice(noise_px(mapped, observations(mapped)), notes=["the camera is kept as given"])
        model = pycolmap.Reconstruction(mapped)
        _adjust(model, database, seed, set(model.cameras), adjustment_options(False, choice.noise_px))
        return _finished(model, choice)
    models = (camera_model,) if camera_model else MODELS
    choice = choose(mapped, seed, models)
    model = _adjusted(mapped, database, seed, choice)
    if model.compute_num_observations() > MANY_MORE * mapped.compute_num_observations():
        choice = choose(model, seed, models)
        model = _adjusted(model, database, seed, choice)
    return _finished(model, choice)


def _finished(model: "pycolmap.Reconstruction", choice: Choice) -> Finished:
    notes, uncertainty = choice.notes, {}
    untold = "how well the poses are known cannot be told"
    try:
        uncertainty = pose_uncertainty_px(model, choice.noise_px)
    except np.linalg.LinAlgError:
        notes = [*notes, f"{untold}: the points leave some of them free to move"]
    except MemoryError as error:
        notes = [*notes, f"{untold}: {str(error) or 'memory ran out'}"]
    return Finished(model, choice.table, notes, {model.image(i).name: px for i, px in uncertainty.items()})


def _adjusted(
    before: "pycolmap.Reconstruction", database: Path, seed: int, choice: Choice
) -> "pycolmap.Reconstruction":
    import pycolmap

    model = pycolmap.Reconstruction(before)
    equip(model, {camera_id: lens.model for camera_id, lens in choice.lenses.items()})
    centred = {camera_id for camera_id, lens in choice.lenses.items() if not lens.principal_point}
    # Whether to refine principal points holds for all cameras at once: those that keep theirs are adjusted before.
    if centred:
        _adjust(model, database, seed, set(), adjustment_options(False, choice.noise_px))
    if centred != choice.lenses.keys():
        _adjust(model, database, seed, centred, adjustment_options(True, choice.noise_px))
    return model


def _adjust(
    model: "pycolmap.Reconstruction",
    database: Path,
    seed: int,
    constant_cameras: set[int],
    adjustment: "pycolmap.BundleAdjustmentOptions",
) -> None:
    """Complete, merge and filter tracks and adjust everything together, until little changes."""
    import pycolmap

    options = pipeline_options(seed)
    options.mapper.constant_cameras = constant_cameras
    with pycolmap.Database.open(database) as db:
        wanted = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(db, wanted)
    for camera in model.cameras.values():  # the database still has the model that mapping began with
        cached = cache.camera(camera.camera_id)
        cached.model, cached.params = camera.model, camera.params
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.mapper,
        adjustment,
        options.triangulation,
    )
    mapper.end_reconstruction(discard=False)
    model.update_point_3d_errors()
