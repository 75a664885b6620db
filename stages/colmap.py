"""Everything that is done with COLMAP: camera models, sparse models on disk, and the steps of structure-from-motion.

The only module that imports pycolmap, always inside functions. COLMAP is native code that can abort, so the steps of
structure-from-motion run in a child process (stages/sfm_child.py); the rest is safe to call anywhere.

Image ids are 1 + the photo's place in order of ``file``; an image, its frame and its COLMAP name belong together
(COLMAP's rigs and frames are trivial here: one camera each).
"""

import shutil
import signal
import threading
from collections.abc import Callable, Container, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nerf.scene import Camera
from stages.contract import StageError
from stages.sparse_model import SparseImage, SparseModel

if TYPE_CHECKING:
    import pycolmap

    from stages.photos import Photo

MAPPING_MODEL = "SIMPLE_RADIAL"  # one focal length and one distortion term hold with few matches
FOCAL_GUESS = 1.2  # focal length over the longer side where EXIF is silent: 45 degrees, a phone's wide lens
UPSAMPLE_UP_TO_PX = 1024  # smaller photos yield too few features at their own size
BLOCK_SIZE = 5  # photos per block of matching; a block of pairs is committed at once (progress, resuming)
SMALLEST_MODEL = 3
# What finish() asks of a principal point, in shares of the image: lenses are centred to about a percent.
VAGUE_PRINCIPAL_POINT = 0.005  # a standard deviation above this, and the centre is the better guess
FARTHEST_PRINCIPAL_POINT = 0.1
ROUND_TRIP_PX = 0.01  # a bearing that does not project back to its pixel is a false root of the distortion


def load() -> None:
    """Import pycolmap, and take back the handler that it installs: it would turn SIGTERM into a crash report."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap  # noqa: F401 -- for its side effect

    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


# --- camera models


def camera_rays(camera: Camera, width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    """Unit bearing vectors (float32) of the pixel centres of ``camera``'s image resized to width × height.

    Raises StageError where the camera model has no inverse at some pixels.
    """
    native = _native(camera)
    # Centres are mapped to the camera's own pixels: Camera.rescale would average the two scales of one focal length.
    x = (np.arange(width) + 0.5) * (camera.width / width)
    rays = np.empty((height, width, 3), np.float32)
    lost = 0
    for row in range(height):
        pixels = np.stack([x, np.full(width, (row + 0.5) * (camera.height / height))], axis=1)
        bearings = np.asarray(native.cam_ray_from_img(pixels))
        miss = np.abs(np.asarray(native.img_from_cam(bearings)) - pixels).max(axis=1)
        lost += int(np.count_nonzero(~(miss < ROUND_TRIP_PX)))  # NaN counts as lost
        rays[row] = bearings
    if lost:
        raise StageError(
            f"the {camera.model} camera has no ray for {lost / (width * height):.1%} of its pixels",
            f"its distortion cannot be undone there (parameters {', '.join(f'{p:.5g}' for p in camera.params)})",
            "Check the distortion of the given cameras, or choose a simpler --sfm.camera-model.",
        )
    return rays


def project(camera: Camera, points_camera: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Pixel coordinates of points in the camera's frame; NaN for points behind the camera."""
    return np.asarray(_native(camera).img_from_cam(np.asarray(points_camera, np.float64)))


