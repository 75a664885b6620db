import pycolmap

from stages.sfm.colmap.database.images import adopt_cameras
from tests.stages.sfm.colmap.made_models import FOCAL_PX, Made


def test_adopted_cameras_are_those_of_the_model(made: Made) -> None:
    model = pycolmap.Reconstruction(made.model)
    model.camera(1).focal_length = 1.5 * FOCAL_PX
    adopt_cameras(made.database, model, {1})
    with pycolmap.Database.open(made.database) as db:
        (camera,) = db.read_all_cameras()
    assert camera.mean_focal_length() == 1.5 * FOCAL_PX and camera.has_prior_focal_length