def rescaled(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same image resized to width × height pixels."""
    native = _native(camera)
    native.rescale(width, height)
    return _plain(native)


def is_valid(camera: Camera) -> bool:
    """Whether all parameters are finite and all focal lengths positive."""
    focal = [camera.params[i] for i in _native(camera).focal_length_idxs()]
    return bool(np.isfinite(camera.params).all()) and all(f > 0 for f in focal)


def _native(camera: Camera, camera_id: int = 1) -> "pycolmap.Camera":
    import pycolmap

    native = pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )
    if not native.verify_params():
        raise ValueError(f"{camera.model} takes {native.params_info}, got {len(camera.params)} numbers")
    return native


# --- sparse models on disk


def read_model(sparse: Path) -> SparseModel:
    """Read a COLMAP model (binary or text). Raises StageError if it is damaged."""
    import pycolmap

    try:
        model = pycolmap.Reconstruction(sparse)
    except (ValueError, RuntimeError, LookupError, OSError) as error:
        raise StageError(
            f"cannot read the COLMAP model in {sparse.name}", str(error), "Check that it is a complete COLMAP model."
        ) from error
    camera_ids = sorted(model.cameras)
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    point_ids = np.array(sorted(model.point3D_ids()), np.int64)
    points = [model.point3D(i) for i in point_ids]
    seen = [image.get_observation_points2D() for image in images]
    return SparseModel(
        cameras=[_plain(model.camera(i)) for i in camera_ids],
        images=[
            SparseImage(i.name, camera_ids.index(i.camera_id), i.cam_from_world().inverse().matrix()) for i in images
        ],
        xyz=np.array([p.xyz for p in points]).reshape(-1, 3),
        rgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        error_px=np.array([p.error for p in points], float),
        view=np.repeat(np.arange(len(images)), [len(s) for s in seen]),
        point=np.searchsorted(point_ids, np.array([p.point3D_id for s in seen for p in s], np.int64)),
        xy=np.array([p.xy for s in seen for p in s], float).reshape(-1, 2),
    )


def write_model(sparse: Path, model: SparseModel) -> None:
    """The inverse of :func:`read_model`: standard binary files. Points are numbered anew, errors computed anew."""
    import pycolmap

    native = pycolmap.Reconstruction()
    for index, camera in enumerate(model.cameras):
        native.add_camera_with_trivial_rig(_native(camera, index + 1))
    tracks = [pycolmap.Track() for _ in model.xyz]
    begins = np.searchsorted(model.view, np.arange(len(model.images) + 1))
    for index, image in enumerate(model.images):
        mine = slice(begins[index], begins[index + 1])
        for keypoint, point in enumerate(model.point[mine]):
            tracks[point].add_element(index + 1, keypoint)
        places = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in model.xy[mine]])
        entry = pycolmap.Image(name=image.file, camera_id=image.camera + 1, image_id=index + 1, points2D=places)
        native.add_image_with_trivial_frame(entry, pycolmap.Rigid3d(image.sfm_from_camera).inverse())
    for xyz, rgb, track in zip(model.xyz, model.rgb, tracks, strict=True):
        native.add_point3D(xyz, track, rgb)
    native.update_point_3d_errors()
    sparse.mkdir(parents=True, exist_ok=True)
    native.write_binary(sparse)


def _plain(camera: "pycolmap.Camera") -> Camera:
    return Camera(camera.model_name, camera.width, camera.height, tuple(float(p) for p in camera.params))


# --- the steps of structure-from-motion; call them in a child process


def fill_database(database: Path, photos: "Sequence[Photo]", camera_model: str) -> None:
    """Enter photos (in order of ``file``) and one camera per camera group, all or nothing."""
    import pycolmap

    with pycolmap.Database.open(database) as db, pycolmap.DatabaseTransaction(db):
        if db.num_images():
            return
        camera_ids: dict[int, int] = {}
        for image_id, photo in enumerate(photos, start=1):
            if photo.camera_group not in camera_ids:
                camera_ids[photo.camera_group] = _enter_camera(db, photo, camera_model, len(camera_ids) + 1)
            camera_id = camera_ids[photo.camera_group]
            image = pycolmap.Image(name=_name(photo), camera_id=camera_id, image_id=image_id)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def _enter_camera(db: "pycolmap.Database", photo: "Photo", camera_model: str, camera_id: int) -> int:
    import pycolmap

    focal_px = photo.focal_px or FOCAL_GUESS * max(photo.width, photo.height)
    camera = pycolmap.Camera.create_from_model_name(camera_id, camera_model, focal_px, photo.width, photo.height)
    camera.has_prior_focal_length = photo.focal_px is not None
    db.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    db.write_rig(rig, use_rig_id=True)
    return camera_id


def _name(photo: "Photo") -> str:
    """The photo's name inside COLMAP."""
    return photo.file.removeprefix("images/")


def extract_features(
    database: Path, images: Path, photos: "Sequence[Photo]", max_image_size: int, max_features: int
) -> None:
    """SIFT keypoints and descriptors of every photo that has none yet; alpha is ignored.

    Photos are searched from their own size down. Doubling them first, as is COLMAP's habit, costs 4.5 times as
    much and moves no camera of a well-sized photo (benchmarks/sfm_accuracy.py), so only small ones are doubled.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = max_image_size
    options.sift.max_num_features = max_features
    small = {_name(p) for p in photos if max(p.width, p.height) <= UPSAMPLE_UP_TO_PX}
    for first_octave, is_small in ((-1, True), (0, False)):
        names = [name for name in map(_name, photos) if (name in small) is is_small]
        if names:
            options.sift.first_octave = first_octave
            pycolmap.extract_features(database, images, names, extraction_options=options, device=pycolmap.Device.cpu)


def match_exhaustively(database: Path, seed: int, max_ratio: float) -> None:
    """Match and verify every pair of photos that has not been yet.

    ``max_ratio`` is Lowe's: the best match must be nearer than this share of the second best.
    """
    import pycolmap

    # With two threads 2 of 9 runs on the fox came out different: on the same descriptors, four pairs of photos had
    # one match more or less (it is an approximate search). With one thread that has not been seen.
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    matching.sift.max_ratio = max_ratio
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # The block size decides which photo of a pair comes first, and with it ties: it may not depend on anything.
    pairing = pycolmap.ExhaustivePairingOptions(block_size=BLOCK_SIZE)
    pycolmap.match_exhaustive(database, matching, pairing, verification, pycolmap.Device.cpu)


def copy_without_matches_of(names: Container[str], database: Path, copy: Path) -> None:
    """Copy the database, less every pair with one of these photos; nothing where the copy is there already."""
    import pycolmap

    if copy.exists():
        return
    unfinished = copy.with_suffix(".unfinished")
    for part in ("", "-wal"):  # as long as anybody reads along, the latest pages stay in the write-ahead log
        unfinished.with_name(unfinished.name + part).unlink(missing_ok=True)
        if (source := database.with_name(database.name + part)).exists():
            shutil.copyfile(source, unfinished.with_name(unfinished.name + part))
    with pycolmap.Database.open(unfinished) as db, pycolmap.DatabaseTransaction(db):
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        for first, second in combinations(images, 2):
            if first.name in names or second.name in names:
                db.delete_matches(first.image_id, second.image_id)
                db.delete_two_view_geometry(first.image_id, second.image_id)
    unfinished.replace(copy)


def map_incrementally(
    database: Path, images: Path, models: Path, seed: int, on_image: Callable[[], None]
) -> "list[pycolmap.Reconstruction]":
    """All sub-models, best first: most registered photos, then most points. ``on_image`` is called per photo."""
    import pycolmap

    models.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        database,
        images,
        models,
        _pipeline_options(seed),
        initial_image_pair_callback=on_image,
        next_image_callback=on_image,
    )
    return sorted(found.values(), key=rank, reverse=True)


def rank(model: "pycolmap.Reconstruction") -> tuple[int, int]:
    """What makes a model better than another: more registered photos, then more points."""
    return model.num_reg_images(), model.num_points3D()


def _pipeline_options(seed: int) -> "pycolmap.IncrementalPipelineOptions":
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    # With more threads RANSAC stops and Ceres sums as timing has it: rarely, but then every number is another.
    # Mapping is no slower for it.
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = SMALLEST_MODEL
    pycolmap.set_random_seed(seed)
    return options


def finish(
    mapped: "pycolmap.Reconstruction", database: Path, seed: int, keep_camera_model: bool
) -> "tuple[pycolmap.Reconstruction, set[int]]":
    """The model after the final adjustment, and the cameras whose principal points took no part in it.

    Principal points are refined and, unless ``keep_camera_model``, every camera gets a second distortion term: on
    photos with measured cameras that halves the error of their positions (benchmarks/sfm_accuracy.py). Cameras that
    the photos say too little about are left as mapping had them.
    """
    model = _adjusted(mapped, database, seed, set(), keep_camera_model)
    vague = _vague_cameras(model)
    if vague:
        model = _adjusted(mapped, database, seed, vague, keep_camera_model)
    return model, vague


def _adjusted(
    mapped: "pycolmap.Reconstruction", database: Path, seed: int, vague: set[int], keep_camera_model: bool
) -> "pycolmap.Reconstruction":
    import pycolmap

    model = pycolmap.Reconstruction(mapped)
    known = set(model.cameras) - vague
    if not keep_camera_model:
        for camera in map(model.camera, known):
            params = [*camera.params, 0.0]
            camera.model, camera.params = pycolmap.CameraModelId.RADIAL, params
    # Whether to refine principal points holds for all cameras, so vague ones among others stay as they are.
    _adjust(model, database, seed, vague if known else set(), principal_point=bool(known))
    return model


def _vague_cameras(model: "pycolmap.Reconstruction") -> set[int]:
    """Cameras whose principal point the photos tell less well than one would guess it, or that came out absurd.

    The standard deviation is that of a bundle adjustment at its minimum; its unit is the error of an observation.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    error_px = model.compute_mean_reprojection_error()
    vague = set()
    for camera_id, camera in model.cameras.items():
        size, place = np.array([camera.width, camera.height]), list(camera.principal_point_idxs())
        off_centre = np.abs(camera.params[place] / size - 0.5).max()
        spread = None if covariance is None else covariance.get_other_params_cov(camera.params)
        sigma_px = np.inf if spread is None else error_px * np.sqrt(spread[place, place].max())
        if not sigma_px < VAGUE_PRINCIPAL_POINT * size.max() or off_centre > FARTHEST_PRINCIPAL_POINT:
            vague.add(camera_id)
    return vague


def _adjust(
    model: "pycolmap.Reconstruction", database: Path, seed: int, constant_cameras: set[int], principal_point: bool
) -> None:
    """Complete, merge and filter tracks and adjust everything together, until little changes.

    Residuals r count by soft-L1, 2(√(1 + r²) − 1), so that the mismatches that remain do not bend the cameras.
    """
    import pycolmap

    options = _pipeline_options(seed)
    options.mapper.constant_cameras = constant_cameras
    adjustment = pycolmap.BundleAdjustmentOptions(refine_principal_point=principal_point, print_summary=False)
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    adjustment.ceres.solver_options.function_tolerance = 1e-6
    adjustment.ceres.solver_options.num_threads = 1
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
